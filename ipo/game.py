"""The game behind IPO: who moves on which domains, one round of Algorithm 1, and the Nash gap.

Every player owns some training domains. The players' policies are averaged, and the average acts
in all domains. In a round each player in turn changes its own weights so that the cost of *its*
domains falls, while the others stand still. All methods of the book are this game:

    pooled training (gradient descent, PPO)     one player that owns all domains
    IPO, IRM-Games                              a player for each domain
    ensemble                                    as many players, each of which owns all domains
    one domain at a time                        one player, who moves on each domain in turn

Players are linear controllers and predictors (:class:`LinearPlayers`, here) or networks
(``ipo.ppo``); they all play :func:`play_round`.

Source: Algorithm 1 of Sonar, Pacelli and Majumdar (2021), after Ahuja et al. (2020).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated, NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from ipo.checks import Count, Positive, check_count, checked, one_of
from ipo.optimizers import Slope, differentiate, step

GAMES = ("pooled", "ipo", "ensemble", "in_turn")
ORDERS = ("in_turn", "together")
Order = Annotated[str, one_of(ORDERS)]

Cost = Callable[[Tensor], Tensor]  # policy [R, ...] -> [R]; see also WithSlope
BestCosts = Annotated[Tensor, "R E"] | Annotated[Tensor, "R 1"]


class Move(NamedTuple):
    """Who moves, and the domains whose cost is to fall."""

    player: int
    domains: list[int]


@checked
def moves(method: Annotated[str, one_of(GAMES)], num_domains: Count) -> list[Move]:
    """The moves of a round.

    ``pooled`` is one player that owns all domains; in ``ipo`` each domain has a player of its own;
    an ``ensemble`` has as many players as ``ipo``, and each owns all domains. ``in_turn`` is a
    control between them: one player that visits the domains as IPO's players do.
    """
    everything = list(range(num_domains))
    return {
        "pooled": [Move(0, everything)],
        "ipo": [Move(d, [d]) for d in everything],
        "ensemble": [Move(d, everything) for d in everything],
        "in_turn": [Move(0, [d]) for d in everything],
    }[method]


def play_round(
    num_moves: int,
    respond: Callable[[int], None],
    num_inner_rounds: int = 1,
    move_phi: Callable[[], None] | None = None,
) -> None:
    """One iteration of Algorithm 1, whatever the players are made of.

    Args:
        num_moves: one for each player, who own the domains; see :func:`moves`.
        respond: ``respond(d)`` makes move d, while all other players stand still.
        num_inner_rounds: K; it is 1 in all runs of the paper.
        move_phi: lets the part that all players share make its move on the cost of all domains;
            ``None``: Phi is fixed.
    """
    check_count("num_moves", num_moves)
    check_count("num_inner_rounds", num_inner_rounds)
    if move_phi is not None:  # lines 2 to 6
        move_phi()
    for _ in range(num_inner_rounds):  # line 7
        for d in range(num_moves):  # line 8
            respond(d)  # lines 9 and 10: what the next player sees is the new average


def average(players: Tensor) -> Tensor:
    """The averaged policy that acts: ``[R, E, ...] -> [R, ...]``.

    pi_av = (1 / n_d) sum_d pi_d        (Section 4 of the paper)
    """
    return players.mean(dim=1)


@runtime_checkable
class WithSlope(Protocol):
    """A cost that knows its gradient; that of any other is found by autograd."""

    def slope(self, policy: Tensor, share: float) -> Slope:
        """The cost ``[R]``, and ``share`` times its gradient in the policy."""


def slope(cost: Cost, policy: Tensor, share: float = 1.0) -> Slope:
    """A cost ``[R]`` and, as the only one, ``share`` times its gradient in the policy."""
    if isinstance(cost, WithSlope):
        return cost.slope(policy, share)
    policy = policy.detach().requires_grad_()
    return differentiate(cost(policy), [policy], share)


class LinearPlayers:
    """Players with policies that are linear in their weights: averaging weights averages policies.

    A player moves by one step of an optimiser of its own, down a cost of the average. It sees its
    own weights only through the average,

        pi_av = others_d + pi_d / n_d,

    so its gradient carries the factor ``1 / n_d``.

    Args:
        starts: the players' first weights ``[R, E, ...]``.
        optimizer: makes a player's optimiser of its weights ``[R, ...]``.
        bound: players stay within ``[-bound, bound]`` in every weight; ``None``: no bound.
        max_gradient_norm: bound on the norm of each player's gradient, run by run.
        order: ``in_turn`` (Algorithm 1), or ``together``: everybody at the same average.

    Attributes:
        players: the weights of each, ``[R, ...]``; they change in place.
        policy: their average ``[R, ...]``, which acts; it changes in place.
    """

    @checked
    def __init__(
        self,
        starts: Annotated[Tensor, "R E ..."],
        optimizer: Callable[[Sequence[Tensor]], torch.optim.Optimizer],
        bound: Positive | None = None,
        max_gradient_norm: Positive | None = None,
        order: Order = "in_turn",
    ) -> None:
        # One contiguous block for each player: its optimiser updates it at full speed.
        self.players = [
            start.clone(memory_format=torch.contiguous_format).requires_grad_()
            for start in starts.detach().unbind(1)
        ]
        self.policy = average(self.weights)
        self.optimizers = [optimizer([player]) for player in self.players]
        self.bound, self.max_gradient_norm, self.order = bound, max_gradient_norm, order

    @property
    def weights(self) -> Tensor:
        """A copy of the weights of all players ``[R, E, ...]``."""
        return torch.stack([player.detach() for player in self.players]).transpose(0, 1)

    def round(
        self,
        costs: Sequence[Cost],
        num_inner_rounds: int = 1,
        move_phi: Callable[[], None] | None = None,
    ) -> None:
        """One iteration of Algorithm 1, where player d wants ``costs[d](policy)`` to be low."""
        if len(costs) != len(self.players):
            raise ValueError(f"costs: are {len(costs)}, must be one for each player")
        move = self._move_in_turn if self.order == "in_turn" else self._move_together
        play_round(len(self.players), lambda d: move(d, costs[d]), num_inner_rounds, move_phi)

    def _move_in_turn(self, d: int, cost: Cost) -> None:
        """Player d steps; the average holds its new weights before the next player moves."""
        player, share = self.players[d].detach(), 1 / len(self.players)
        first = slope(cost, self.policy, share)
        # In place, because it is large: what is left is the others' part.
        self.policy.sub_(player, alpha=share)
        self._step(d, first, lambda: slope(cost, self.policy.add(player, alpha=share), share))
        self.policy.add_(player, alpha=share)

    def _move_together(self, d: int, cost: Cost) -> None:
        """Player d steps; the average changes when the last has moved."""
        player, share = self.players[d].detach(), 1 / len(self.players)
        first = slope(cost, self.policy, share)
        others = self.policy.sub(player, alpha=share)
        self._step(d, first, lambda: slope(cost, others.add(player, alpha=share), share))
        if d == len(self.players) - 1:
            self.policy.copy_(average(self.weights))

    def _step(self, d: int, first: Slope, again: Callable[[], Slope]) -> None:
        step(self.optimizers[d], first, again, self.max_gradient_norm)
        if self.bound is not None:
            self.players[d].detach().clamp_(-self.bound, self.bound)


@checked
def nash_gap(costs: Annotated[Tensor, "R E"], best_costs: BestCosts) -> Tensor:
    """How much the player who could gain most would gain by moving alone.

        gap = max_d [ J_d(pi_av) - min over pi_d of J_d(pi_av) ]

    Args:
        costs: ``[R, E]``, every player's cost at the current average.
        best_costs: the same at that player's best response to the others; or ``[R, 1]``.

    Returns:
        ``[R]``; zero exactly at a Nash equilibrium.
    """
    return (costs - best_costs).amax(dim=1)
