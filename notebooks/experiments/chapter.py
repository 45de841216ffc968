"""What every chapter's notebook begins with: style, threads, folders; and how it gets its rows."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from myst_nb import glue
from pandas.io.formats.style import Styler

from experiments import figures, tables
from experiments.experiment import Cell, Experiment, Places, rebuilt
from experiments.origin import ROOT
from experiments.paper import read_paper
from experiments.sealed import read_record
from experiments.store import Batch, Store, timed
from ipo.checks import Count, checked


class Chapter:
    """A chapter's rows, loaded where they are shipped and computed where they are missing.

    Args:
        name: of the chapter and its folders under ``data/``.
        experiments: by the names of their files.
        results_dir: where rows are, seen from the working directory: ``data/results/NAME`` are the
            shipped ones, wherever one works; ``None``: in a folder that goes. Policies follow the
            rows: those of a folder of one's own are in its ``policies``.
        num_workers: processes that compute missing rows; ``None``: one per core.
    """

    @checked
    def __init__(
        self,
        name: str,
        experiments: Mapping[str, Experiment],
        results_dir: str | None,
        num_workers: Count | None = None,
    ) -> None:
        figures.set_up()
        torch.set_num_threads(1)  # small matrices: processes use the cores better than threads
        self.name, self.experiments = name, experiments
        self._scratch = tempfile.TemporaryDirectory()
        self.folder = self._folder_of(results_dir)
        self.workers = num_workers or os.cpu_count() or 1
        is_shipped = self.folder.resolve() == self.shipped
        self.places = Places(
            tables=ROOT / "data" / "tabulated",
            policies=ROOT / "data" / "policies" / name if is_shipped else self.folder / "policies",
            checkpoints=self.folder / "checkpoints",
        )

    @property
    def shipped(self) -> Path:
        """The folder of the rows that ship with the book."""
        return ROOT / "data" / "results" / self.name

    def _folder_of(self, results_dir: str | None) -> Path:
        if results_dir is None:
            return Path(self._scratch.name)
        if not isinstance(results_dir, str) or not results_dir:
            raise ValueError(
                f"results_dir = {results_dir!r}: must be the path of a folder, or None"
            )
        is_default = Path(results_dir) == self.shipped.relative_to(ROOT)
        return self.shipped if is_default else Path.cwd() / results_dir

    def rows(self, name: str, cells: Sequence[Cell], seeds: Sequence[int]) -> pd.DataFrame:
        """Rows of an experiment: shipped ones are loaded, missing ones are computed and kept."""
        experiment, seeds = self.experiments[name].at(self.places), list(seeds)
        store = Store(self.folder, name)
        self._announce(name, sum(len(store.lacking(experiment, cell, seeds)) for cell in cells))
        return store.fill(experiment, cells, seeds, self.workers)

    def _announce(self, name: str, num_missing: int) -> None:
        """Say how long missing runs take, if they are like the shipped ones."""
        shipped = Store(self.shipped, name).batches()
        if num_missing and shipped:
            num_shipped = sum(len(batch["seeds"]) for batch in shipped)
            minutes = self.minutes_of(shipped) * num_missing / num_shipped / self.workers
            print(
                f"{name}: {num_missing} runs are missing. At the mean cost of the shipped ones "
                f"they take {minutes:.1f} minutes on {self.workers} cores; each batch is kept",
                file=sys.stderr,
            )

    def slices(self, name: str, **columns: Any) -> tuple[pd.DataFrame, pd.DataFrame]:
        """What the short slices of the cells with these columns give now, and all recorded ones.

        Such slices of all cells are what ``make verify`` computes again.
        """
        experiment = self.experiments[name].at(self.places)
        store = Store(ROOT / "data" / "witness" / self.name, name)
        batches = [b for b in store.batches() if columns.items() <= b["columns"].items()]
        cells = [rebuilt(experiment.cell, batch["cell"]) for batch in batches]
        now = [timed(experiment.run, c, b["seeds"])[1] for c, b in zip(cells, batches, strict=True)]
        return pd.concat(now, ignore_index=True), store.rows()

    def paper(self, table: str | None = None) -> pd.DataFrame:
        """The paper's numbers; of doors in a further table, ``strategies``."""
        return read_paper(f"{self.name}_{table}" if table else self.name)

    def bench(self) -> dict[str, Any]:
        """What the chapter's benchmark, under ``tests/bench``, wrote down."""
        return read_record(ROOT / "data" / "bench" / f"{self.name}.json")

    def costs(self, *names: str) -> Styler:
        """What it took to compute experiments, from the record beside the rows of each."""
        return tables.costs(self.folder, names)

    def minutes(self, name: str) -> float:
        """CPU-minutes that an experiment took."""
        return self.minutes_of(Store(self.folder, name).batches())

    @staticmethod
    def minutes_of(batches: Sequence[Batch]) -> float:
        """CPU-minutes by their record."""
        return sum(batch["cpu_seconds"] for batch in batches) / 60


def numbers(prefix: str, **values: Any) -> None:
    """Numbers for the prose, which names them ``prefix_name``."""
    for name, value in values.items():
        plain = value.item() if hasattr(value, "item") else value
        glue(f"{prefix}_{name}", plain, display=False)
