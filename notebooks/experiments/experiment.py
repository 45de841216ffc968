"""What an experiment is: how rows are made of a cell, and which slice of a cell is its witness."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import json
import types
import typing
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Protocol, runtime_checkable

import pandas as pd

from ipo.checks import Count, check_counts, checked


@runtime_checkable
class Cell(Protocol):
    """What identifies a batch of runs: a frozen dataclass whose ``columns`` name its rows."""

    @property
    def columns(self) -> dict[str, Any]: ...


@dataclass(frozen=True)
class Places:
    """Folders that run functions are given by name, where they have a parameter of that name.

    Attributes:
        tables: of tabulated tasks.
        policies: of saved policies, which are written or read.
        checkpoints: of trainings that are not finished.
    """

    tables: Path
    policies: Path
    checkpoints: Path

    def bind(self, function: Callable) -> Callable:
        """The function with its folders."""
        known = inspect.signature(function).parameters
        folders = {name: path for name, path in vars(self).items() if name in known}
        return functools.partial(function, **folders) if folders else function


@checked
@dataclass(frozen=True)
class Experiment:
    """How rows are made of cells.

    Attributes:
        run: ``run(cell, seeds)`` returns the rows, with the cell's columns and ``run``. It may be
            a ``functools.partial``, whose options become part of the rows' origin. Where it went
            on from a check-point, ``rows.attrs["earlier_cpu_seconds"]`` is what came before.
        cell: the class of the cells.
        short: the slice of a cell that ``make verify`` computes again: the same cell with few
            iterations, updates or doors. ``None`` for a cell of which another one has the slice.
        seeds: of the slice.
        reads: ``reads(cell, seed)`` are the files that a run reads, each behind a seal as
            policies are; ``None``: it reads none.
        runs_at_once: runs of a cell that are computed, and saved, together; ``None``: all.
        divisible: whether fewer are, where workers would have nothing to do otherwise. A run must
            not depend on those beside it then.
        checkpoints: ``checkpoints(cell)`` are the files that carry work, by the runs that were
            begun together and go on together. It is not the run that removes them but the store,
            when the rows are saved and read back. ``None``: nothing is kept on the way.
        near_the_end: ``near_the_end(cell)`` are the cell at a few moments before the end of its
            training, and none if it is not trained: what moves until then is not at rest, and
            nobody can ask for the same digits on another machine. ``None``: all cells come to rest.
    """

    run: Callable[..., pd.DataFrame]
    cell: type
    short: Callable[[Any], Any | None] = lambda cell: cell
    seeds: Annotated[tuple[int, ...], partial(check_counts, minimum=0)] = (0, 1)
    reads: Callable[..., list[Path]] | None = None
    runs_at_once: Count | None = None
    divisible: bool = False
    checkpoints: Callable[..., dict[tuple[int, ...], list[Path]]] | None = None
    near_the_end: Callable[[Any], list[Any]] | None = None

    def at(self, places: Places) -> Experiment:
        """The same, where the run function knows its folders."""
        functions = {"run": self.run, "reads": self.reads, "checkpoints": self.checkpoints}
        bound = {name: places.bind(given) for name, given in functions.items() if given}
        return dataclasses.replace(self, **bound)


def near_the_end(cell: Any, steps: str = "num_iterations") -> list[Any]:
    """A cell at four moments of the last fiftieth of the ``steps`` that its settings count."""
    if cell.settings is None:
        return []
    return [dataclasses.replace(cell, settings=own) for own in with_fewer(cell.settings, steps)]


def with_fewer(settings: Any, steps: str) -> list[Any]:
    """Settings that end at four moments of the last fiftieth of their ``steps``."""
    number = getattr(settings, steps)
    left = [round(number * part / 50) for part in (1, 1 / 2, 3 / 4, 1 / 4)]
    return [dataclasses.replace(settings, **{steps: number - n}) for n in left]


def rebuilt(kind: Any, value: Any) -> Any:
    """A dataclass, and what it is made of, from the plain values of its record."""
    if isinstance(kind, types.UnionType):
        if value is None:
            return None
        kind = next(k for k in typing.get_args(kind) if k is not type(None))
    if dataclasses.is_dataclass(kind):
        hints = typing.get_type_hints(kind)
        return kind(**{name: rebuilt(hints[name], part) for name, part in value.items()})
    return tuple(value) if isinstance(value, list) else value


def plain(tree: Any) -> Any:
    """Values, dataclasses and NumPy's numbers among them, as they come back from JSON."""

    def of(value: Any) -> Any:
        return value.item() if hasattr(value, "item") else dataclasses.asdict(value)

    return json.loads(json.dumps(tree, default=of))


def filled(kind: Any, recorded: Any) -> Any:
    """A recorded dataclass with options that it did not have yet: their defaults were done."""
    try:
        return plain(rebuilt(kind, recorded))
    except (TypeError, ValueError, KeyError, AttributeError):  # it has options that are no more
        return recorded


def difference(recorded: dict[str, Any], wanted: dict[str, Any], prefix: str = "") -> str:
    """What differs between two trees of plain values, in words."""
    parts = []
    for key in sorted({*recorded, *wanted}):
        old, new = recorded.get(key), wanted.get(key)
        if isinstance(old, dict) and isinstance(new, dict):
            parts.append(difference(old, new, f"{prefix}{key}."))
        elif old != new:
            parts.append(f"{prefix}{key} = {old!r}, asked for {new!r}")
    return "; ".join(part for part in parts if part)
