"""A device that is none: tensors there say so, compute on the CPU, and do not mix with others.

Whoever forgets to move a tensor to it, or back, gets the error that an accelerator would give.
"""

from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

DEVICE = torch.device("lazy")  # a name that torch accepts without a machine behind it


class There(Tensor):
    """A tensor on the device; ``here`` is what it stands for."""

    @staticmethod
    def __new__(cls, here: Tensor) -> "There":
        return Tensor._make_wrapper_subclass(
            cls, here.shape, here.stride(), dtype=here.dtype, device=DEVICE
        )

    def __init__(self, here: Tensor) -> None:
        self.here = here

    @classmethod
    def __torch_dispatch__(cls, function, types, args=(), kwargs=None) -> Any:
        raise RuntimeError(f"{function} outside of OtherDevice")


class OtherDevice(TorchDispatchMode):
    """Where tensors can be on the device."""

    def __torch_dispatch__(self, function, types, args=(), kwargs=None) -> Any:
        kwargs = dict(kwargs or {})
        tensors = [x for x in tree_leaves((args, kwargs)) if isinstance(x, Tensor)]
        is_there = [isinstance(x, There) for x in tensors]
        moves = function in (torch.ops.aten._to_copy.default, torch.ops.aten.copy_.default)
        mixed = [x for x in tensors if not isinstance(x, There) and x.dim() > 0]
        if any(is_there) and mixed and not moves:
            raise RuntimeError(f"{function}: tensors of {tuple(mixed[0].shape)} are on the CPU")
        target = kwargs.get("device") or (DEVICE if any(is_there) else None)
        if "device" in kwargs and kwargs["device"] is not None:
            kwargs["device"] = torch.device("cpu")

        def unwrap(x: Any) -> Any:
            return x.here if isinstance(x, There) else x

        known = {id(x.here): x for x in tensors if isinstance(x, There)}
        found = function(*tree_map(unwrap, args), **tree_map(unwrap, kwargs))

        def wrap(x: Any) -> Any:
            if not isinstance(x, Tensor) or target != DEVICE:
                return x
            # What an operation has changed in place is the same tensor as before.
            return known[id(x)] if id(x) in known else There(x)

        return tree_map(wrap, found)
