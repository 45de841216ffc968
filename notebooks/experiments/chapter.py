"""What every chapter's notebook begins with: style, threads, folders; and how it gets its rows."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import pandas as pd
import torch
from myst_nb import glue
from pandas.io.formats.style import Styler

from experiments import figures, tables
from experiments.experiment import Cell, Experiment, Places, rebuilt
from experiments.origin import ROOT
from experiments.store import Store, timed
from ipo.checks import Count, checked


class Chapter:
    """A chapter's rows, loaded where they are shipped and computed where they are missing.

    Args:
        name: of the chapter and its folders under ``data/``.
        experiments: by the names of their files.
        results_dir: where rows are, seen from the project; ``None``: in a folder that goes.
        policies_dir: where policies are; ``None``: beside the rows.
        num_workers: processes that compute missing rows; ``None``: one per core.
    """

    @checked
    def __init__(
        self,
        name: str,
        experiments: Mapping[str, Experiment],
        results_dir: str | None,
        policies_dir: str | None = None,
        num_workers: Count | None = None,
    ) -> None:
        plt.rcParams.update(figures.STYLE)
        torch.set_num_threads(1)  # small matrices: processes use the cores better than threads
        self.name, self.experiments = name, experiments
        self.folder = ROOT / results_dir if results_dir else Path(tempfile.mkdtemp())
        self.workers = num_workers or os.cpu_count() or 1
        shipped = results_dir and policies_dir
        self.places = Places(
            tables=ROOT / "data" / "tabulated",
            policies=ROOT / policies_dir if shipped else self.folder / "policies",
            checkpoints=self.folder / "checkpoints",
        )

    def rows(self, name: str, cells: Sequence[Cell], seeds: Sequence[int]) -> pd.DataFrame:
        """Rows of an experiment: shipped ones are loaded, missing ones are computed and kept."""
        experiment = self.experiments[name].at(self.places)
        return Store(self.folder, name).fill(experiment, cells, list(seeds), self.workers)

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

    def paper(self) -> pd.DataFrame:
        """The paper's numbers."""
        return pd.read_csv(ROOT / "data" / "paper" / f"{self.name}.csv", dtype={"domain": str})

    def costs(self, *names: str) -> Styler:
        """What it took to compute experiments, from the record beside the rows of each."""
        return tables.costs(self.folder, names)

    def minutes(self, name: str) -> float:
        """CPU-minutes that an experiment took."""
        return sum(b["cpu_seconds"] for b in Store(self.folder, name).batches()) / 60


def numbers(prefix: str, **values: Any) -> None:
    """Numbers for the prose, which names them ``prefix_name``."""
    for name, value in values.items():
        plain = value.item() if hasattr(value, "item") else value
        glue(f"{prefix}_{name}", plain, display=False)
