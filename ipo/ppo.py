"""Proximal policy optimisation (PPO) and Invariant Policy Optimization (IPO): one training loop.

Players are trained in turn, each on rollouts of the *average* of all players in the domains that
it owns, by PPO's clipped objective (Schulman et al., 2017). PPO is the game with one player that
owns all domains; IPO has a player for each domain (Algorithm 1 of the paper, with fixed Phi); an
ensemble has as many players as IPO, and each owns all domains.

Axes: R runs, N copies of the environments, T steps, F = N T frames, A actions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from torch import Tensor

from ipo.checks import check_choice, check_count, check_counts, check_number
from ipo.networks import Outputs, Weights
from ipo.optimizers import make_optimizer

METHODS = ("ppo", "ipo", "ensemble")


@dataclass(frozen=True)
class Settings:
    """How a policy is trained. Defaults are the paper's (appendix, Table 6), except where noted.

    Attributes:
        method: ``ppo``, ``ipo`` or ``ensemble``.
        learning_rate: of Adam; the paper has 1e-3 for PPO and 5e-4 for IPO.
        num_updates: rounds, in each of which every player collects and learns once.
        num_envs: copies of the environment, split evenly among players and their domains.
        num_steps: T, of each rollout.
        num_epochs: passes over a rollout.
        minibatch_size: frames of each gradient step.
        clip: bound on the change of an action's probability ratio, and of the value.
        value_weight, entropy_weight: of their terms in the loss.
        max_gradient_norm: bound on the norm of a player's gradient.
        discount, gae_lambda: gamma, and lambda of the advantage estimate.
        normalize_advantages: to mean 0 and deviation 1 in each minibatch; the paper does not.
        truncation_is_terminal: whether a time-out counts as an end without a future. The
            published runs do this; it is wrong, since the task goes on, so it is not our default.
        skip_last_frames: whether every second epoch leaves out the last frame of each copy; the
            published runs do, by a side effect of code for recurrent networks.
    """

    method: str
    learning_rate: float = 1e-3
    num_updates: int = 20
    num_envs: int = 48
    num_steps: int = 128
    num_epochs: int = 4
    minibatch_size: int = 256
    clip: float = 0.2
    value_weight: float = 0.5
    entropy_weight: float = 0.01
    max_gradient_norm: float = 0.5
    discount: float = 0.99
    gae_lambda: float = 0.95
    normalize_advantages: bool = False
    truncation_is_terminal: bool = False
    skip_last_frames: bool = False

    def __post_init__(self) -> None:
        check_choice("method", self.method, METHODS)
        for name in ("num_updates", "num_envs", "num_steps", "num_epochs", "minibatch_size"):
            check_count(name, getattr(self, name))
        for name in ("learning_rate", "clip", "max_gradient_norm"):
            check_number(name, getattr(self, name), above=0)
        for name in ("value_weight", "entropy_weight"):
            check_number(name, getattr(self, name), least=0)
        for name in ("discount", "gae_lambda"):
            check_number(name, getattr(self, name), least=0)
            if getattr(self, name) > 1:
                raise ValueError(f"{name} = {getattr(self, name)}: must be at most 1")

    def domains_of_players(self, num_domains: int) -> list[list[int]]:
        """The domains that each player owns."""
        everything = list(range(num_domains))
        return {
            "ppo": [everything],
            "ipo": [[d] for d in everything],
            "ensemble": [everything] * num_domains,
        }[self.method]


def published(method: str, **changes) -> Settings:
    """The settings of the paper's runs, with ``changes``."""
    paper = {
        "learning_rate": 5e-4 if method == "ipo" else 1e-3,
        "truncation_is_terminal": True,
        "skip_last_frames": True,
    }
    return Settings(method, **(paper | changes))


class Step(NamedTuple):
    """What ``[R, N]`` copies answer to an action; those that are over begin anew at once.

    ``last_observation`` is what was seen at the end of the step, before any new beginning.
    """

    observation: Tensor
    reward: Tensor
    terminated: Tensor
    truncated: Tensor
    last_observation: Tensor


