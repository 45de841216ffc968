"""Where something comes from: the function and its options, files, versions, machine, commit."""

from __future__ import annotations

import functools
import inspect
import os
import platform
import subprocess
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
if not (ROOT / "data").is_dir():
    raise FileNotFoundError(
        f"{ROOT / 'data'}: there are no shipped rows; the experiments must be installed where they "
        "lie: pip install --no-deps --editable notebooks, in the folder of the book"
    )
# Packages whose code decides numbers in the rows.
PACKAGES = (
    *("numpy", "scipy", "torch", "pandas"),
    *("gymnasium", "minigrid", "mujoco", "scikit-learn"),
)


def function(run: Callable) -> tuple[str, dict[str, Any]]:
    """The name of a function and its options, those of a ``functools.partial`` and defaults.

    Folders are places, not options: paths are left out, and so is whether a bar is shown.
    """
    given: dict[str, Any] = {}
    while isinstance(run, functools.partial):
        given = run.keywords | given
        run = run.func
    parameters = list(inspect.signature(run).parameters.values())[2:]  # after cell and seeds
    defaults = {p.name: p.default for p in parameters if p.default is not inspect.Parameter.empty}
    options = {
        name: value
        for name, value in sorted((defaults | given).items())
        if name not in ("tables", "policies", "checkpoints", "progress")
    }
    module = run.__module__.removeprefix("experiments.")
    return f"{module}.{run.__qualname__}", options


@functools.cache
def versions() -> dict[str, str]:
    return {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}}


def machine() -> str:
    """Its instruction set is the one that torch found, which decides how numbers are rounded."""
    import torch  # who only reads rows needs it not

    kind = f"{platform.machine()} {torch.backends.cpu.get_cpu_capability()}"
    return f"{platform.system()} {kind}, {os.cpu_count()} cores"


def _git(*arguments: str) -> str:
    command = ["git", "-C", str(ROOT), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


@functools.cache
def commit() -> str:
    """The last commit that changed code or packages, with a plus where they have changed since."""
    code = ("ipo", "notebooks/experiments", "environment.txt")
    try:
        changed = _git("status", "--porcelain", "--", *code)
        last = _git("log", "-1", "--format=%h", "--abbrev=10", "--", *code)
        return f"{last}+" if changed else last
    except (OSError, subprocess.CalledProcessError):  # an archive of the source, without history
        return "unknown"


def is_since(first: str, later: str) -> bool:
    """Whether a commit is another one or comes after it."""
    try:
        _git("merge-base", "--is-ancestor", first.rstrip("+"), later.rstrip("+"))
    except (OSError, subprocess.CalledProcessError):
        return False
    return True
