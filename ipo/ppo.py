"""Proximal policy optimisation (PPO) and Invariant Policy Optimization (IPO): one training loop.

Players are trained in turn, each on rollouts of the *average* of all players in the domains that
it owns, by PPO's clipped objective (Schulman et al., 2017). PPO is the game with one player that
owns all domains; IPO has a player for each domain (Algorithm 1 of the paper, with fixed Phi); an
ensemble has as many players as IPO, and each owns all domains.

Axes: R runs, E players, N copies of the environments, T steps, F = N T frames.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ipo.checks import check_choice, check_count, check_counts, check_number
from ipo.distributions import Distribution
from ipo.networks import Network, OnTable, Weights
from ipo.rollouts import TIME_OUTS, Environments, RewardNormalizer, Rollout, collect

METHODS = ("ppo", "ipo", "ensemble")
NORMALIZATIONS = ("none", "minibatch", "rollout")

# (domains, how many copies of each, a generator for each run) -> environments
MakeEnvironments = Callable[[list[int], list[int], Sequence[np.random.Generator]], Environments]


@dataclass(frozen=True)
class Settings:
    """How a policy is trained. Sizes and rates are those of the paper's coloured keys (Table 6).

    Attributes:
        method: ``ppo``, ``ipo`` or ``ensemble``.
        learning_rate: of Adam; the paper has 1e-3 for PPO and 5e-4 for IPO.
        adam_epsilon: keeps Adam's denominator from 0.
        num_updates: rounds, in each of which every player collects and learns once.
        num_envs: copies of the environment, split evenly among domains; or how many of each
            domain. Players who own the same domain share its copies evenly.
        num_steps: T, of each rollout.
        num_epochs: passes over a rollout.
        minibatch_size: frames of each gradient step.
        num_minibatches: of an epoch; instead of their size, where it is given.
        clip: bound on the change of an action's probability ratio, and of the value.
        value_weight, entropy_weight: of their terms in the loss.
        max_gradient_norm: bound on the norm of a player's gradient.
        discount, gae_lambda: gamma, and lambda of the advantage estimate.
        normalize_rewards: by the standard deviation of the discounted return, each player's by
            its own (:class:`ipo.rollouts.RewardNormalizer`).
        reward_clip: bound on a normalised reward.
        normalize_advantages: to mean 0 and deviation 1, in each ``minibatch`` or once over the
            ``rollout``; or ``none``.
        time_outs: what a time-out means. ``bootstrap``: the task goes on, and is worth what the
            critic says. ``terminal``: nothing comes after it (the published keys).
            ``no_advantage``: its last step is left out of the policy's gradient, and the critic
            learns nothing from it (the published doors).
        skip_last_frames: whether every second epoch leaves out the last frame of each copy; the
            published keys do, by a side effect of code for recurrent networks.
    """

    method: str
    learning_rate: float = 1e-3
    adam_epsilon: float = 1e-8
    num_updates: int = 20
    num_envs: int | tuple[int, ...] = 48
    num_steps: int = 128
    num_epochs: int = 4
    minibatch_size: int = 256
    num_minibatches: int | None = None
    clip: float = 0.2
    value_weight: float = 0.5
    entropy_weight: float = 0.01
    max_gradient_norm: float = 0.5
    discount: float = 0.99
    gae_lambda: float = 0.95
    normalize_rewards: bool = False
    reward_clip: float = 10.0
    normalize_advantages: str = "none"
    time_outs: str = "bootstrap"
    skip_last_frames: bool = False

    def __post_init__(self) -> None:
        check_choice("method", self.method, METHODS)
        check_choice("normalize_advantages", self.normalize_advantages, NORMALIZATIONS)
        check_choice("time_outs", self.time_outs, TIME_OUTS)
        for name in ("num_updates", "num_steps", "num_epochs", "minibatch_size"):
            check_count(name, getattr(self, name))
        for count in self.num_envs if isinstance(self.num_envs, tuple) else (self.num_envs,):
            check_count("num_envs", count)
        if self.num_minibatches is not None:
            check_count("num_minibatches", self.num_minibatches)
        for name in ("learning_rate", "adam_epsilon", "clip", "max_gradient_norm", "reward_clip"):
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

    def copies_of_players(self, num_domains: int) -> list[list[int]]:
        """How many copies each player has of each domain that it owns."""
        owned = self.domains_of_players(num_domains)
        num_owners = len(owned) if len(owned[0]) > 1 else 1
        if not isinstance(self.num_envs, tuple):
            if self.num_envs % (num_domains * num_owners):
                raise ValueError(
                    f"num_envs = {self.num_envs}: must be a multiple of "
                    f"{num_domains * num_owners}, to be split evenly among players and domains"
                )
            of_domain = [self.num_envs // num_domains] * num_domains
        else:
            of_domain = list(self.num_envs)
            if len(of_domain) != num_domains or any(n % num_owners for n in of_domain):
                raise ValueError(
                    f"num_envs = {self.num_envs}: must name a multiple of {num_owners} for each "
                    f"of {num_domains} domains"
                )
        return [[of_domain[domain] // num_owners for domain in domains] for domains in owned]

    def size_of_minibatches(self, num_frames: int) -> int:
        """Of a rollout with ``num_frames``."""
        if self.num_minibatches is not None:
            name, size = "num_minibatches", num_frames // self.num_minibatches
        else:
            name, size = "minibatch_size", self.minibatch_size
        if not 0 < size <= num_frames:
            raise ValueError(
                f"{name} = {getattr(self, name)}: must be at most {num_frames}, "
                "the frames of a player's rollout"
            )
        return size


def published(method: str, **changes) -> Settings:
    """The settings of the paper's runs on the coloured keys, with ``changes``."""
    paper = {
        "learning_rate": 5e-4 if method == "ipo" else 1e-3,
        "time_outs": "terminal",
        "skip_last_frames": True,
    }
    return Settings(method, **(paper | changes))