class Environments(Protocol):
    """``[R, N]`` copies of environments."""

    def reset(self) -> Tensor: ...

    def step(self, actions: Tensor) -> Step: ...


class FromGymnasium:
    """``R x N`` copies in one ``gymnasium.vector.VectorEnv``, which begin anew in the same step.

    Args:
        envs: made with ``autoreset_mode=AutoresetMode.SAME_STEP``; observations are arrays.
        num_runs: R; copies r N to (r + 1) N belong to run r.
        seed: of the first reset.
    """

    def __init__(self, envs: VectorEnv, num_runs: int, seed: int) -> None:
        mode = envs.metadata["autoreset_mode"]
        if mode != AutoresetMode.SAME_STEP:
            raise ValueError(f"envs: have autoreset_mode = {mode}, must have SAME_STEP")
        if envs.num_envs % num_runs:
            raise ValueError(f"envs: {envs.num_envs} copies, must be a multiple of {num_runs} runs")
        self.envs, self.num_runs, self.seed = envs, num_runs, seed

    def reset(self) -> Tensor:
        return self._by_run(self.envs.reset(seed=self.seed)[0])

    def step(self, actions: Tensor) -> Step:
        observation, reward, terminated, truncated, info = self.envs.step(actions.flatten().numpy())
        last = observation.copy()
        for copy in np.flatnonzero(terminated | truncated):
            last[copy] = info["final_obs"][copy]
        return Step(
            self._by_run(observation),
            self._by_run(reward),
            self._by_run(terminated).bool(),
            self._by_run(truncated).bool(),
            self._by_run(last),
        )

    def _by_run(self, values: np.ndarray) -> Tensor:
        return torch.tensor(values, dtype=torch.float32).unflatten(0, (self.num_runs, -1))


class Rollout(NamedTuple):
    """Frames ``[R, N, T]`` of one player's environments, with what learning needs to know."""

    observations: Tensor
    actions: Tensor
    log_probabilities: Tensor
    values: Tensor
    advantages: Tensor

    def frames(self) -> Rollout:
        """The same as ``[R, F]``."""
        return Rollout(*(x.flatten(1, 2) for x in self))


def train(
    network: Callable[[Weights, Tensor], Outputs],
    start: Callable[[Sequence[np.random.Generator]], Weights],
    make_environments: Callable[[list[int], int, Sequence[np.random.Generator]], Environments],
    num_domains: int,
    settings: Settings,
    seeds: Sequence[int],
) -> Iterator[tuple[int, list[Weights]]]:
    """Train one policy for each seed.

    Args:
        network: one player's outputs; its ``frozen(players)`` is the average that acts.
        start: random weights ``{name: [R, ...]}`` of a player, from a generator for each run.
        make_environments: ``(domains, num_copies, generators)`` -> copies of each domain.
        num_domains: training domains.
        settings: the method and how it is trained.
        seeds: R of them, one a run; every method draws the same streams from them.

    Yields:
        ``(number of frames seen, weights of every player)`` at the start and after each update.
        The weights change in place: copy what you want to keep.

    Raises:
        ValueError: ``num_envs`` that cannot be split evenly among players and domains, a
            minibatch larger than a player's rollout, seeds that are no different whole numbers.
    """
    check_counts("seeds", seeds, minimum=0)
    owned = settings.domains_of_players(num_domains)
    num_copies, rest = divmod(settings.num_envs, len(owned) * len(owned[0]))
    if rest:
        raise ValueError(
            f"num_envs = {settings.num_envs}: must be a multiple of "
            f"{len(owned) * len(owned[0])}, to be split evenly among players and their domains"
        )
    num_rollout = settings.num_steps * settings.num_envs // len(owned)
    if settings.minibatch_size > num_rollout:
        raise ValueError(
            f"minibatch_size = {settings.minibatch_size}: must be at most {num_rollout}, "
            "the frames of a player's rollout"
        )
    streams = [np.random.SeedSequence(seed).spawn(3) for seed in seeds]
    draws, resets, orders = (
        [np.random.default_rng(stream[i]) for stream in streams] for i in range(3)
    )
    players = [start(draws) for _ in owned]
    leaves = [[w.requires_grad_() for w in player.values()] for player in players]
    optimizers = [make_optimizer("adam", own, settings.learning_rate) for own in leaves]
    environments = [make_environments(domains, num_copies, resets) for domains in owned]
    observations = [own.reset() for own in environments]

    num_frames = 0
    yield num_frames, players
    for _ in range(settings.num_updates):
        for d in range(len(players)):
            policy = network.frozen(players)
            rollout, observations[d] = collect(
                policy, environments[d], observations[d], settings, draws
            )
            improve(network, players, d, optimizers[d], rollout.frames(), settings, orders)
            num_frames += rollout.actions[0].numel()
        yield num_frames, players


