"""Currency is a test: cheap slices of every kind of cell, recorded once and computed again.

    python -m experiments.witness verify [lqr keys/main ...]
    python -m experiments.witness record [lqr keys/main ...]

The slices are rows like the results, in ``data/witness/``, of the same cells with few iterations,
updates or doors. Code, or a package, that still gives them is taken to give the shipped results;
where a value differs by more than its tolerance, ``verify`` names cell, metric, old and new value.
Whoever changes results on purpose records the slices again, and says so in the changelog.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import pandas as pd
from tqdm import tqdm

from experiments import own_domains
from experiments.experiment import Cell, Experiment, rebuilt
from experiments.orphans import interrupt_on_sigterm
from experiments.registry import CHAPTERS, DATA, again, chosen
from experiments.store import Batch, Store, timed
from experiments.work import finished
from ipo.checks import checked

WITNESS = DATA / "witness"

# By how much values may differ between machines: relative, absolute. In double precision little
# more than rounding; networks are in single precision, and their rounding grows with each step.
TOLERANCE = {
    "lqr": (1e-4, 1e-5),
    "causality": (1e-4, 1e-6),
    "algorithm": (1e-6, 1e-9),
    "algorithm/players": (1e-3, 1e-5),  # networks, as in keys
    "keys": (1e-3, 1e-5),
    "cue": (1e-3, 1e-5),
    "door": (1e-3, 1e-5),
    "your_own_domains": (1e-2, 1e-3),  # episodes of a pendulum are chaotic
}
# One draw, one label or one door can flip where two numbers are nearly the same; by metric, or by
# experiment and metric.
FLIPS = {
    "return_published_protocol": 0.02,
    "train_error": 0.005,
    "validation_error": 0.005,
    "test_error": 0.005,
    "after": 2000.0,  # of returns over ten doors, after an update: one that stays shut
    "door/curves/return": 150.0,  # of -6000: contacts amplify what an update has rounded
}
SHOWN = ("method", "iteration", "frames", "update", "run", "domain", "door", "metric")


@dataclass(frozen=True)
class Slice:
    """One recorded batch, to be computed again."""

    chapter: str
    name: str
    batch: Batch

    def run(self, scratch: Path) -> pd.DataFrame:
        experiment, cell = self._experiment(scratch)
        return timed(experiment.run, cell, self.batch["seeds"])[1]

    def run_near_the_end(self, scratch: Path) -> Iterator[pd.DataFrame]:
        """The rows at a few moments before the end of a training."""
        experiment, cell = self._experiment(scratch)
        for before in experiment.near_the_end(cell) if experiment.near_the_end else ():
            yield timed(experiment.run, before, self.batch["seeds"])[1]

    def _experiment(self, scratch: Path) -> tuple[Experiment, Cell]:
        experiment = again(self.chapter, self.name, scratch)
        return experiment, rebuilt(experiment.cell, self.batch["cell"])


def slices(names: Sequence[str] = ()) -> Iterator[Slice]:
    """All recorded slices of some chapters or experiments."""
    for chapter, name in chosen(names):
        for batch in Store(WITNESS / chapter, name).batches():
            yield Slice(chapter, name, batch)


def verify(names: Sequence[str] = (), num_workers: int = -1) -> list[str]:
    """What differs between the recorded slices and those of today's code, in words."""
    recorded = list(slices(names))
    problems = [
        f"{chapter}/{name}, {cell.columns}: no slice is recorded"
        for chapter, name in chosen(names)
        for cell in short_cells(chapter, name)
        if cell.columns not in [s.batch["columns"] for s in recorded if s.name == name]
    ]
    with TemporaryDirectory() as scratch:
        jobs = [partial(_attempt, part, Path(scratch)) for part in recorded]
        for part, rows in tqdm(finished(jobs, num_workers), total=len(jobs), unit="slice"):
            problems += differences(part, rows)
    return sorted(problems)  # slices come as they are finished


def _attempt(part: Slice, scratch: Path) -> tuple[Slice, pd.DataFrame | str]:
    try:
        with contextlib.redirect_stderr(io.StringIO()):  # bars of single trainings
            return part, part.run(scratch)
    except Exception as error:  # whatever it is, it is a difference, and the others go on
        return part, f"{type(error).__name__}: {error}"


