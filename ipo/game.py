"""The game behind IPO: who owns which domains, one round of Algorithm 1, and the Nash gap.

Every player owns some training domains. The players' policies are averaged, and the average acts
in all domains. In a round each player in turn changes its own weights so that the cost of *its*
domains falls, while the others stand still. All methods of the book are this game:

    pooled training (gradient descent, PPO)     one player that owns all domains
    IPO, IRM-Games                              a player for each domain
    ensemble                                    as many players, each of which owns all domains

Players are linear controllers and predictors (:class:`LinearPlayers`, here) or networks
(``ipo.ppo``); they all play :func:`play_round`.

Source: Algorithm 1 of Sonar, Pacelli and Majumdar (2021), after Ahuja et al. (2020).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated

import torch
from torch import Tensor

from ipo.checks import Count, Positive, check_count, checked, one_of
from ipo.optimizers import descend

OWNERSHIPS = ("pooled", "ipo", "ensemble")
ORDERS = ("in_turn", "together")
Order = Annotated[str, one_of(ORDERS)]

Cost = Callable[[Tensor], Tensor]  # policy [R, ...] -> [R]
BestCosts = Annotated[Tensor, "R E"] | Annotated[Tensor, "R 1"]


@checked
def domains_of_players(
    method: Annotated[str, one_of(OWNERSHIPS)], num_domains: Count
) -> list[list[int]]:
    """The domains that each player owns.

    ``pooled`` is one player that owns all; in ``ipo`` each domain has a player of its own; an
    ``ensemble`` has as many players as ``ipo``, and each owns all domains.
    """
    everything = list(range(num_domains))
    return {
        "pooled": [everything],
        "ipo": [[d] for d in everything],
        "ensemble": [everything] * num_domains,
    }[method]


def play_round(
    num_players: int,
    respond: Callable[[int], None],
    num_inner_rounds: int = 1,
    move_phi: Callable[[], None] | None = None,
) -> None:
    """One iteration of Algorithm 1, whatever the players are made of.

    Args:
        num_players: E.
        respond: ``respond(d)`` makes player d's move while the others stand still.
        num_inner_rounds: K; it is 1 in all runs of the paper.
        move_phi: lets the part that all players share make its move on the cost of all domains;
            ``None``: Phi is fixed.
    """
    check_count("num_players", num_players)
    check_count("num_inner_rounds", num_inner_rounds)
    if move_phi is not None:  # lines 2 to 6
        move_phi()
    for _ in range(num_inner_rounds):  # line 7
        for d in range(num_players):  # line 8
            respond(d)  # lines 9 and 10: what the next player sees is the new average


def average(players: Tensor) -> Tensor:
    """The averaged policy that acts: ``[R, E, ...] -> [R, ...]``.

    pi_av = (1 / n_d) sum_d pi_d        (Section 4 of the paper)
    """
    return players.mean(dim=1)


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
        self._seen = self.policy.clone().requires_grad_()  # what a player differentiates
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
        self.policy.sub_(player, alpha=share)  # in place, because it is large: the others' part
        self._step(d, cost, self.policy)
        self.policy.add_(player, alpha=share)

    def _move_together(self, d: int, cost: Cost) -> None:
        """Player d steps; the average changes when the last has moved."""
        player, share = self.players[d].detach(), 1 / len(self.players)
        self._step(d, cost, self.policy - share * player)
        if d == len(self.players) - 1:
            self.policy.copy_(average(self.weights))

    def _step(self, d: int, cost: Cost, others: Tensor) -> None:
        player, share = self.players[d].detach(), 1 / len(self.players)

        def objective() -> Tensor:
            with torch.no_grad():
                torch.add(others, player, alpha=share, out=self._seen)
            return cost(self._seen)

        descend(self.optimizers[d], objective, self.max_gradient_norm, self._seen, share)
        if self.bound is not None:
            player.clamp_(-self.bound, self.bound)


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
