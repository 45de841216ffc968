"""Files of policies: the weights of all players and runs, and what they were made for."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
import torch

from experiments.files import replace_bytes
from ipo.networks import Network, Weights


def save_policy(path: str | Path, players: Sequence[Weights], about: dict[str, Any]) -> None:
    """Write the weights of all players and runs to a file that loads without executing code."""
    tensors = {
        f"{d}.{name}": weight.detach().contiguous()
        for d, player in enumerate(players)
        for name, weight in player.items()
    }
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_bytes(path, safetensors.torch.save(tensors, {"about": json.dumps(about)}))


def load_policy(
    path: str | Path, network: Network, about: dict[str, Any] | None = None
) -> tuple[list[Weights], dict[str, Any]]:
    """Weights of every player and run, and what the file says about them.

    Raises:
        ValueError: a file that is cut short, that holds weights of another network or NaN, or
            that was not made for ``about``.
    """
    try:
        with safetensors.safe_open(path, "pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            found = dict(json.loads(file.metadata()["about"]))
        num_players = 1 + max(int(name.split(".")[0]) for name in tensors)
    except (safetensors.SafetensorError, TypeError, KeyError, ValueError) as error:
        raise ValueError(f"{path}: cannot be read as a policy: {error}") from error
    for name, value in (about or {}).items():
        if found.get(name) != value:
            raise ValueError(f"{path}: was made for {name} = {found.get(name)!r}, not {value!r}")
    players: list[Weights] = [{} for _ in range(num_players)]
    for d, player in enumerate(players):
        for name, shape in network.weight_shapes.items():
            weight = tensors.get(f"{d}.{name}")
            if weight is None or tuple(weight.shape[1:]) != shape:
                have = "nothing" if weight is None else tuple(weight.shape[1:])
                raise ValueError(f"{path}: {name} of player {d} has shape {have}, needs {shape}")
            num_runs = len(next(iter(players[0].values()), weight))
            if len(weight) != num_runs:
                raise ValueError(
                    f"{path}: {name} of player {d} has {len(weight)} runs, must have {num_runs}"
                )
            if not bool(torch.isfinite(weight).all()):
                raise ValueError(f"{path}: {name} of player {d} holds NaN or infinite weights")
            player[name] = weight
    return players, found
