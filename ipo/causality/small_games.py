"""Games of two numbers, or few: players whose policies are short vectors, many problems at once.

Everything that the book says about what the game does in principle is checked here: a policy is
``w [R, P]``, R problems with P weights each, and a domain is a cost ``J_d(w) [R]``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import torch
from torch import Tensor

from ipo.checks import Natural, Positive, check_checkpoints, checked, one_of
from ipo.game import GAMES, Cost, LinearPlayers, Order, average, moves, nash_gap
from ipo.optimizers import make_optimizer

GAME_METHODS = (*GAMES, "separate")

Costs = Annotated[Sequence[Cost], "E"]  # of the domains
Players = Annotated[Tensor, "R E P"]
Start = Annotated[Tensor, "R P"] | Annotated[Tensor, "R players P"]


@checked
@dataclass(frozen=True)
class GameSettings:
    """How the players move.

    Attributes:
        method: ``pooled`` is one player that owns all domains, ``ipo`` a player for each domain,
            ``ensemble`` as many players, each of which owns all domains; ``in_turn`` is one player
            that visits the domains; in ``separate`` everybody trains a policy of its own, and they
            are averaged only at the end.
        optimizer: ``plain`` or ``adam``, one for each player.
        learning_rate: of each player.
        num_rounds: in each of which every player makes one step, or the only one a step on each
            domain.
        bound: players stay within ``[-bound, bound]`` in every weight; ``None``: no bound.
        order: ``in_turn`` (Algorithm 1), or ``together``: everybody at the same average.
        max_gradient_norm: bound on the norm of each player's gradient.
    """

    method: Annotated[str, one_of(GAME_METHODS)]
    optimizer: Annotated[str, one_of(("plain", "adam"))] = "plain"
    learning_rate: Positive = 0.05
    num_rounds: Natural = 5000
    bound: Positive | None = None
    order: Order = "in_turn"
    max_gradient_norm: Positive | None = None


@checked
def play(
    costs: Costs, start: Start, settings: GameSettings, checkpoints: Sequence[Natural] = ()
) -> Iterator[tuple[int, Tensor]]:
    """Play the game of these domains.

    All players begin at ``start [R, P]``, or each at its own ``start [R, E, P]``.

    Yields:
        ``(round, players [R, E, P])`` at the checkpoints and at the end.

    Raises:
        ValueError: no domain, a start that is not finite or whose cost is not, or of the wrong
            number of players, a checkpoint after the end; before any move.
    """
    check_checkpoints(checkpoints, settings.num_rounds)
    _check_start(costs, start, settings)
    if settings.method == "separate":
        yield from _play_separately(costs, start, settings, checkpoints)
        return
    made = moves(settings.method, len(costs))
    objectives = [_mean_of([costs[d] for d in move.domains]) for move in made]
    num_players = made[-1].player + 1
    starts = start if start.dim() == 3 else start.unsqueeze(1).expand(-1, num_players, -1)
    players = LinearPlayers(
        starts,
        lambda weights: make_optimizer(settings.optimizer, weights, settings.learning_rate),
        settings.bound,
        settings.max_gradient_norm,
        settings.order,
    )
    # Who visits the domains alone makes a round in each.
    visits = [objectives] if num_players == len(made) else [[own] for own in objectives]
    wanted = {*checkpoints, settings.num_rounds}
    for number in range(settings.num_rounds + 1):
        if number in wanted:
            yield number, players.weights
        if number < settings.num_rounds:
            for visited in visits:
                players.round(visited)


def _play_separately(
    costs: Sequence[Cost], start: Tensor, settings: GameSettings, checkpoints: Sequence[int]
) -> Iterator[tuple[int, Tensor]]:
    """Everybody is the only player of a game of its own, which all play side by side."""
    alone = replace(settings, method="pooled")
    starts = start.unbind(1) if start.dim() == 3 else [start] * len(costs)
    games = [play([cost], own, alone, checkpoints) for cost, own in zip(costs, starts, strict=True)]
    for reports in zip(*games, strict=True):
        yield reports[0][0], torch.cat([players for _, players in reports], dim=1)


def _mean_of(costs: Sequence[Cost]) -> Cost:
    """The cost of a player that owns these domains."""
    if len(costs) == 1:
        return costs[0]
    return lambda w: torch.stack([cost(w) for cost in costs]).mean(0)


@checked
def last(costs: Costs, start: Start, settings: GameSettings) -> Tensor:
    """The players ``[R, E, P]`` at the end of :func:`play`."""
    *_, (_, players) = play(costs, start, settings)
    return players


@checked
def downhill(costs: Costs, policy: Annotated[Tensor, "R P"]) -> Tensor:
    """The downhill direction ``- grad J_d [R, E, P]`` of each domain at a policy ``[R, P]``."""
    leaf = policy.detach().requires_grad_()
    gradients = [torch.autograd.grad(cost(leaf).sum(), leaf)[0] for cost in costs]
    return -torch.stack(gradients, dim=1)


@checked
def residual(
    costs: Costs, players: Annotated[Tensor, "R players P"], bound: Positive | None = None
) -> Tensor:
    """How far from an equilibrium, ``[R]``: the largest step that a player would still make.

        max over d, i of abs(clip(w_d - grad_d J_d, -bound, bound) - w_d),    grad_d = grad / E

    It is zero where every player's first-order conditions hold, bounds included; for convex
    costs that is exactly at a Nash equilibrium.
    """
    limit = torch.inf if bound is None else bound
    steps = downhill(costs, average(players)) / players.shape[1]
    return ((players + steps).clamp(-limit, limit) - players).abs().flatten(1).amax(1)


@checked
def gap(costs: Costs, players: Players, alone: GameSettings) -> Tensor:
    """The Nash gap ``[R]``: every player goes down alone as ``alone`` says, bounds included.

    It is a lower bound that is tight if ``alone`` has enough rounds to settle.
    """
    policy, num = average(players), players.shape[1]
    now = torch.stack([cost(policy) for cost in costs], 1)
    best = []
    for d, cost in enumerate(costs):
        others = policy - players[:, d] / num

        def own(w: Tensor, cost: Cost = cost, others: Tensor = others) -> Tensor:
            return cost(others + w / num)

        best.append(own(last([own], players[:, d], alone)[:, 0]))
    return nash_gap(now, torch.minimum(now, torch.stack(best, 1)))


@checked
def vote(optima: Annotated[Tensor, "... E P"], bound: Positive) -> Tensor:
    """Where bounded players' average stands at equilibrium, weight by weight: ``[..., P]``.

    For costs that are separable and convex in the weights, with optima ``b_d [..., E, P]``:

        w = median of { b_1, ..., b_E,  M, M (E - 2) / E, ..., M (E - 2 k) / E, ..., -M },

    M the bound. The E + 1 numbers behind the optima are the averages of players that all stand
    at their bounds. Two domains and a wide bound: zero where signs differ, else the optimum
    nearer to zero (Ahuja, Shanmugam and Dhurandhar, 2021). The book has the proof.
    """
    num = optima.shape[-2]
    phantoms = bound * (1 - 2 * torch.arange(num + 1, dtype=optima.dtype) / num)
    phantoms = phantoms.unsqueeze(-1).expand(*optima.shape[:-2], -1, optima.shape[-1])
    return torch.cat([optima, phantoms], dim=-2).median(dim=-2).values


def _check_start(costs: Sequence[Cost], start: Tensor, settings: GameSettings) -> None:
    num_players = 1 if settings.method in ("pooled", "in_turn") else len(costs)
    if start.dim() == 3 and start.shape[1] != num_players:
        raise ValueError(f"start: is of {start.shape[1]} players, must be of {num_players}")
    policy = average(start) if start.dim() == 3 else start
    for d, cost in enumerate(costs):
        if not bool(torch.isfinite(cost(policy)).all()):
            raise ValueError(f"start: costs infinitely much in domain {d}, must be finite")
