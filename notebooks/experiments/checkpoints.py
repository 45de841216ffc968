"""Check-points: a tree of tensors and plain values in a sealed file, which is whole or not used.

The one before is kept beside it. What a check-point holds is lost with it, so it goes only when
what was made of it is safe: see ``checkpoints`` of :class:`experiments.experiment.Experiment`.
"""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch

from experiments.sealed import DamagedError
from experiments.tensors import read_tensors, write_tensors

TENSOR = "tensor:"  # what stands in the JSON for a tensor, before its name


class CheckpointError(RuntimeError):
    """A check-point that cannot be written or read."""


class CheckpointWarning(UserWarning):
    """A check-point is damaged, and the one before is used."""


def save_checkpoint(path: str | Path, tree: Any) -> None:
    """Replace the check-point; the present one becomes the one before.

    Args:
        path: of the file; its folder is made.
        tree: dictionaries with keys that are strings, lists and tuples, tensors and arrays, plain
            values. Tuples come back as lists, arrays as tensors.

    Raises:
        CheckpointError: a file that cannot be written, as on a full disk. What was there stays.
    """
    path = Path(path)
    tensors: dict[str, torch.Tensor] = {}
    plain = _take_tensors(tree, "", tensors)
    new = _new(path)
    try:
        write_tensors(new, tensors, "tree", plain)
        if path.exists():
            os.replace(path, previous(path))
        os.replace(new, path)
    except OSError as error:
        if new.exists():
            new.unlink()
        raise CheckpointError(
            f"{path}: cannot be written ({error.strerror}); the check-points before it are whole"
        ) from error


def load_checkpoint(path: str | Path) -> Any | None:
    """The tree that was saved last, or None where nothing was.

    A damaged file is passed over with a :class:`CheckpointWarning`, and the one before is read.

    Raises:
        CheckpointError: all that is there is damaged.
    """
    path = Path(path)
    there = [candidate for candidate in (path, previous(path)) if candidate.exists()]
    for candidate in there:
        try:
            return _read(candidate)
        except DamagedError as error:
            warnings.warn(f"{error}; looking for the one before", CheckpointWarning, stacklevel=2)
    if there:
        raise CheckpointError(f"{path}: no check-point is whole; delete them to begin anew")
    return None


def previous(path: str | Path) -> Path:
    """Where the check-point before is kept."""
    path = Path(path)
    return path.with_name(f"{path.name}.previous")


def _new(path: Path) -> Path:
    """Where a check-point is written, before it takes the place of the present one."""
    return path.with_name(f"{path.name}.new")


def _read(path: Path) -> Any:
    tensors, plain = read_tensors(path, "tree")
    try:
        return _put_tensors(plain, tensors)
    except (KeyError, RecursionError) as error:
        raise DamagedError(f"{path}: holds no tree with its tensors: {error}") from error


def _take_tensors(tree: Any, name: str, tensors: dict[str, torch.Tensor]) -> Any:
    """The tree with names instead of its tensors, which go to ``tensors``."""
    if isinstance(tree, dict):
        return {key: _take_tensors(part, f"{name}/{key}", tensors) for key, part in tree.items()}
    if isinstance(tree, list | tuple):
        return [_take_tensors(part, f"{name}/{i}", tensors) for i, part in enumerate(tree)]
    if isinstance(tree, np.ndarray | torch.Tensor):
        tensors[name] = torch.as_tensor(tree).detach().clone().contiguous()
        return f"{TENSOR}{name}"
    return tree


def _put_tensors(tree: Any, tensors: dict[str, torch.Tensor]) -> Any:
    if isinstance(tree, dict):
        return {key: _put_tensors(part, tensors) for key, part in tree.items()}
    if isinstance(tree, list):
        return [_put_tensors(part, tensors) for part in tree]
    if isinstance(tree, str) and tree.startswith(TENSOR):
        return tensors[tree.removeprefix(TENSOR)]
    return tree
