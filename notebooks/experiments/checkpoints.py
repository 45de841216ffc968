"""Check-points: a tree of tensors and plain values in one file, which is whole or not used.

A file is the SHA-256 of what follows, a line feed, and a safetensors file whose metadata hold the
plain values as JSON; it loads without executing code. The one before is kept beside it.
"""

from __future__ import annotations

import hashlib
import json
import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch

from experiments.files import replace_bytes

TENSOR = "tensor:"  # what stands in the JSON for a tensor, before its name
DIGEST_LENGTH = 64


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
    plain = json.dumps(_take_tensors(tree, "", tensors))
    content = safetensors.torch.save(tensors, {"tree": plain})
    digest = hashlib.sha256(content).hexdigest().encode()
    new = path.with_name(f"{path.name}.new")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_bytes(new, digest + b"\n" + content)
        if path.exists():
            os.replace(path, previous(path))
        os.replace(new, path)
    except OSError as error:
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
        except CheckpointError as error:
            warnings.warn(f"{error}; looking for the one before", CheckpointWarning, stacklevel=2)
    if there:
        raise CheckpointError(f"{path}: no check-point is whole; delete them to begin anew")
    return None


def previous(path: str | Path) -> Path:
    """Where the check-point before is kept."""
    path = Path(path)
    return path.with_name(f"{path.name}.previous")


def _read(path: Path) -> Any:
    content = path.read_bytes()
    digest, body = content[:DIGEST_LENGTH], content[DIGEST_LENGTH + 1 :]
    if hashlib.sha256(body).hexdigest().encode() != digest:
        raise CheckpointError(f"{path}: is cut short or changed")
    header = json.loads(body[8 : 8 + int.from_bytes(body[:8], "little")])
    return _put_tensors(json.loads(header["__metadata__"]["tree"]), safetensors.torch.load(body))


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
