"""Files of policies: the weights of all players and runs, and what they were made for.

Safetensors behind a seal, as check-points are (:mod:`experiments.tensors`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.experiment import difference, filled, plain
from experiments.tensors import read_tensors, write_tensors
from ipo.networks import Network, Weights


def save_policy(
    path: str | Path,
    players: Sequence[Weights],
    made_for: Mapping[str, Any],
    notes: Mapping[str, Any] | None = None,
) -> None:
    """Write the weights of all players and runs to a file that loads without executing code.

    Args:
        path: of the file; its folder is made.
        players: weights of every player.
        made_for: the cell with all its options, the runs, and what else tells policies apart.
        notes: what else the file is to say.

    Raises:
        ValueError: the file is there and holds the policy of something else.
    """
    check_place(path, made_for)
    tensors = {
        f"{d}.{name}": weight.detach().contiguous()
        for d, player in enumerate(players)
        for name, weight in player.items()
    }
    write_tensors(Path(path), tensors, "about", plain({**made_for, **(notes or {})}))


def check_place(path: str | Path, made_for: Mapping[str, Any]) -> None:
    """A policy may be written where none is, or one that was made for the same.

    Worth a look before a training, whose policy would have no place.

    Raises:
        ValueError: a policy of something else is there.
    """
    if Path(path).exists():
        _, found = read_tensors(Path(path), "about")
        _check_made_for(path, found, made_for)


def load_policy(
    path: str | Path, network: Network, made_for: Mapping[str, Any] | None = None
) -> tuple[list[Weights], dict[str, Any]]:
    """Weights of every player and run, and what the file says about them.

    Raises:
        ValueError: a file that is damaged, that holds weights of another network or NaN, or that
            was not made for ``made_for``.
    """
    tensors, found = read_tensors(Path(path), "about")
    _check_made_for(path, found, made_for or {})
    num_players = len({name.split(".")[0] for name in tensors})
    if len(tensors) > num_players * len(network.weight_shapes) or not num_players:
        raise ValueError(f"{path}: must hold {len(network.weight_shapes)} weights of each player")
    players = [_weights_of(path, d, tensors, network) for d in range(num_players)]
    num_runs = len(next(iter(players[0].values())))
    for d, player in enumerate(players):
        for name, weight in player.items():
            if len(weight) != num_runs:
                raise ValueError(
                    f"{path}: {name} of player {d} has {len(weight)} runs, must have {num_runs}"
                )
    return players, found


def _weights_of(path: str | Path, d: int, tensors: Mapping[str, Any], network: Network) -> Weights:
    """The weights of player d, as the network has them."""
    player = {}
    for name, shape in network.weight_shapes.items():
        weight = tensors.get(f"{d}.{name}")
        if weight is None or tuple(weight.shape[1:]) != shape:
            have = "nothing" if weight is None else tuple(weight.shape[1:])
            raise ValueError(f"{path}: {name} of player {d} has shape {have}, needs {shape}")
        if not bool(weight.isfinite().all()):
            raise ValueError(f"{path}: {name} of player {d} holds NaN or infinite weights")
        player[name] = weight
    return player


def _check_made_for(path: str | Path, found: Any, wanted: Mapping[str, Any]) -> None:
    if not isinstance(found, dict):
        raise ValueError(f"{path}: must say what it was made for")
    recorded = {name: found.get(name) for name in wanted}
    for name, value in wanted.items():
        if dataclasses.is_dataclass(value):
            recorded[name] = filled(type(value), recorded[name])
    if differs := difference(recorded, plain(wanted)):
        raise ValueError(f"{path}: was made for something else: {differs}")
