"""The four methods of the paper's LQR tables, and two controls, as one game with different players.

Each method is a few lines that say who moves and what it wants. All of them train many runs
at once: every tensor has a leading run axis R, and runs never influence each other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from torch import Tensor

from ipo.checks import (
    Count,
    Natural,
    NonNegative,
    Positive,
    Seeds,
    check_checkpoints,
    checked,
    one_of,
)
from ipo.game import LinearPlayers, Order, play_round
from ipo.lqr import (
    LQR,
    Gains,
    feedback_costs,
    feedback_slopes,
    spectral_radius,
    split_domains,
    training_costs,
)
from ipo.optimizers import OPTIMIZERS, Slope, make_optimizer, step

LQR_METHODS = ("gradient_descent", "overparameterized", "ipo_fixed_phi", "ipo_variable_phi")
LQR_CONTROLS = ("in_turn", "ensemble")
Method = Annotated[str, one_of((*LQR_METHODS, *LQR_CONTROLS))]


@checked
@dataclass(frozen=True)
class LQRSettings:
    """How a method is trained. The defaults are the paper's, where it states them.

    Attributes:
        method: one of ``LQR_METHODS``, or of ``LQR_CONTROLS``.
        optimizer: ``adam`` (the published runs), ``plain`` (the paper's text) or ``lbfgs``.
        learning_rate: step size; the paper has 1e-3, and 5e-4 for IPO (Table 5).
        num_iterations: steps of the single player, or rounds of all players.
        weight_decay: decoupled, per unit of learning rate; the paper has none.
        max_gradient_norm: bound on each gradient's norm, run by run; the paper has none.
        num_hidden: rows of Phi, or width of the overparameterised controller.
        phi_scale: standard deviation of the initial entries of Phi (not published).
        gain_scale: the same for the controllers behind Phi (not published).
        order: of the players of ``ipo_fixed_phi``: ``in_turn`` (Algorithm 1) or ``together``.
    """

    method: Method
    optimizer: Annotated[str, one_of(OPTIMIZERS)] = "adam"
    learning_rate: Positive = 1e-3
    num_iterations: Natural = 5000
    weight_decay: NonNegative = 0.0
    max_gradient_norm: Positive | None = None
    num_hidden: Count = 200
    phi_scale: NonNegative = 0.001
    gain_scale: NonNegative = 0.001
    order: Order = "in_turn"


@checked
def published_lqr(method: Annotated[str, one_of(LQR_METHODS)]) -> LQRSettings:
    """The settings behind Tables 1 and 2; for Phi the reading that comes closest (see the book)."""
    if method == "ipo_fixed_phi":
        return LQRSettings(method, learning_rate=5e-4)
    if method == "ipo_variable_phi":
        return LQRSettings(method, learning_rate=5e-4, phi_scale=0.03, gain_scale=0.0)
    return LQRSettings(method)


@dataclass(frozen=True)
class Learner:
    """``iterate()`` is one round; ``gain()`` is the controller ``[R, n_u, n_o]`` that acts."""

    iterate: Callable[[], None]
    gain: Callable[[], Tensor]


@dataclass(frozen=True)
class DomainCost:
    """Of controllers ``K [R, n_u, n_o]`` in a domain; it knows its gradient.

    See :class:`ipo.game.WithSlope`: by hand the gradient takes half of autograd's time.

    Attributes:
        problem: R problems.
        seen: what the domain shows of the state, ``[R, n_o, n_x]``.
    """

    problem: LQR
    seen: Tensor

    def __call__(self, K: Tensor) -> Tensor:
        return feedback_costs(K @ self.seen, self.problem)

    def slope(self, K: Tensor, share: float = 1.0) -> Slope:
        costs, of_feedback = self.slope_in_feedback(torch.bmm(K, self.seen), share)
        return costs, [torch.bmm(of_feedback, self.seen.mT)]

    def slope_in_feedback(self, F: Tensor, share: float = 1.0) -> tuple[Tensor, Tensor]:
        """The same for ``F = K seen``."""
        return feedback_slopes(F, self.problem, share)


class PooledCost(DomainCost):
    """The mean over domains, ``seen [R, n_o, E n_x]`` side by side."""

    def __call__(self, K: Tensor) -> Tensor:
        return feedback_costs(self._by_domain(K @ self.seen), self.problem).mean(1)

    def slope_in_feedback(self, F: Tensor, share: float = 1.0) -> tuple[Tensor, Tensor]:
        share /= self.problem.num_domains
        costs, slopes = feedback_slopes(self._by_domain(F), self.problem, share)
        return costs.mean(1), slopes.transpose(1, 2).flatten(2)

    def _by_domain(self, F: Tensor) -> Tensor:
        return split_domains(F, self.problem.num_domains)


@checked
def gradient_descent(
    problem: LQR, settings: LQRSettings, start: Gains, seeds: Annotated[Seeds, "R"]
) -> Learner:
    """One player that owns all domains: gradient descent on the pooled cost of K."""
    player = _players(settings, start, num_players=1)
    cost = PooledCost(problem, problem.seen)
    return Learner(
        iterate=lambda: player.round([cost]),
        gain=lambda: player.policy,
    )


@checked
def overparameterized(
    problem: LQR, settings: LQRSettings, start: Gains, seeds: Annotated[Seeds, "R"]
) -> Learner:
    """The same player with a controller of two layers, ``K = K_2 K_1``, and one optimiser."""
    Phi, K = _random_layers(problem, settings, seeds)
    optimizer, cost = _optimizer(settings, [Phi, K]), PooledCost(problem, problem.seen)

    def slope_in_layers() -> Slope:
        costs, (of_gain,) = cost.slope(K @ Phi)
        return costs, [K.mT @ of_gain, of_gain @ Phi.mT]

    def respond(_: int) -> None:
        step(optimizer, slope_in_layers(), slope_in_layers, settings.max_gradient_norm)

    return Learner(
        iterate=lambda: play_round(1, respond),
        gain=lambda: K @ Phi,
    )


@checked
def ipo_fixed_phi(
    problem: LQR, settings: LQRSettings, start: Gains, seeds: Annotated[Seeds, "R"]
) -> Learner:
    """A player per domain, each with a whole controller; their average acts (Phi = identity)."""
    players = _players(settings, start, problem.num_domains)
    costs = _costs_of_domains(problem, problem.seen)
    return Learner(
        iterate=lambda: players.round(costs),
        gain=lambda: players.policy,
    )


@checked
def ipo_variable_phi(
    problem: LQR, settings: LQRSettings, start: Gains, seeds: Annotated[Seeds, "R"]
) -> Learner:
    """Phi moves on the pooled cost of all domains, then every player on its own, above Phi."""
    Phi, K = _random_layers(problem, settings, seeds)
    players = _players(settings, K, problem.num_domains)
    optimizer = _optimizer(settings, [Phi])
    pooled = PooledCost(problem, problem.seen)
    features = Phi @ problem.seen  # [R, n_h, E n_x], until Phi moves
    costs = _costs_of_domains(problem, features)

    def slope_in_phi(features: Tensor) -> Slope:
        costs, of_feedback = pooled.slope_in_feedback(players.policy @ features)
        return costs, [players.policy.mT @ (of_feedback @ problem.seen.mT)]

    def move_phi() -> None:
        nonlocal features
        step(
            optimizer,
            slope_in_phi(features),
            lambda: slope_in_phi(Phi @ problem.seen),
            settings.max_gradient_norm,
        )
        features = Phi @ problem.seen
        costs[:] = _costs_of_domains(problem, features)

    return Learner(
        iterate=lambda: players.round(costs, move_phi=move_phi),
        gain=lambda: players.policy @ Phi,
    )


@checked
def in_turn(
    problem: LQR, settings: LQRSettings, start: Gains, seeds: Annotated[Seeds, "R"]
) -> Learner:
    """IPO without players: one controller, whose one optimiser visits the domains in turn."""
    player = _players(settings, start, num_players=1)
    costs = _costs_of_domains(problem, problem.seen)
    return Learner(
        iterate=lambda: play_round(len(costs), lambda d: player.round([costs[d]])),
        gain=lambda: player.policy,
    )


@checked
def ensemble(
    problem: LQR, settings: LQRSettings, start: Gains, seeds: Annotated[Seeds, "R"]
) -> Learner:
    """IPO without its domains: as many players, each of which moves on the pooled cost."""
    players = _players(settings, start, problem.num_domains)
    costs = [PooledCost(problem, problem.seen)] * problem.num_domains
    return Learner(
        iterate=lambda: players.round(costs),
        gain=lambda: players.policy,
    )


LEARNERS = {
    method.__name__: method
    for method in (
        *(gradient_descent, overparameterized, ipo_fixed_phi, ipo_variable_phi),
        *(in_turn, ensemble),
    )
}


@checked
def train(
    problem: LQR,
    settings: LQRSettings,
    seeds: Annotated[Seeds, "R"],
    start: Gains | None = None,
    checkpoints: Sequence[Natural] = (),
) -> Iterator[tuple[int, Tensor]]:
    """Train all runs of ``problem`` at once.

    Args:
        problem: R problems.
        settings: the method and how it is trained.
        seeds: R seeds, from which each run draws the random start of its Phi.
        start: controllers ``[R, n_u, n_o]`` to start from; zero if none is given. Methods
            with a Phi start from random layers instead.
        checkpoints: iterations after which to report, besides the last.

    Yields:
        ``(iteration, gain [R, n_u, n_o])`` at the checkpoints and at the end.

    Raises:
        ValueError: seeds or start of the wrong number or shape, a start with NaN, a start
            with an unstable closed loop, a checkpoint after the end; before anything is trained.
    """
    check_checkpoints(checkpoints, settings.num_iterations)
    start = _checked_start(problem, settings, start)
    make = LEARNERS[settings.method]
    if settings.optimizer == "lbfgs":  # its curvature model would mix the runs: one at a time
        learners = [
            make(problem.run(r), settings, start[r : r + 1], [seed]) for r, seed in enumerate(seeds)
        ]
    else:
        learners = [make(problem, settings, start, seeds)]
    _check_stable("start", torch.cat([learner.gain() for learner in learners]), problem)

    wanted = {*checkpoints, settings.num_iterations}
    for iteration in range(settings.num_iterations + 1):
        if iteration in wanted:
            yield iteration, torch.cat([learner.gain() for learner in learners])
        if iteration < settings.num_iterations:
            for learner in learners:
                learner.iterate()


def _costs_of_domains(problem: LQR, seen: Tensor) -> list[DomainCost]:
    """One for each training domain, of what is ``seen [R, rows, E n_x]`` in all of them."""
    # One block for each domain: twice as fast.
    parts = split_domains(seen, problem.num_domains).unbind(1)
    return [DomainCost(problem, part.contiguous()) for part in parts]


def _players(settings: LQRSettings, start: Tensor, num_players: int) -> LinearPlayers:
    """All start at the same controller ``[R, n_u, ...]``, and so does their average."""
    return LinearPlayers(
        start.unsqueeze(1).expand(-1, num_players, -1, -1),
        lambda weights: _optimizer(settings, weights),
        max_gradient_norm=settings.max_gradient_norm,
        order=settings.order,
    )


def _optimizer(settings: LQRSettings, weights: Sequence[Tensor]) -> torch.optim.Optimizer:
    return make_optimizer(
        settings.optimizer, weights, settings.learning_rate, settings.weight_decay
    )


def _random_layers(
    problem: LQR, settings: LQRSettings, seeds: Sequence[int]
) -> tuple[Tensor, Tensor]:
    """Random ``Phi [R, n_h, n_o]`` and controller ``[R, n_u, n_h]``, a stream for each run."""
    num_inputs, num_observations = problem.gain_shape

    def draw(seed: int) -> tuple[np.ndarray, np.ndarray]:
        generator = np.random.default_rng(np.random.SeedSequence(seed).spawn(1)[0])
        return (
            settings.phi_scale * generator.standard_normal((settings.num_hidden, num_observations)),
            settings.gain_scale * generator.standard_normal((num_inputs, settings.num_hidden)),
        )

    layers = zip(*map(draw, seeds), strict=True)
    Phi, K = (torch.tensor(np.stack(layer)).to(problem.A) for layer in layers)
    return Phi, K


def _checked_start(problem: LQR, settings: LQRSettings, start: Tensor | None) -> Tensor:
    if start is None:
        return torch.zeros(problem.num_runs, *problem.gain_shape, dtype=problem.A.dtype)
    if settings.method in ("overparameterized", "ipo_variable_phi"):
        raise ValueError(f"start: {settings.method} starts from random layers, not from a gain")
    return start


def _check_stable(name: str, K: Tensor, problem: LQR) -> None:
    unstable = torch.isinf(training_costs(K, problem)).nonzero()
    if len(unstable):
        r, d = unstable[0].tolist()
        radius = float(spectral_radius(K, problem, problem.W_train[:, d])[r])
        raise ValueError(
            f"{name}: the closed loop of run {r} in training domain {d} has spectral radius "
            f"{radius:.4f}, must be below 1 for the cost to be finite"
        )