def collect(
    policy: Callable[[Tensor], Outputs],
    environments: Environments,
    observation: Tensor,
    settings: Settings,
    generators: Sequence[np.random.Generator],
) -> tuple[Rollout, Tensor]:
    """T steps of a policy in all copies; returns the rollout and the observation after it."""
    steps = []
    for _ in range(settings.num_steps):
        logits, values = policy(observation)
        actions = sample(logits, generators)
        log_probabilities = log_probability(logits, actions)
        step = environments.step(actions)
        reward = step.reward
        if not settings.truncation_is_terminal and bool(step.truncated.any()):
            # The task goes on after a time-out: what it is worth from there is part of the return.
            reward = reward + settings.discount * step.truncated * policy(step.last_observation)[1]
        ended = step.terminated | step.truncated
        steps.append((observation, actions, log_probabilities, values, reward, ended))
        observation = step.observation
    observations, actions, log_probabilities, values, rewards, ended = (
        torch.stack(x, dim=2) for x in zip(*steps, strict=True)
    )
    next_values = torch.cat([values[..., 1:], policy(observation)[1].unsqueeze(-1)], dim=-1)
    gains = advantages(rewards, values, next_values, ended, settings.discount, settings.gae_lambda)
    return Rollout(observations, actions, log_probabilities, values, gains), observation


def advantages(
    rewards: Tensor,
    values: Tensor,
    next_values: Tensor,
    ended: Tensor,
    discount: float,
    gae_lambda: float,
) -> Tensor:
    """Generalised advantage estimates; all tensors are ``[..., T]``.

        delta_t = r_t + gamma V(o_(t+1)) - V(o_t)
        A_t     = delta_t + gamma lambda A_(t+1),      both without their future where t is the end

    Source: Schulman et al. (2016).
    """
    goes_on = (~ended).to(values)
    deltas = rewards + discount * goes_on * next_values - values
    estimates = torch.empty_like(deltas)
    estimate = torch.zeros_like(deltas[..., 0])
    for t in reversed(range(deltas.shape[-1])):
        estimate = deltas[..., t] + discount * gae_lambda * goes_on[..., t] * estimate
        estimates[..., t] = estimate
    return estimates


def improve(
    network: Callable[[Weights, Tensor], Outputs],
    players: Sequence[Weights],
    d: int,
    optimizer: torch.optim.Optimizer,
    frames: Rollout,
    settings: Settings,
    generators: Sequence[np.random.Generator],
) -> None:
    """Player d's move: some epochs of PPO on its frames ``[R, F]``, while the others stand still.

    The player sees its own outputs only through the average, so they carry the factor 1 / E.
    """
    share = 1 / len(players)
    others = [player for e, player in enumerate(players) if e != d]
    if others:
        logits, values = network.frozen(others)(frames.observations)
        others_logits, others_values = (1 - share) * logits, (1 - share) * values
    leaves = list(players[d].values())
    runs = torch.arange(len(frames.actions)).unsqueeze(1)
    for epoch in range(settings.num_epochs):
        skip = settings.skip_last_frames and epoch % 2 == 1
        for chosen in minibatches(frames, settings, generators, skip):
            batch = Rollout(*(x[runs, chosen] for x in frames))
            logits, values = network(players[d], batch.observations)
            if others:
                logits = others_logits[runs, chosen] + share * logits
                values = others_values[runs, chosen] + share * values
            loss = clipped_loss(logits, values, batch, settings)
            gradients = torch.autograd.grad(loss.sum(), leaves)
            for leaf, gradient in zip(
                leaves, clip_gradients(gradients, settings.max_gradient_norm), strict=True
            ):
                leaf.grad = gradient
            optimizer.step()


