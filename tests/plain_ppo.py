"""PPO and IPO, slow and obvious: the yardstick for ``ipo.ppo`` and ``ipo.networks``.

One run at a time, a loop over environments, layers of ``torch.nn``.
Shares no code with ``ipo``; meant to be checked by reading. PPO is one player; IPO is a player for
each domain. ``s`` is anything with the attributes of ``ipo.ppo.PPOSettings``.
"""

import numpy as np
import torch
from torch import nn


class ActorCritic(nn.Module):
    """The published network for images ``[B, 7, 7, C]``."""

    def __init__(self, num_channels=3, num_actions=7):
        super().__init__()
        self.convolutions = nn.Sequential(
            nn.Conv2d(num_channels, 16, 2),
            nn.ReLU(),
            nn.MaxPool2d(2),
            nn.Conv2d(16, 32, 2),
            nn.ReLU(),
            nn.Conv2d(32, 64, 2),
            nn.ReLU(),
            nn.Flatten(),
        )
        self.actor = nn.Sequential(nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, num_actions))
        self.critic = nn.Sequential(nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, 1))

    def forward(self, images):
        embedding = self.convolutions(images.permute(0, 3, 1, 2))
        return self.actor(embedding), self.critic(embedding)[:, 0]


def averaged(players, images):
    """Logits and values are averaged; the softmax comes afterwards."""
    logits, values = zip(*(player(images) for player in players), strict=True)
    return sum(logits) / len(players), sum(values) / len(players)


def train(players, envs, s, draws, orders, seeds, at_once=True, movers=None):
    """Yields the players after every update; ``envs[m]`` is the list that move m acts in.

    Move m is that of player ``movers[m]``, or of player m. Where Phi is variable, all players have
    the convolutions of the first, and the last of ``envs`` are those that Phi moves in.
    ``seeds[m]`` are those of the first resets; ``draws`` and ``orders`` are the generators of
    actions and of the minibatches. The network is called for what all environments show
    ``at_once``, or for each of them alone.
    """
    like = next(players[0].parameters())
    parts = [list(player.parameters()) for player in players]
    moves = list(enumerate(movers or range(len(players)))) * s.num_inner_rounds
    if s.variable_phi:
        parts = [[*player.actor.parameters(), *player.critic.parameters()] for player in players]
        parts.append(list(players[0].convolutions.parameters()))
        moves.insert(0, (len(envs) - 1, len(players)))
        for player in players:
            player.convolutions = players[0].convolutions
    optimizers = [
        torch.optim.AdamW(part, s.learning_rate, weight_decay=s.weight_decay) for part in parts
    ]
    seen = [
        [env.reset(seed=seed)[0] for env, seed in zip(*own, strict=True)]
        for own in zip(envs, seeds, strict=True)
    ]
    for _ in range(s.num_updates):
        for m, d in moves:
            rollout = collect(players, envs[m], seen[m], s, draws, like, at_once)
            if s.variance_penalty:
                make_returns_alike(rollout, s)
            if s.scale_penalty:
                measure_scale(players, rollout, s)
            improve(players, parts[d], optimizers[d], rollout, s, orders)
        yield players


def make_returns_alike(rollout, s):
    """The gradient of (R_0 + R_1) / 2 - penalty (R_0 - R_1)^2 / 4; frames of domain 0 come first.

    The last factor is the variance of two numbers.
    """
    half = len(rollout["gains"]) // 2
    apart = rollout["returns"][:half].mean() - rollout["returns"][half:].mean()
    rollout["gains"][:half] *= 1 - s.variance_penalty * apart
    rollout["gains"][half:] *= 1 + s.variance_penalty * apart


def measure_scale(players, rollout, s):
    """Twice the penalty times the slope of each half's return in a factor on all logits."""
    factor = torch.ones((), dtype=rollout["gains"].dtype, requires_grad=True)
    logits = averaged(players, rollout["images"])[0].detach()
    policy = torch.distributions.Categorical(logits=factor * logits)
    ratio = torch.exp(policy.log_prob(rollout["actions"]) - rollout["log_probabilities"])
    halves = (ratio * rollout["gains"]).chunk(2)
    slopes = [torch.autograd.grad(half.mean(), factor, retain_graph=True)[0] for half in halves]
    rollout["factors"] = torch.cat(
        [
            2 * s.scale_penalty * slope * torch.ones_like(half).detach()
            for slope, half in zip(slopes, halves, strict=True)
        ]
    )


