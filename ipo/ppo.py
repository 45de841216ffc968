"""Proximal policy optimisation (PPO) and Invariant Policy Optimization (IPO): the game of networks.

Players are trained in turn, each on rollouts of the *average* of all players in the domains that
it owns, by PPO's clipped objective (Schulman et al., 2017). Who owns what, and the order of moves,
are those of :mod:`ipo.game`: ``ppo`` is its ``pooled`` game, in which one player owns all domains.

Axes: R runs, E players, N copies of the environments, T steps, F = N T frames.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import torch
from torch import Tensor

from ipo.checks import (
    Count,
    NonNegative,
    Positive,
    Probability,
    Seeds,
    check_count,
    checked,
    one_of,
)
from ipo.distributions import Distribution, Generators
from ipo.game import Move, moves, play_round
from ipo.network_players import NetworkPlayers
from ipo.networks import Network, Weights, chosen_rows
from ipo.rollouts import Collector, Device, Environments, Rollout, TimeOuts

METHODS = ("ppo", "ipo", "ensemble", "in_turn")
NORMALIZATIONS = ("none", "minibatch", "rollout")
SCALES = ("player", "domain")

NumCopies = Annotated[Sequence[Count], "domains"]  # how many of each domain
# (domains, how many copies of each, a generator for each run) -> environments
MakeEnvironments = Callable[[list[int], list[int], Generators], Environments]


@checked
@dataclass(frozen=True)
class PPOSettings:
    """How a policy is trained. Sizes and rates are those of the paper's coloured keys (Table 6).

    Attributes:
        method: ``ppo``, ``ipo`` or ``ensemble``; or ``in_turn``, one network for all domains like
            PPO's, trained on one domain at a time like IPO's.
        learning_rate: of Adam; the paper has 1e-3 for PPO and 5e-4 for IPO.
        adam_epsilon: keeps Adam's denominator from 0.
        num_updates: rounds, in each of which every player collects and learns K times.
        num_inner_rounds: K of Algorithm 1; it is 1 in all runs of the paper.
        variable_phi: whether players share the network's first part Phi, which moves first in each
            round, on the return of all domains; all runs of the paper fix it to the identity.
        num_envs: copies of the environment, split evenly among domains; or how many of each
            domain. Players who own the same domain share its copies evenly.
        num_steps: T, of each rollout.
        num_epochs: passes over a rollout.
        minibatch_size: frames of each gradient step.
        num_minibatches: of an epoch; instead of their size, where it is given.
        clip: bound on the change of an action's probability ratio.
        clip_values: whether it bounds the change of the value, too; the published runs did.
        value_weight, entropy_weight: of their terms in the loss.
        max_gradient_norm: bound on the norm of a player's gradient.
        discount, gae_lambda: gamma, and lambda of the advantage estimate.
        normalize_rewards: by the standard deviation of the discounted return
            (:class:`ipo.rollouts.RewardNormalizer`).
        reward_scale: whose deviation that is: a ``player``'s, of all its domains, or that of each
            ``domain``.
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

    method: Annotated[str, one_of(METHODS)]
    learning_rate: Positive = 1e-3
    adam_epsilon: Positive = 1e-8
    num_updates: Count = 20
    num_inner_rounds: Count = 1
    variable_phi: bool = False
    num_envs: Count | Annotated[tuple[Count, ...], "domains"] = 48
    num_steps: Count = 128
    num_epochs: Count = 4
    minibatch_size: Count = 256
    num_minibatches: Count | None = None
    clip: Positive = 0.2
    clip_values: bool = True
    value_weight: NonNegative = 0.5
    entropy_weight: NonNegative = 0.01
    max_gradient_norm: Positive = 0.5
    discount: Probability = 0.99
    gae_lambda: Probability = 0.95
    normalize_rewards: bool = False
    reward_scale: Annotated[str, one_of(SCALES)] = "player"
    reward_clip: Positive = 10.0
    normalize_advantages: Annotated[str, one_of(NORMALIZATIONS)] = "none"
    time_outs: TimeOuts = "bootstrap"
    skip_last_frames: bool = False

    def moves(self, num_domains: int) -> list[Move]:
        """Of a round; ``ppo`` is what the game calls ``pooled``."""
        return moves("pooled" if self.method == "ppo" else self.method, num_domains)

    def copies(self, num_domains: int) -> list[list[int]]:
        """How many copies each move has of each of its domains; last, Phi's if it is variable."""
        owned = [move.domains for move in self.moves(num_domains)]
        num_owners = len(owned) if len(owned[0]) > 1 else 1
        of_domain = self._copies_of_domains(num_domains, num_owners)
        copies = [[of_domain[domain] // num_owners for domain in domains] for domains in owned]
        return [*copies, of_domain] if self.variable_phi else copies

    def _copies_of_domains(self, num_domains: int, num_owners: int) -> list[int]:
        """How many there are of each, to be shared evenly by so many players."""
        if not isinstance(self.num_envs, tuple):
            if self.num_envs % (num_domains * num_owners):
                raise ValueError(
                    f"num_envs = {self.num_envs}: must be a multiple of "
                    f"{num_domains * num_owners}, to be split evenly among players and domains"
                )
            return [self.num_envs // num_domains] * num_domains
        if len(self.num_envs) != num_domains or any(n % num_owners for n in self.num_envs):
            raise ValueError(
                f"num_envs = {self.num_envs}: must name a multiple of {num_owners} for each "
                f"of {num_domains} domains"
            )
        return list(self.num_envs)

    def size_of_minibatches(self, num_frames: int) -> int:
        """Of a rollout with ``num_frames``."""
        check_count("num_frames", num_frames)
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

    def optimizer(self, weights: Tensor) -> torch.optim.Optimizer:
        """Of weights that move together."""
        rate, epsilon = self.learning_rate, self.adam_epsilon
        return torch.optim.Adam([weights], rate, eps=epsilon, fused=True)

    @checked
    def collector(
        self, environments: Environments, copies: NumCopies, device: Device = "cpu"
    ) -> Collector:
        """Of a player in its environments, so many copies of each of its domains."""
        clip = self.reward_clip if self.normalize_rewards else None
        scales = copies if self.reward_scale == "domain" else None
        sizes = self.num_steps, self.discount, self.gae_lambda
        return Collector(environments, *sizes, self.time_outs, clip, scales, device)


class Training:
    """R runs of training, between two updates: all that the next one depends on.

    Args:
        network: one player's outputs; its ``frozen(players)`` is the average that acts.
        make_environments: ``(domains, num_copies, generators)`` -> so many copies of each domain,
            in their order.
        num_domains: training domains.
        settings: the method and how it is trained.
        seeds: R of them, one a run; every method draws the same streams from them.
        device: where networks act and learn, such as ``cuda``; environments are on the CPU.

    Attributes:
        learners: the players' weights and optimisers.
        players: weights of every player; they change in place.
        moves: of a round: who moves, on which domains.
        collectors: the environments of every move, last Phi's.
        num_frames: seen so far, in each run.

    Raises:
        ValueError: ``num_envs`` that cannot be split evenly among players and domains, a
            minibatch larger than a player's rollout, seeds that are no different whole numbers,
            a device that is not there, a variable Phi of a network that has none.
    """

    @checked
    def __init__(
        self,
        network: Network,
        make_environments: MakeEnvironments,
        num_domains: Count,
        settings: PPOSettings,
        seeds: Seeds,
        device: Device = "cpu",
    ) -> None:
        self.moves = settings.moves(num_domains)
        copies = settings.copies(num_domains)
        owned = [move.domains for move in self.moves]
        if settings.variable_phi:
            owned.append(list(range(num_domains)))
        for own in copies:
            settings.size_of_minibatches(settings.num_steps * sum(own))
        streams = [np.random.SeedSequence(seed).spawn(3) for seed in seeds]
        self.draws, self.resets, self.orders = (
            [np.random.default_rng(stream[i]) for stream in streams] for i in range(3)
        )
        self.network, self.settings, self.num_frames = network, settings, 0
        num_players = 1 + max(move.player for move in self.moves)
        starts = [network.start(self.draws) for _ in range(num_players)]
        self.learners = NetworkPlayers(
            network,
            [{name: weight.to(device) for name, weight in own.items()} for own in starts],
            settings.optimizer,
            settings.variable_phi,
        )
        environments = [
            make_environments(domains, own, self.resets)
            for domains, own in zip(owned, copies, strict=True)
        ]
        self.collectors = [
            settings.collector(own, number, device)
            for own, number in zip(environments, copies, strict=True)
        ]

    @property
    def players(self) -> list[Weights]:
        return self.learners.players

    def reports(self) -> Iterator[tuple[int, list[Weights]]]:
        """Train to the end: ``(num_frames, players)`` now and after each update.

        The weights change in place: keep what you need with ``ipo.networks.copied``.
        """
        yield self.num_frames, self.players
        for _ in range(self.settings.num_updates):
            self.update()
            yield self.num_frames, self.players

    def update(self, only: int | None = None) -> None:
        """One round of Algorithm 1; or one of its moves, while all else stands still."""
        if only is None:
            settings = self.settings
            move_phi = self.move_phi if settings.variable_phi else None
            play_round(len(self.moves), self.respond, settings.num_inner_rounds, move_phi)
        else:
            check_count("only", only, 0, len(self.moves) - 1)
            self.respond(only)

    def respond(self, d: int) -> None:
        """Move d: its player collects with the average of all players, and learns."""
        self._learn(d, self.moves[d].player)

    def move_phi(self) -> None:
        """The same in all domains, for what all players share."""
        self._learn(len(self.moves), len(self.players))

    def _learn(self, move: int, part: int) -> None:
        """Collect in the environments of a move, and improve a part."""
        average, distribution = self.learners.acting(), self.network.distribution
        rollout = self.collectors[move].collect(average, distribution, self.draws)
        self.num_frames += rollout.values[0].numel()
        self.improve(part, self._frames(move, rollout))

    def _frames(self, move: int, rollout: Rollout) -> Rollout:
        """What is learned from, ``[R, F]``."""
        return rollout.frames()

    def improve(self, part: int, frames: Rollout) -> None:
        """Some epochs of PPO for a part on frames ``[R, F]``, while all others stand still."""
        settings, learners = self.settings, self.learners
        others = learners.others(part, frames.observations)
        if settings.normalize_advantages == "rollout":
            frames = frames._replace(advantages=standardize(frames.advantages))
        for epoch in range(settings.num_epochs):
            skip = settings.skip_last_frames and epoch % 2 == 1
            for batch, rest in minibatches(frames, others, settings, self.orders, skip):
                outputs, pull_back = learners.vjp(part, batch.observations, rest)
                slopes = pull_back(*self._slopes(*outputs, batch))
                learners.step(part, slopes, settings.max_gradient_norm)

    def _slopes(self, parameters: Tensor, values: Tensor, batch: Rollout) -> tuple[Tensor, Tensor]:
        """Of the loss in the average's outputs."""
        return loss_gradient(self.network.distribution, parameters, values, batch, self.settings)

    def state(self) -> dict[str, Any]:
        """All that changes, as a tree of tensors and plain values; environments must have one.

        ``restore`` of a new training with the same arguments goes on from there.
        """
        return {
            "num_frames": self.num_frames,
            **self.learners.state(),
            "generators": [g.bit_generator.state for g in self._generators()],
            "collectors": [own.state() for own in self.collectors],
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from ``state()``.

        Raises:
            ValueError: see :meth:`ipo.network_players.NetworkPlayers.restore`.
        """
        self.learners.restore(state)
        self.num_frames = state["num_frames"]
        for generator, own in zip(self._generators(), state["generators"], strict=True):
            generator.bit_generator.state = own
        for collector, own in zip(self.collectors, state["collectors"], strict=True):
            collector.restore(own)

    def _generators(self) -> list[np.random.Generator]:
        return [*self.draws, *self.resets, *self.orders]


def minibatches(
    frames: Rollout,
    others: Sequence[Tensor],
    settings: PPOSettings,
    generators: Generators,
    skip_last_frames: bool,
) -> Iterator[tuple[Rollout, list[Tensor]]]:
    """``[R, B]`` of the frames and of ``others``, in an order of each run's own."""
    num_frames = frames.actions.shape[1]
    numbers = np.arange(num_frames)
    if skip_last_frames:
        numbers = numbers[(numbers + 1) % settings.num_steps != 0]
    order = torch.tensor(np.stack([generator.permutation(numbers) for generator in generators]))
    order = order.to(frames.actions.device)
    size = settings.size_of_minibatches(num_frames)
    # All in order at once, then in slices: cheaper than to choose for each minibatch.
    columns = [chosen_rows(x, order).split(size, dim=1) for x in (*frames, *others)]
    for batch in zip(*columns, strict=True):
        yield type(frames)(*batch[: len(frames)]), list(batch[len(frames) :])


def loss_gradient(
    distribution: type[Distribution],
    parameters: Tensor,
    values: Tensor,
    batch: Rollout,
    settings: PPOSettings,
) -> tuple[Tensor, Tensor]:
    """Of PPO's loss in each frame's parameters ``[R, B, P]`` and value ``[R, B]``.

    The loss, to be minimised, on a minibatch ``[R, B]``; G are the returns of the rollout::

        - mean min(rho A, clip(rho, 1 - c, 1 + c) A) - w_e mean H(pi)
        + w_v mean max((V - G)^2, (clip(V, V_old - c, V_old + c) - G)^2),
        rho = pi(a | o) / pi_old(a | o)

    Its gradient, by hand, for torch would take four times as long::

        - (1/B) [rho A grad log pi(a | o) + w_e grad H(pi)],        (2 w_v / B) (V - G)

    without rho A and V - G where the minimum and the maximum are those of the clipped numbers,
    which are constant. Without ``clip_values`` the value's part is that of (V - G)^2.
    """
    gain, near_gain = gains(distribution, parameters, batch, settings)
    error = values - batch.returns
    if settings.clip_values:
        near = values.clamp(batch.values - settings.clip, batch.values + settings.clip)
        error = error.masked_fill((near - batch.returns) ** 2 > error**2, 0.0)
    share = 1 / values.shape[1]
    weights = -share * gain.masked_fill(near_gain < gain, 0.0)
    of_parameters = distribution.gradient(
        parameters, batch.actions, weights, -share * settings.entropy_weight
    )
    return of_parameters, 2 * share * settings.value_weight * error


def gains(
    distribution: type[Distribution], parameters: Tensor, batch: Rollout, settings: PPOSettings
) -> tuple[Tensor, Tensor]:
    """``rho A`` and ``clip(rho) A``, ``[R, B]`` each."""
    advantages = batch.advantages
    if settings.normalize_advantages == "minibatch":
        advantages = standardize(advantages)
    ratio = distribution.log_probability(parameters, batch.actions) - batch.log_probabilities
    ratio = ratio.exp()
    return ratio * advantages, ratio.clamp(1 - settings.clip, 1 + settings.clip) * advantages


def standardize(gains: Tensor) -> Tensor:
    """``[R, B]`` with mean 0 and standard deviation 1 in each run."""
    return (gains - gains.mean(1, True)) / (gains.std(1, keepdim=True) + 1e-8)