def differences(part: Slice, rows: pd.DataFrame | str) -> list[str]:
    """Values of a slice that are not what was recorded."""
    title = f"{part.chapter}/{part.name}, {part.batch['columns']}"
    if isinstance(rows, str):
        return [f"{title}: {rows}"]
    recorded = Store(WITNESS / part.chapter, part.name).rows_of(part.batch)
    both = side_by_side(recorded, rows)
    if both is None:
        return [f"{title}: has other rows than the {len(recorded)} that were recorded"]
    return [
        f"{title}: {describe(row)}: {row['value']:.9g} recorded, {row['value_now']:.9g} now"
        for row in both[~within(both, f"{part.chapter}/{part.name}")].to_dict("records")
    ]


@checked
def side_by_side(recorded: pd.DataFrame, rows: pd.DataFrame) -> pd.DataFrame | None:
    """Recorded rows with what is computed now as ``value_now``; None if it is of other rows.

    Raises:
        ValueError: no recorded rows, from which nothing would differ.
    """
    if recorded.empty:
        raise ValueError("recorded: has no rows, must have some")
    keys = [column for column in recorded.columns if column != "value"]
    if set(rows.columns) != set(recorded.columns):
        return None
    recorded, rows = (r[r["metric"] != "cpu_seconds"] for r in (recorded, rows))  # never the same
    now = rows.astype(recorded.dtypes.to_dict()).rename(columns={"value": "value_now"})
    both = recorded.merge(now, on=keys, how="outer", indicator=True)
    if len(both) != len(recorded) or (both["_merge"] != "both").any():
        return None
    return both


def within(both: pd.DataFrame, experiment: str, factor: float = 1.0) -> pd.Series:
    """Which values are the same within the tolerance of ``chapter/name``, or a multiple of it.

    What can flip does so once, and not a multiple of it.
    """
    chapter, _ = experiment.split("/")
    relative, absolute = TOLERANCE.get(experiment, TOLERANCE[chapter])
    old, new = both["value"], both["value_now"]
    flips = [FLIPS.get(m, FLIPS.get(f"{experiment}/{m}", 0.0)) for m in both["metric"]]
    allowed = factor * (relative * old.abs() + absolute) + flips
    return (new == old) | ((new - old).abs() <= allowed)


def describe(row: dict[str, object]) -> str:
    """Which row it is."""
    return ", ".join(f"{key} {row[key]}" for key in SHOWN if key in row)


def record(names: Sequence[str] = (), num_workers: int = -1) -> None:
    """Compute and save the slices that are not recorded yet, of all cells that results have."""
    for chapter, name in chosen(names):
        if cells := list(short_cells(chapter, name)):
            with TemporaryDirectory() as scratch:
                experiment = again(chapter, name, Path(scratch))
                store = Store(WITNESS / chapter, name)
                store.fill(experiment, cells, experiment.seeds, num_workers)


def short_cells(chapter: str, name: str) -> Iterator[Cell]:
    """The slices of the cells of an experiment, each once."""
    experiment = CHAPTERS[chapter][name]
    recorded = Store(DATA / "results" / chapter, name).batches()
    cells = [rebuilt(experiment.cell, batch["cell"]) for batch in recorded]
    if chapter == "your_own_domains":  # a page without shipped results
        cells = own_domains.CELLS
    short = [experiment.short(cell) for cell in cells]
    yield from dict.fromkeys(cell for cell in short if cell is not None)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("action", choices=("verify", "record"))
    parser.add_argument("names", nargs="*", help="chapters, or experiments such as lqr/tables")
    options = parser.parse_args()
    interrupt_on_sigterm()
    if options.action == "record":
        record(options.names)
        return
    problems = verify(options.names)
    for problem in problems:
        print(problem)
    if problems:
        sys.exit(f"{len(problems)} values differ from what was recorded")
    print(f"{len(list(slices(options.names)))} slices give what was recorded")


if __name__ == "__main__":
    main()
