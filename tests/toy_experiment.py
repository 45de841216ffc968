"""A tiny experiment with results on disk, and a program that runs it and may be killed by itself.

``main(FOLDER, "computing" or "renaming", NUMBER)`` ends with the process at that moment.
"""

import functools
import itertools
import os
import signal
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from experiments import files
from experiments.experiment import Experiment
from experiments.store import Store


@dataclass(frozen=True)
class Cell:
    """A configuration; ``power`` is a setting that its columns do not show."""

    method: str
    size: int
    power: float = 0.5

    @property
    def columns(self) -> dict[str, Any]:
        return {"method": self.method, "size": self.size}


CELLS = (Cell("slow", 2), Cell("fast", 10), Cell("fast", 2))
SEEDS = (0, 1, 2)


def run(cell: Cell, seeds: Sequence[int]) -> pd.DataFrame:
    """Two irrational values per run."""
    return pd.DataFrame(
        {**cell.columns, "run": seed, "domain": domain, "metric": "cost", "value": value}
        for seed in seeds
        for domain, value in (("train", cell.size**cell.power), ("test", cell.size / (seed + 3)))
    )


def fill(
    folder: str | Path,
    cells: Sequence[Cell] = CELLS,
    seeds: Sequence[int] = SEEDS,
    run: Callable = run,
    num_workers: int = 1,
    scheduler: str | None = None,
    **options,
) -> pd.DataFrame:
    """Run or load ``folder/toy.csv``; options are those of an ``Experiment``."""
    return Store(Path(folder), "toy").fill(
        Experiment(run, Cell, **options), cells, seeds, num_workers, scheduler
    )


def die_at(number: int, function: Callable) -> Callable:
    """The function, but instead of its ``number``-th call the process is killed."""
    calls = itertools.count(1)

    @functools.wraps(function)
    def mortal(*args):
        if next(calls) == number:
            os.kill(os.getpid(), signal.SIGKILL)
        return function(*args)

    return mortal


def main(folder: str, *death: str) -> None:
    chosen = run
    match death:
        case ["computing", number]:
            chosen = die_at(int(number), run)
        case ["renaming", number]:
            files.os.replace = die_at(int(number), os.replace)
    fill(folder, run=chosen)
