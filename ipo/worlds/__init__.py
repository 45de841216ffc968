"""The worlds that policies act in.

``colored_keys`` (MiniGrid), and ``minigrid_tables``, which makes tables of them; ``tabular``: what
tables can do; ``cued_maze``, which is one; ``networks`` for tables; ``door`` (MuJoCo),
``many_doors`` side by side, and ``one_door``. MiniGrid and MuJoCo are extras: ``ipo[keys,door]``.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

# What is registered with gymnasium: module, and the extra with the packages that it needs.
ENVIRONMENTS = {"ColoredKeysEnv": ("colored_keys", "keys"), "DoorEnv": ("one_door", "door")}


def __getattr__(name: str) -> Any:
    if name not in ENVIRONMENTS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, extra = ENVIRONMENTS[name]
    try:
        return getattr(import_module(f"{__name__}.{module}"), name)
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"{error}: {name} needs pip install 'ipo[{extra}]'") from error