def minibatches(
    frames: Rollout,
    settings: Settings,
    generators: Sequence[np.random.Generator],
    skip_last_frames: bool,
) -> Iterator[Tensor]:
    """Indices ``[R, B]`` of frames in an order of each run's own."""
    numbers = np.arange(frames.actions.shape[1])
    if skip_last_frames:
        numbers = numbers[(numbers + 1) % settings.num_steps != 0]
    order = torch.tensor(np.stack([generator.permutation(numbers) for generator in generators]))
    yield from order.split(settings.minibatch_size, dim=1)


def clipped_loss(logits: Tensor, values: Tensor, batch: Rollout, settings: Settings) -> Tensor:
    """PPO's loss ``[R]``, to be minimised, on a minibatch ``[R, B]``.

    - mean min(rho A, clip(rho, 1 - c, 1 + c) A) - w_e mean H(pi)
    + w_v mean max((V - G)^2, (V_old + clip(V - V_old, -c, c) - G)^2),
    rho = pi(a | o) / pi_old(a | o),    G = V_old + A
    """
    gains = batch.advantages
    returns = batch.values + gains
    if settings.normalize_advantages:
        gains = (gains - gains.mean(1, True)) / (gains.std(1, keepdim=True) + 1e-8)
    ratio = (log_probability(logits, batch.actions) - batch.log_probabilities).exp()
    near = ratio.clamp(1 - settings.clip, 1 + settings.clip)
    policy_loss = -torch.minimum(ratio * gains, near * gains).mean(1)
    change = (values - batch.values).clamp(-settings.clip, settings.clip)
    errors = torch.maximum((values - returns) ** 2, (batch.values + change - returns) ** 2)
    return (
        policy_loss
        - settings.entropy_weight * entropy(logits).mean(1)
        + settings.value_weight * errors.mean(1)
    )


def clip_gradients(gradients: Sequence[Tensor], max_norm: float) -> list[Tensor]:
    """Gradients ``[R, ...]`` of a player, scaled so that their joint norm is at most max_norm."""
    squares = torch.stack([gradient.flatten(1).square().sum(1) for gradient in gradients])
    scale = (max_norm / squares.sum(0).sqrt()).clamp(max=1.0)
    return [g * scale.reshape(-1, *[1] * (g.dim() - 1)) for g in gradients]


def sample(logits: Tensor, generators: Sequence[np.random.Generator]) -> Tensor:
    """Actions ``[R, N]`` from ``logits [R, N, A]``, each run with its own generator."""
    uniform = np.stack([generator.random(logits.shape[1]) for generator in generators])
    below = logits.softmax(-1).cumsum(-1)[..., :-1]  # rounding must not lead beyond the last action
    return (torch.tensor(uniform, dtype=below.dtype).unsqueeze(-1) > below).sum(-1)


def log_probability(logits: Tensor, actions: Tensor) -> Tensor:
    """log pi(a | o), ``[R, B]``."""
    return logits.log_softmax(-1).gather(-1, actions.unsqueeze(-1)).squeeze(-1)


def entropy(logits: Tensor) -> Tensor:
    """H(pi( . | o)) in nats, ``[R, B]``."""
    log_probabilities = logits.log_softmax(-1)
    return -(log_probabilities.exp() * log_probabilities).sum(-1)