def train(
    network: Network | OnTable,
    start: Callable[[Sequence[np.random.Generator]], Weights],
    make_environments: MakeEnvironments,
    num_domains: int,
    settings: Settings,
    seeds: Sequence[int],
) -> Iterator[tuple[int, list[Weights]]]:
    """Train one policy for each seed: a :class:`Training` from its start to its end.

    Yields:
        ``(number of frames seen, weights of every player)`` at the start and after each update.
        The weights change in place: copy what you want to keep.
    """
    training = Training(network, start, make_environments, num_domains, settings, seeds)
    yield training.num_frames, training.players
    for _ in range(settings.num_updates):
        training.update()
        yield training.num_frames, training.players


class Training:
    """R runs of training, between two updates: all that the next one depends on.

    Args:
        network: one player's outputs; its ``frozen(players)`` is the average that acts.
        start: random weights ``{name: [R, ...]}`` of a player, from a generator for each run.
        make_environments: ``(domains, num_copies, generators)`` -> so many copies of each domain.
        num_domains: training domains.
        settings: the method and how it is trained.
        seeds: R of them, one a run; every method draws the same streams from them.

    Attributes:
        players: weights of every player; they change in place.
        environments: of every player.
        num_frames: seen so far, in each run.

    Raises:
        ValueError: ``num_envs`` that cannot be split evenly among players and domains, a
            minibatch larger than a player's rollout, seeds that are no different whole numbers.
    """

    def __init__(
        self,
        network: Network | OnTable,
        start: Callable[[Sequence[np.random.Generator]], Weights],
        make_environments: MakeEnvironments,
        num_domains: int,
        settings: Settings,
        seeds: Sequence[int],
    ) -> None:
        check_counts("seeds", seeds, minimum=0)
        owned = settings.domains_of_players(num_domains)
        copies = settings.copies_of_players(num_domains)
        for own in copies:
            settings.size_of_minibatches(settings.num_steps * sum(own))
        streams = [np.random.SeedSequence(seed).spawn(3) for seed in seeds]
        self.draws, self.resets, self.orders = (
            [np.random.default_rng(stream[i]) for stream in streams] for i in range(3)
        )
        self.network, self.settings = network, settings
        # Contiguous: the fused Adam pairs weights and gradients by their place in memory.
        self.players = [
            {name: w.contiguous().requires_grad_() for name, w in start(self.draws).items()}
            for _ in owned
        ]
        leaves = [list(player.values()) for player in self.players]
        self.optimizers = [
            torch.optim.Adam(own, settings.learning_rate, eps=settings.adam_epsilon, fused=True)
            for own in leaves
        ]
        self.environments = [
            make_environments(domains, own, self.resets)
            for domains, own in zip(owned, copies, strict=True)
        ]
        self.observations = [own.reset() for own in self.environments]
        self.normalizers = [
            RewardNormalizer(len(seeds), sum(own), settings.discount, settings.reward_clip)
            if settings.normalize_rewards
            else None
            for own in copies
        ]
        self.num_frames = 0

    def update(self) -> None:
        """One round: each player in turn collects with the average of all, and learns."""
        settings = self.settings
        for d in range(len(self.players)):
            rollout, self.observations[d] = collect(
                self.network.frozen(self.players),
                self.network.distribution,
                self.environments[d],
                self.observations[d],
                settings.num_steps,
                self.draws,
                self.normalizers[d],
                settings.discount,
                settings.gae_lambda,
                settings.time_outs,
            )
            frames = rollout.frames()
            improve(
                self.network, self.players, d, self.optimizers[d], frames, settings, self.orders
            )
            self.num_frames += frames.values[0].numel()

    def state(self) -> dict[str, Any]:
        """All that changes, as a tree of tensors and plain values; environments must have one.

        ``restore`` of a new training with the same arguments goes on from there.
        """
        return {
            "num_frames": self.num_frames,
            "players": self.players,
            "optimizers": [
                list(optimizer.state_dict()["state"].values()) for optimizer in self.optimizers
            ],
            "normalizers": [
                normalizer and {"discounted": normalizer.discounted, "moments": normalizer.moments}
                for normalizer in self.normalizers
            ],
            "generators": [[g.bit_generator.state for g in own] for own in self._generators()],
            "environments": [own.state() for own in self.environments],
            "observations": self.observations,
        }

    def restore(self, state: dict[str, Any]) -> None:
        self.num_frames = state["num_frames"]
        with torch.no_grad():
            for player, weights in zip(self.players, state["players"], strict=True):
                for name, weight in player.items():
                    weight.copy_(weights[name])
        for optimizer, moments in zip(self.optimizers, state["optimizers"], strict=True):
            groups = optimizer.state_dict()["param_groups"]
            optimizer.load_state_dict({"state": dict(enumerate(moments)), "param_groups": groups})
        for normalizer, own in zip(self.normalizers, state["normalizers"], strict=True):
            if normalizer is not None:
                normalizer.discounted, normalizer.moments = own["discounted"], own["moments"]
        for generators, states in zip(self._generators(), state["generators"], strict=True):
            for generator, own in zip(generators, states, strict=True):
                generator.bit_generator.state = own
        for environments, own in zip(self.environments, state["environments"], strict=True):
            environments.restore(own)
        self.observations = list(state["observations"])

    def _generators(self) -> tuple[list[np.random.Generator], ...]:
        return self.draws, self.resets, self.orders


