"""The game between players whose policies are short vectors, for many problems at once.

Everything that the book says about what the game does in principle is checked here: a policy is
``w [R, P]``, R problems with P weights each, and a domain is a cost ``J_d(w) [R]``. Rounds and
averages are those of :mod:`ipo.game`, optimisers those of :mod:`ipo.optimizers`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ipo.checks import check_choice, check_count, check_number
from ipo.game import average, best_response_round, nash_gap, new_players, split_players
from ipo.optimizers import descend, make_optimizer

METHODS = ("pooled", "ipo", "ensemble", "separate")
ORDERS = ("in_turn", "together")

Cost = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class Settings:
    """How the players move.

    Attributes:
        method: ``pooled`` is one player that owns all domains, ``ipo`` a player for each domain,
            ``ensemble`` as many players, each of which owns all domains; in ``separate``
            everybody trains a policy of its own, and they are averaged only at the end.
        optimizer: ``plain`` or ``adam``, one for each player.
        learning_rate: of each player.
        num_rounds: in each of which every player makes one step.
        bound: players stay within ``[-bound, bound]`` in every weight; ``None``: no bound.
        order: ``in_turn`` (Algorithm 1), or ``together``: everybody at the same average.
        max_gradient_norm: bound on the norm of each player's gradient.
    """

    method: str
    optimizer: str = "plain"
    learning_rate: float = 0.05
    num_rounds: int = 5000
    bound: float | None = None
    order: str = "in_turn"
    max_gradient_norm: float | None = None

    def __post_init__(self) -> None:
        check_choice("method", self.method, METHODS)
        check_choice("optimizer", self.optimizer, ("plain", "adam"))
        check_choice("order", self.order, ORDERS)
        check_number("learning_rate", self.learning_rate, above=0)
        check_count("num_rounds", self.num_rounds, minimum=0)
        for name in ("bound", "max_gradient_norm"):
            if getattr(self, name) is not None:
                check_number(name, getattr(self, name), above=0)


def play(
    costs: Sequence[Cost], start: Tensor, settings: Settings, checkpoints: Sequence[int] = ()
) -> Iterator[tuple[int, Tensor]]:
    """Play the game of these domains.

    All players begin at ``start [R, P]``, or each at its own ``start [R, E, P]``.

    Yields:
        ``(round, players [R, E, P])`` at the checkpoints and at the end.

    Raises:
        ValueError: no domain, a start that is not finite or whose cost is not, before any move.
    """
    _check_start(costs, start)
    together = [lambda w: torch.stack([cost(w) for cost in costs]).mean(0)]
    objectives = {
        "pooled": together,
        "ensemble": together * len(costs),
        "ipo": costs,
        "separate": costs,
    }[settings.method]
    weights = new_players(start.shape[0], len(objectives), start.shape[-1:], dtype=start.dtype)
    weights += start if start.dim() == 3 else start.unsqueeze(1)
    move = _mover(weights, objectives, settings)
    wanted = {*checkpoints, settings.num_rounds}
    for number in range(settings.num_rounds + 1):
        if number in wanted:
            yield number, weights.clone()
        if number < settings.num_rounds:
            move()


def last(costs: Sequence[Cost], start: Tensor, settings: Settings) -> Tensor:
    """The players ``[R, E, P]`` at the end of :func:`play`."""
    *_, (_, players) = play(costs, start, settings)
    return players


def wishes(costs: Sequence[Cost], policy: Tensor) -> Tensor:
    """The downhill direction ``- grad J_d [R, E, P]`` of each domain at a policy ``[R, P]``."""
    leaf = policy.detach().requires_grad_()
    gradients = [torch.autograd.grad(cost(leaf).sum(), leaf)[0] for cost in costs]
    return -torch.stack(gradients, dim=1)


def residual(costs: Sequence[Cost], players: Tensor, bound: float | None = None) -> Tensor:
    """How far from an equilibrium, ``[R]``: the largest step that a player would still make.

        max over d, i of abs(clip(w_d - grad_d J_d, -bound, bound) - w_d),    grad_d = grad / E

    It is zero where every player's first-order conditions hold, bounds included; for convex
    costs that is exactly at a Nash equilibrium.
    """
    limit = torch.inf if bound is None else bound
    steps = wishes(costs, average(players)) / players.shape[1]
    return ((players + steps).clamp(-limit, limit) - players).abs().flatten(1).amax(1)


def gap(costs: Sequence[Cost], players: Tensor, alone: Settings) -> Tensor:
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


def vote(optima: Tensor, bound: float) -> Tensor:
    """Where bounded players' average stands at equilibrium, weight by weight: ``[..., P]``.

    For costs that are separable and convex in the weights, with optima ``b_d [..., E, P]``:

        w = median of { b_1, ..., b_E,  M, M (E - 2) / E, ..., M (E - 2 k) / E, ..., -M },

    M the bound. The E + 1 numbers behind the optima are the averages of players that all stand
    at their bounds. Two domains and a wide bound: zero where signs differ, else the optimum
    nearer to zero (Ahuja, Shanmugam and Dhurandhar, 2021). The book has the proof.
    """
    check_number("bound", bound, above=0)
    num = optima.shape[-2]
    phantoms = bound * (1 - 2 * torch.arange(num + 1, dtype=optima.dtype) / num)
    phantoms = phantoms.unsqueeze(-1).expand(*optima.shape[:-2], -1, optima.shape[-1])
    return torch.cat([optima, phantoms], dim=-2).median(dim=-2).values


def _mover(weights: Tensor, objectives: Sequence[Cost], settings: Settings) -> Callable[[], None]:
    """A function that lets every player make one step."""
    limit = torch.inf if settings.bound is None else settings.bound
    players = split_players(weights)
    policy = average(weights)
    optimizers = [
        make_optimizer(settings.optimizer, [player], settings.learning_rate) for player in players
    ]

    def respond(d: int, policy_of_d: Callable[[], Tensor]) -> None:
        seen = (lambda: players[d]) if settings.method == "separate" else policy_of_d
        descend(optimizers[d], lambda: objectives[d](seen()), settings.max_gradient_norm)
        players[d].detach().clamp_(-limit, limit)

    def all_at_once() -> None:
        share = 1 / len(players)
        others = [policy - share * player.detach() for player in players]
        for d, player in enumerate(players):
            respond(d, lambda d=d, player=player: others[d] + share * player)
        policy.copy_(average(weights))

    if settings.order == "together":
        return all_at_once
    return lambda: best_response_round(players, policy, respond)


def _check_start(costs: Sequence[Cost], start: Tensor) -> None:
    if not costs:
        raise ValueError("costs: there is no domain, must be at least one")
    if not bool(torch.isfinite(start).all()):
        raise ValueError("start: holds NaN or infinite weights, must be finite")
    policy = average(start) if start.dim() == 3 else start
    for d, cost in enumerate(costs):
        if not bool(torch.isfinite(cost(policy)).all()):
            raise ValueError(f"start: costs infinitely much in domain {d}, must be finite")
