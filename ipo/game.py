"""The game behind IPO: players, their average, rounds of best responses, and the Nash gap.

Every domain has a player. The players' policies are averaged, and the average acts in all
domains. In a round each player in turn changes its own weights so that *its* domain's cost
falls, while the others stand still. Pooled training is the same game with one player that
owns all domains.

Source: Algorithm 1 of Sonar, Pacelli and Majumdar (2021), after Ahuja et al. (2020).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from ipo.checks import check_choice, check_count

METHODS = ("pooled", "ipo", "ensemble")  # who owns which domains


def domains_of_players(method: str, num_domains: int) -> list[list[int]]:
    """The domains that each player owns.

    ``pooled`` is one player that owns all; in ``ipo`` each domain has a player of its own; an
    ``ensemble`` has as many players as ``ipo``, and each owns all domains.
    """
    check_choice("method", method, METHODS)
    check_count("num_domains", num_domains)
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
    if move_phi is not None:  # lines 2 to 6
        move_phi()
    for _ in range(num_inner_rounds):  # line 7
        for d in range(num_players):  # line 8
            respond(d)  # lines 9 and 10: what the next player sees is the new average


def new_players(num_runs: int, num_players: int, shape: Sequence[int], **options) -> Tensor:
    """Weights of all players, zero: ``[runs, players, *shape]``.

    In memory the player axis comes first, so that the weights of one player are contiguous
    and its optimiser updates them in place at full speed.
    """
    return torch.zeros(num_players, num_runs, *shape, **options).transpose(0, 1)


def split_players(players: Tensor) -> list[Tensor]:
    """One leaf ``[runs, ...]`` per player, sharing memory with ``[runs, players, ...]``."""
    return [player.detach().requires_grad_() for player in players.unbind(dim=1)]


def average(players: Tensor) -> Tensor:
    """The averaged policy that acts: ``[runs, players, ...] -> [runs, ...]``.

    pi_av = (1 / n_d) sum_d pi_d        (Section 4 of the paper)
    """
    return players.mean(dim=1)


def best_response_round(
    players: Sequence[Tensor],
    policy: Tensor,
    respond: Callable[[int, Callable[[], Tensor]], None],
) -> None:
    """One round: in order, every player moves once while the others stand still.

    Lines 8 to 11 of Algorithm 1. A player sees its own weights only through the average,

        pi_av = others_d + pi_d / n_d,

    so its gradient carries the factor ``1 / n_d``.

    Args:
        players: the leaves of :func:`split_players`, updated in place.
        policy: their average ``[runs, ...]``, updated in place.
        respond: ``respond(d, policy_of_d)`` makes player d's move; ``policy_of_d()`` is the
            average as a function of the present weights of player d, and of them alone.
    """
    share = 1 / len(players)
    for d, player in enumerate(players):
        policy.sub_(player.detach(), alpha=share)  # now the others' part; in place, it is large
        respond(d, lambda player=player: policy.add(player, alpha=share))
        policy.add_(player.detach(), alpha=share)


def nash_gap(costs: Tensor, best_costs: Tensor) -> Tensor:
    """How much the player who could gain most would gain by moving alone.

        gap = max_d [ J_d(pi_av) - min over pi_d of J_d(pi_av) ]

    Args:
        costs: ``[runs, players]``, every player's cost at the current average.
        best_costs: the same at that player's best response to the others.

    Returns:
        ``[runs]``; zero exactly at a Nash equilibrium.
    """
    return (costs - best_costs).amax(dim=1)