def collect(players, envs, seen, s, draws, like, at_once):
    """``s.num_steps`` steps in every environment; ``seen`` is updated in place."""

    @torch.no_grad()
    def act_on(images):
        images = torch.tensor(np.stack(images)).to(like)
        answers = [averaged(players, part) for part in ([images] if at_once else images.split(1))]
        logits, values = (torch.cat(part) for part in zip(*answers, strict=True))
        return logits.log_softmax(1), values

    frames = []  # one list of columns for every step
    for _ in range(s.num_steps):
        images = list(seen)
        log_probabilities, values = act_on(images)
        below = log_probabilities.exp().cumsum(1)[:, :-1].numpy()
        actions = (draws.random(len(envs))[:, None] > below).sum(1)
        rewards, ends = np.zeros(len(envs)), np.zeros(len(envs), dtype=bool)
        future = torch.zeros(len(envs)).to(like)  # values of what is not the next frame
        for n, env in enumerate(envs):
            seen[n], reward, terminated, truncated, _ = env.step(int(actions[n]))
            rewards[n], ends[n] = np.float32(reward), terminated or truncated
            if ends[n]:
                if not terminated and s.time_outs == "bootstrap":
                    future[n] = act_on([seen[n]])[1][0]
                seen[n], _ = env.reset()
        chosen = log_probabilities[range(len(envs)), actions]
        frames.append((images, actions, chosen, values, rewards, ends, future))
    images, actions, chosen, values, rewards, ends, future = zip(*frames, strict=True)
    values = [*values, act_on(seen)[1]]

    gains = torch.zeros(s.num_steps, len(envs)).to(like)
    for n in range(len(envs)):
        gain = 0.0
        for t in reversed(range(s.num_steps)):
            if ends[t][n]:
                gain = rewards[t][n] + s.discount * future[t][n] - values[t][n]
            else:
                delta = rewards[t][n] + s.discount * values[t + 1][n] - values[t][n]
                gain = delta + s.discount * s.gae_lambda * gain
            gains[t, n] = gain
    return {
        "images": torch.tensor(np.stack(images, axis=1)).to(like).flatten(0, 1),
        "actions": torch.tensor(np.stack(actions, axis=1)).flatten(),
        "log_probabilities": torch.stack(chosen, dim=1).flatten(),
        "values": torch.stack(values[:-1], dim=1).flatten(),
        "gains": gains.T.flatten(),
        "returns": torch.stack(values[:-1], dim=1).flatten() + gains.T.flatten(),
    }


def improve(players, own, optimizer, rollout, s, orders):
    """Epochs of PPO for some weights; frames are numbered environment by environment."""
    for epoch in range(s.num_epochs):
        numbers = np.arange(len(rollout["gains"]))
        if s.skip_last_frames and epoch % 2 == 1:
            numbers = numbers[numbers % s.num_steps != s.num_steps - 1]
        numbers = torch.tensor(orders.permutation(numbers))
        for batch in numbers.split(s.minibatch_size):
            optimizer.zero_grad()
            frames = {name: column[batch] for name, column in rollout.items()}
            loss(players, frames, s).backward(inputs=own)
            norm = torch.sqrt(sum((weight.grad**2).sum() for weight in own))
            if norm > s.max_gradient_norm:
                for weight in own:
                    weight.grad *= s.max_gradient_norm / norm
            optimizer.step()


def loss(players, frames, s):
    logits, values = averaged(players, frames["images"])
    policy = torch.distributions.Categorical(logits=logits)
    old_values, gains = frames["values"], frames["gains"]
    returns = frames["returns"]
    if s.normalize_advantages == "minibatch":
        gains = (gains - gains.mean()) / (gains.std() + 1e-8)
    ratio = torch.exp(policy.log_prob(frames["actions"]) - frames["log_probabilities"])
    clipped_ratio = torch.clamp(ratio, 1 - s.clip, 1 + s.clip)
    policy_loss = -torch.min(ratio * gains, clipped_ratio * gains).mean()
    clipped_values = values
    if s.clip_values:
        clipped_values = old_values + torch.clamp(values - old_values, -s.clip, s.clip)
    value_loss = torch.max((values - returns) ** 2, (clipped_values - returns) ** 2).mean()
    entropy = policy.entropy().mean()
    if "factors" in frames:
        expected = (policy.probs * logits).sum(1)
        slope = logits[range(len(logits)), frames["actions"]] - expected
        policy_loss = policy_loss + (frames["factors"] * clipped_ratio * gains * slope).mean()
    return policy_loss + s.value_weight * value_loss - s.entropy_weight * entropy
