"""Players that are networks: their outputs are averaged, and each moves by an optimiser of its own.

They are what :class:`ipo.game.LinearPlayers` are where policies are linear. What moves at a time is
a *part*: all weights of a player, or those above Phi; and Phi itself, where players share it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import reduce
from typing import Annotated, Any

import torch
from torch import Tensor

from ipo.checks import checked
from ipo.networks import Acting, Network, Outputs, PullBack, Weights
from ipo.optimizers import clip_gradient


class NetworkPlayers:
    """R runs of E players. A player sees its own outputs only through the average,

        parameters = others_d + parameters_d / E,

    so what it learns carries the factor ``1 / E``.

    Args:
        network: one player's outputs; its ``frozen(players)`` is the average that acts.
        starts: the players' first weights, E of them.
        optimizer: makes a part's optimiser of its weights ``[R, P]``.
        variable_phi: whether players share the network's Phi, the last part, of the first player.

    Attributes:
        players: weights of every player; they change in place.
        parts: by name, the weights that move at a time.
        rows: the same memory as one ``[R, P]`` for each part, which the optimisers move; some zeros
            at the end.

    Raises:
        ValueError: a variable Phi of a network that has none.
    """

    @checked
    def __init__(
        self,
        network: Network,
        starts: Annotated[Sequence[Weights], "E"],
        optimizer: Callable[[Tensor], torch.optim.Optimizer],
        variable_phi: bool = False,
    ) -> None:
        if variable_phi and not network.phi:
            raise ValueError("variable_phi = True: needs a network that has a phi")
        self.network = network
        names, everybody = list(starts[0]), list(range(len(starts)))
        shared = network.phi if variable_phi else ()
        phi = [name for name in names if name.split(".")[0] in shared]
        parts = [{name: own[name] for name in names if name not in phi} for own in starts]
        self.members = [[d] for d in everybody]  # the players of whom a part is a part
        if phi:
            parts.append({name: starts[0][name] for name in phi})
            self.members.append(everybody)
        self.rows, self.parts = map(list, zip(*map(in_one_row, parts), strict=True))
        self.optimizers = [optimizer(row) for row in self.rows]
        self.players = [
            {name: (self.parts[-1] if name in phi else self.parts[d])[name] for name in names}
            for d in everybody
        ]

    def acting(self) -> Acting:
        """Their average as it is now."""
        return self.network.frozen(self.players)

    def others(self, part: int, observations: Tensor) -> list[Tensor]:
        """What those who stand still contribute to the average; nothing where there are none."""
        others = [p for e, p in enumerate(self.players) if e not in self.members[part]]
        if not others:
            return []
        share = len(others) / len(self.players)
        return [share * output for output in self.network.frozen(others)(observations)]

    def vjp(
        self, part: int, observations: Tensor, others: Sequence[Tensor]
    ) -> tuple[Outputs, PullBack]:
        """The average's outputs, and what takes slopes in them to those in a part's weights.

        Phi has a part in all players' outputs, so its slopes are the sum over players.
        """
        found = [self.network.vjp(self.players[e], observations) for e in self.members[part]]
        outputs, pull_backs = zip(*found, strict=True)
        share, names, own = 1 / len(self.players), list(self.players[0]), self.parts[part]

        def pull_back(*slopes: Tensor) -> list[Tensor]:
            shares = [share * slope for slope in slopes]
            by_player = zip(*(back(*shares) for back in pull_backs), strict=True)
            return [
                reduce(torch.add, slopes)
                for name, slopes in zip(names, by_player, strict=True)
                if name in own
            ]

        parameters, values = (
            share * reduce(torch.add, each) for each in zip(*outputs, strict=True)
        )
        if others:
            parameters, values = others[0] + parameters, others[1] + values
        return (parameters, values), pull_back

    def step(self, part: int, slopes: Sequence[Tensor], max_gradient_norm: float) -> None:
        """Move a part down the slopes in its weights, of a bounded norm in each run."""
        self.rows[part].grad = clip_gradient(side_by_side(slopes), max_gradient_norm)
        self.optimizers[part].step()

    @torch.no_grad()
    def set(self, players: Sequence[Weights]) -> None:
        """Go on from other weights; what the optimisers remember stays."""
        have, want = (
            [{name: weight.shape for name, weight in player.items()} for player in of]
            for of in (players, self.players)
        )
        if have != want:
            raise ValueError(f"players: of shapes {have}, must be {want}")
        for own, weights in zip(self.players, players, strict=True):
            for name, weight in own.items():
                weight.copy_(weights[name])

    def state(self) -> dict[str, Any]:
        """Weights, and what the optimisers remember, as a tree of tensors."""
        moments = [list(own.state_dict()["state"].values()) for own in self.optimizers]
        return {"players": self.players, "optimizers": moments}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from ``state()``.

        Raises:
            ValueError: a state of other weights, or of a version that kept moments for each weight.
        """
        for row, moments in zip(self.rows, state["optimizers"], strict=True):
            shapes = [tuple(own["exp_avg"].shape) for own in moments]
            if shapes not in ([], [row.shape]):  # the fused Adam would read beyond their ends
                raise ValueError(f"state: has moments of shapes {shapes}, must be {[row.shape]}")
        self.set(state["players"])
        for optimizer, moments in zip(self.optimizers, state["optimizers"], strict=True):
            groups = optimizer.state_dict()["param_groups"]
            optimizer.load_state_dict({"state": dict(enumerate(moments)), "param_groups": groups})


def in_one_row(weights: Weights) -> tuple[Tensor, Weights]:
    """A copy with all weights of a run in one row ``[R, P]``, and its parts by name.

    They share their memory, so an optimiser has one tensor to move instead of many.
    """
    row = side_by_side(list(weights.values()))
    sizes = [w[0].numel() for w in weights.values()]
    parts = row[:, : sum(sizes)].split(sizes, 1)
    named = zip(weights.items(), parts, strict=True)
    return row, {name: part.unflatten(1, w.shape[1:]) for (name, w), part in named}


def side_by_side(parts: Sequence[Tensor]) -> Tensor:
    """``[R, ...]`` each, in one row ``[R, P]``, with zeros up to a multiple of 16.

    Processors take up to so many numbers at a time, and round those alone that are left over:
    with rows of that length, no run's rounding depends on how many there are.
    """
    flat = [part.flatten(1) for part in parts]
    left = -sum(part.shape[1] for part in flat) % 16
    return torch.cat([*flat, flat[0].new_zeros(len(flat[0]), left)], 1)
