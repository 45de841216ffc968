"""Sealed files of tensors and plain values, the form of check-points and policies.

They are safetensors, which load without executing code, with plain values in their metadata.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import safetensors.torch
import torch

from experiments.sealed import DamagedError, read_sealed, write_sealed


def write_tensors(path: Path, tensors: Mapping[str, torch.Tensor], name: str, plain: Any) -> None:
    """Replace the file by tensors, and plain values under a name that says what they are."""
    write_sealed(path, safetensors.torch.save(dict(tensors), {name: json.dumps(plain)}))


def read_tensors(path: Path, name: str) -> tuple[dict[str, torch.Tensor], Any]:
    """Tensors, and the plain values of that name.

    Raises:
        DamagedError: a file that is damaged, or that holds something else.
    """
    content = read_sealed(path)
    try:
        tensors = safetensors.torch.load(content)
        header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
        return tensors, json.loads(header["__metadata__"][name])
    except (safetensors.SafetensorError, KeyError, ValueError, RecursionError) as error:
        raise DamagedError(f"{path}: holds no {name!r} with its tensors: {error}") from error
