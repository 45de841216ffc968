"""A tiny experiment with results on disk, and a program that runs it and may be killed by itself.

python toy_experiment.py FOLDER [computing | renaming NUMBER]
"""

import itertools
import os
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from ipo import results


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
    **options,
) -> pd.DataFrame:
    """Run or load ``folder/toy.csv``; the source of ``ipo.stats`` stands for the toy's own."""
    return results.run_or_load(folder, "toy", cells, seeds, run, ["stats"], num_workers, **options)


def die_at(number: int, function: Callable) -> Callable:
    """The function, but instead of its ``number``-th call the process is killed."""
    calls = itertools.count(1)

    def mortal(*args):
        if next(calls) == number:
            os.kill(os.getpid(), signal.SIGKILL)
        return function(*args)

    return mortal


if __name__ == "__main__":
    folder, *death = sys.argv[1:]
    match death:
        case ["computing", number]:
            run = die_at(int(number), run)
        case ["renaming", number]:
            results.os.replace = die_at(int(number), os.replace)
    fill(folder, run=run)
