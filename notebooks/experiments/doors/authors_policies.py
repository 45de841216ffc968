"""The door policies that the paper's authors published, read as weights and nothing else.

Their files are pickles of whole Python objects. Here every object but a tensor becomes an empty
husk that only has attributes, so that no code in a file is executed, and none of theirs is needed.
"""

from __future__ import annotations

import collections
import pickle
import types
import warnings
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor

from experiments.doors.training import NETWORK
from ipo.networks import Weights

FOLDER = Path("DoorGym", "pretrained_models")

# Our name of a layer, and theirs. A policy of IPO has the layers of each player d = 1, 2; in one
# of PPO, d is nothing, and the last layers belong to a part of their own.
LAYERS = {
    "actor1": ("base.actor{d}.0",),
    "actor2": ("base.actor{d}.2",),
    "actor3": ("base.fc_mean{d}", "dist.fc_mean"),
    "critic1": ("base.critic{d}.0",),
    "critic2": ("base.critic{d}.2",),
    "critic3": ("base.critic_linear{d}",),
}
# What goes wrong where a file is cut short, or holds something else.
NOT_THEIRS = (
    pickle.UnpicklingError,
    EOFError,
    RuntimeError,
    LookupError,
    TypeError,
    AttributeError,
    ValueError,
)
LOG_STD = ("base.logstd{d}._bias", "dist.logstd._bias")


def authors_policies(repository: str | Path) -> dict[str, list[list[Weights]]]:
    """Players of every saved policy: ``{"ppo": [policies], "ipo": [policies]}``.

    Args:
        repository: a clone of github.com/irom-lab/Invariant-Policy-Optimization.

    Raises:
        TypeError: not a folder's path.
        FileNotFoundError: no policies there.
        ValueError: a file that is not one of theirs.
    """
    if not isinstance(repository, str | Path):
        raise TypeError(f"authors_repository = {repository!r}: must be the path of a folder")
    policies = {}
    for method in ("ppo", "ipo"):
        folder = Path(repository) / FOLDER / method
        paths = sorted(folder.glob("*.best.pt"))
        if not paths:
            raise FileNotFoundError(
                f"authors_repository = {str(repository)!r}: must have *.best.pt in {folder}"
            )
        policies[method] = [load_authors_policy(path) for path in paths]
    return policies


def load_authors_policy(path: str | Path) -> list[Weights]:
    """The players of one saved policy, with one run each."""
    try:
        with warnings.catch_warnings():  # that a husk has no source code to compare with theirs
            warnings.filterwarnings("ignore", message="Couldn't retrieve source code")
            saved = torch.load(path, map_location="cpu", pickle_module=_PICKLE, weights_only=False)
        tensors = _tensors(saved[0])
        players = ("1", "2") if any("actor2" in name for name in tensors) else ("",)
        return [_player(tensors, d) for d in players]
    except NOT_THEIRS as error:
        raise ValueError(f"{path}: cannot be read as a policy of the authors: {error}") from error


def _player(tensors: dict[str, Tensor], d: str) -> Weights:
    def tensor(*names: str) -> Tensor:
        wanted = [name.format(d=d) for name in names]
        return tensors[next((name for name in wanted if name in tensors), wanted[0])]

    weights = {"log_std": tensor(*LOG_STD).reshape(1, -1)}
    for layer, names in LAYERS.items():
        weights[f"{layer}.weight"] = tensor(*(f"{n}.weight" for n in names)).T[None]
        weights[f"{layer}.bias"] = tensor(*(f"{n}.bias" for n in names))[None]
    for name, shape in NETWORK.weight_shapes.items():
        if tuple(weights[name].shape[1:]) != shape:
            raise ValueError(f"{name} has shape {tuple(weights[name].shape[1:])}, needs {shape}")
    return {name: weight.detach().float().contiguous() for name, weight in weights.items()}


def _tensors(module: Any, prefix: str = "") -> dict[str, Tensor]:
    """Tensors of a husk and of all that it is made of, by name."""
    own = {f"{prefix}{name}": t for name, t in module._parameters.items() if t is not None}
    for name, part in module._modules.items():
        own |= _tensors(part, f"{prefix}{name}.")
    return own


class _Husk:
    """Stands for an object of any class."""

    def __init__(self, *_: Any, **__: Any) -> None:
        pass

    def __setstate__(self, state: Any) -> None:
        if isinstance(state, dict):
            self.__dict__.update(state)


class _Unpickler(pickle.Unpickler):
    """Knows how to rebuild tensors; whatever else a file names is a husk."""

    KNOWN: ClassVar[dict[tuple[str, str], Any]] = {
        ("collections", "OrderedDict"): collections.OrderedDict,
        ("torch._utils", "_rebuild_tensor_v2"): torch._utils._rebuild_tensor_v2,
        ("torch._utils", "_rebuild_parameter"): torch._utils._rebuild_parameter,
    }

    def find_class(self, module: str, name: str) -> Any:
        return self.KNOWN.get((module, name)) or type(name, (_Husk,), {})


_PICKLE = types.ModuleType("weights_only_pickle")  # what torch.load wants of ``pickle``
_PICKLE.Unpickler = _Unpickler
_PICKLE.load = lambda file, **options: _Unpickler(file, **options).load()