def improve(
    network: Network | OnTable,
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
        parameters, values = network.frozen(others)(frames.observations)
        others_parameters, others_values = (1 - share) * parameters, (1 - share) * values
    if settings.normalize_advantages == "rollout":
        frames = frames._replace(advantages=standardize(frames.advantages))
    leaves = list(players[d].values())
    runs = torch.arange(len(frames.actions)).unsqueeze(1)
    for epoch in range(settings.num_epochs):
        skip = settings.skip_last_frames and epoch % 2 == 1
        for chosen in minibatches(frames, settings, generators, skip):
            batch = Rollout(*(x[runs, chosen] for x in frames))
            parameters, values = network(players[d], batch.observations)
            if others:
                parameters = others_parameters[runs, chosen] + share * parameters
                values = others_values[runs, chosen] + share * values
            loss = clipped_loss(network.distribution, parameters, values, batch, settings)
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
    yield from order.split(settings.size_of_minibatches(frames.actions.shape[1]), dim=1)


def clipped_loss(
    distribution: type[Distribution],
    parameters: Tensor,
    values: Tensor,
    batch: Rollout,
    settings: Settings,
) -> Tensor:
    """PPO's loss ``[R]``, to be minimised, on a minibatch ``[R, B]``.

    - mean min(rho A, clip(rho, 1 - c, 1 + c) A) - w_e mean H(pi)
    + w_v mean max((V - G)^2, (V_old + clip(V - V_old, -c, c) - G)^2),
    rho = pi(a | o) / pi_old(a | o),    G: the returns of the rollout
    """
    gains = batch.advantages
    if settings.normalize_advantages == "minibatch":
        gains = standardize(gains)
    ratio = distribution.log_probability(parameters, batch.actions) - batch.log_probabilities
    ratio = ratio.exp()
    near = ratio.clamp(1 - settings.clip, 1 + settings.clip)
    policy_loss = -torch.minimum(ratio * gains, near * gains).mean(1)
    change = (values - batch.values).clamp(-settings.clip, settings.clip)
    errors = torch.maximum(
        (values - batch.returns) ** 2, (batch.values + change - batch.returns) ** 2
    )
    return (
        policy_loss
        - settings.entropy_weight * distribution.entropy(parameters).mean(1)
        + settings.value_weight * errors.mean(1)
    )


def standardize(gains: Tensor) -> Tensor:
    """``[R, B]`` with mean 0 and standard deviation 1 in each run."""
    return (gains - gains.mean(1, True)) / (gains.std(1, keepdim=True) + 1e-8)


def clip_gradients(gradients: Sequence[Tensor], max_norm: float) -> list[Tensor]:
    """Gradients ``[R, ...]`` of a player, scaled so that their joint norm is at most max_norm."""
    squares = torch.stack([gradient.flatten(1).square().sum(1) for gradient in gradients])
    scale = (max_norm / squares.sum(0).sqrt()).clamp(max=1.0)
    return [g * scale.reshape(-1, *[1] * (g.dim() - 1)) for g in gradients]
