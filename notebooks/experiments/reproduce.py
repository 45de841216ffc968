"""Every result from nothing, into ``data/reproduced``, and how it compares with what is shipped.

    python -m experiments.reproduce [--scheduler tcp://...] [door keys ...]

All batches of the shipped record are computed again, with their own tables and policies: first
the trainings, then what reads the policies that come out. Each batch is saved when it is finished
and a training after every update, so that an interrupted command goes on. In the end the runs of
every cell are held beside the shipped ones:

- ``exact`` and ``close``: as ``experiments.confirm`` says;
- ``alike``: where networks are trained, which is chaotic, other runs of the same cell;
- ``unsettled``: as there; the runs of such a cell are trained once more, to moments before the end;
- ``differs`` otherwise, and the command fails.
"""

from __future__ import annotations

import argparse
import heapq
import sys
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import pandas as pd
import scipy.stats
from tqdm import tqdm

from experiments.confirm import CHAOTIC, LEVEL, agreement, elsewhere, unsettled
from experiments.experiment import Cell, Experiment, Places, rebuilt
from experiments.registry import CHAPTERS, DATA, chosen
from experiments.store import Batch, Store, select, timed, together
from experiments.witness import Slice
from experiments.work import finished, num_at_once
from ipo.checks import check_choice

BAR = "{desc}: {percentage:.1f} % of the time{postfix}; {elapsed} gone, {remaining} left"
OUTCOMES = ("exact", "close", "alike", "unsettled", "differs")
FEWEST = 10  # runs of which a test of ranks can have a p-value as small as is asked for


def reproduce(
    chapters: Sequence[str] = (), num_workers: int = -1, scheduler: str | None = None
) -> pd.DataFrame:
    """Compute what is not reproduced yet, on all cores or by a dask scheduler.

    Returns a row for every experiment: its cells, and how many of them came out how.
    """
    at_once = num_at_once(num_workers, scheduler)
    waves = recorded(chapters, at_once)
    costs = [[cost(part) for part in wave if lacking(part)] for wave in waves]
    total, left = sum(cost(part) for wave in waves for part in wave), sum(map(sum, costs))
    print(
        f"{sum(map(len, costs))} batches, {left / 3600:.1f} core-hours by their records: about "
        f"{wall_seconds(costs, at_once) / 3600:.1f} hours, {at_once} at a time",
        flush=True,
    )
    # Seconds of the record are what is counted, so the time left follows from today's speed.
    options = {"total": total, "initial": total - left, "bar_format": BAR}
    with tqdm(**options, desc="reproduced", smoothing=0, miniters=1) as bar:
        for wave in waves:
            compute(wave, bar, num_workers, scheduler)
    return comparison(chapters, num_workers, scheduler)


def recorded(chapters: Sequence[str], at_once: int | None = None) -> list[list[Slice]]:
    """The shipped batches in the order in which they depend on each other: two waves.

    What reads policies comes after what makes them. Where ``at_once`` batches are computed at a
    time, batches of one cell are joined if that is cheaper and none becomes longer by it than an
    equal share of all work.
    """
    for chapter in chapters:
        check_choice("chapter", chapter, list(CHAPTERS))
    batches = {
        (chapter, name): Store(DATA / "results" / chapter, name).batches()
        for chapter, name in chosen(chapters)
    }
    total = sum(batch["cpu_seconds"] for own in batches.values() for batch in own)
    waves: list[list[Slice]] = [[], []]
    for (chapter, name), own in batches.items():
        experiment = CHAPTERS[chapter][name]
        if at_once and experiment.divisible:
            own = joined(own, experiment.runs_at_once, total / at_once)
        waves[experiment.reads is not None] += [Slice(chapter, name, batch) for batch in own]
    return waves


def joined(batches: Iterable[Batch], num_runs: int, longest: float) -> list[Batch]:
    """Batches of one cell after each other, joined to at most so many runs and CPU-seconds.

    What is known of a joined batch is what computing asks for: cell, runs and seconds.
    """
    found: list[Batch] = []
    for batch in batches:
        before = found[-1] if found else {"cell": None, "seeds": [], "cpu_seconds": 0.0}
        seeds = [*before["seeds"], *batch["seeds"]]
        seconds = before["cpu_seconds"] + batch["cpu_seconds"]
        same_cell = batch["cell"] == before["cell"]
        if same_cell and len(seeds) <= num_runs and seconds <= longest:
            found[-1] = before | {"seeds": seeds, "cpu_seconds": seconds}
        else:
            found.append(batch)
    return found


def cost(part: Slice) -> float:
    """CPU-seconds of a batch by its record."""
    return part.batch["cpu_seconds"]


def compute(
    wave: Sequence[Slice], bar: tqdm, num_workers: int, scheduler: str | None = None
) -> None:
    """Compute and save what is missing of batches that do not depend on each other."""
    waiting = [(part, seeds) for part in wave if (seeds := lacking(part))]
    waiting.sort(key=lambda pair: -cost(pair[0]))  # long ones first: no idle core
    for part, _ in waiting:
        store(part).check_writable()
    jobs = [
        partial(_computed, part, runs, len(runs) / len(seeds))
        for part, seeds in waiting
        for runs in together(experiment(part), cell_of(part), seeds, seeds, len(seeds))
    ]
    for part, runs, share, (cell, rows, made) in finished(jobs, num_workers, scheduler):
        store(part).add(experiment(part), cell, rows, made)
        store(part).remove_checkpoints(experiment(part), [cell], runs)
        bar.set_postfix_str(f"{part.chapter}/{part.name}", refresh=False)
        bar.update(cost(part) * share)


def _computed(part: Slice, runs: list[int], share: float) -> tuple[Slice, list[int], float, tuple]:
    return part, runs, share, timed(experiment(part).run, cell_of(part), runs)


def cell_of(part: Slice) -> Cell:
    return rebuilt(CHAPTERS[part.chapter][part.name].cell, part.batch["cell"])


def experiment(part: Slice) -> Experiment:
    """As in the profile ``paper``: tables, policies and check-points are its own, too."""
    folder = DATA / "reproduced"
    places = Places(
        tables=folder / "tabulated",
        policies=folder / part.chapter / "policies",
        checkpoints=folder / part.chapter / "checkpoints",
    )
    return CHAPTERS[part.chapter][part.name].at(places)


def store(part: Slice) -> Store:
    return Store(DATA / "reproduced" / part.chapter, part.name)


def lacking(part: Slice) -> list[int]:
    """The runs of a batch that are not reproduced yet."""
    return store(part).lacking(experiment(part), cell_of(part), part.batch["seeds"])


def wall_seconds(waves: Iterable[Iterable[float]], num_workers: int) -> float:
    """How long batches of so many seconds take side by side: whoever is free takes the longest."""
    total = 0.0
    for wave in waves:
        ends = [0.0] * num_workers
        for seconds in sorted(wave, reverse=True):
            heapq.heapreplace(ends, ends[0] + seconds)
        total += max(ends)
    return total


# ------------------------------------------------------------------ beside what is shipped


def comparison(
    chapters: Sequence[str], num_workers: int = -1, scheduler: str | None = None
) -> pd.DataFrame:
    """A row for every experiment: its cells, and how many of them came out how."""
    cells = pd.DataFrame(outcomes(chapters, num_workers, scheduler), columns=["experiment", "how"])
    counts = pd.crosstab(cells["experiment"], cells["how"]).reindex(columns=OUTCOMES, fill_value=0)
    counts.insert(0, "cells", counts.sum(axis=1))
    return counts.rename_axis(columns=None).reset_index()


def outcomes(
    chapters: Sequence[str], num_workers: int, scheduler: str | None
) -> list[tuple[str, str]]:
    """The experiment of every cell, and how all runs of it compare with the shipped ones."""
    found, jobs = [], []
    for chapter, name in chosen(chapters):
        experiment = f"{chapter}/{name}"
        shipped = Store(DATA / "results" / chapter, name)
        batches = {str(batch["columns"]): batch for batch in shipped.batches()}.values()
        every = (shipped.rows(), Store(DATA / "reproduced" / chapter, name).rows())
        for batch in batches:
            old, new = (select(rows, batch["columns"]) for rows in every)
            how = outcome(chapter, name, old, new)
            moving = how == "differs" and CHAPTERS[chapter][name].near_the_end is not None
            if moving and (away := elsewhere(experiment, old, new)) is not None:
                part = Slice(chapter, name, batch | {"seeds": sorted(set(old["run"].tolist()))})
                jobs.append(partial(_unsettled, part, away))
            else:
                found.append((experiment, how))
    work = finished(jobs, num_workers, scheduler)
    bar = tqdm(work, desc="trained again", total=len(jobs), unit="cell", disable=not jobs)
    return found + list(bar)


def outcome(chapter: str, name: str, shipped: pd.DataFrame, again: pd.DataFrame) -> str:
    """How all runs of a cell compare with the shipped ones."""
    trained = f"{chapter}/{name}" in CHAOTIC or CHAPTERS[chapter][name].reads is not None
    how = agreement(f"{chapter}/{name}", shipped, again)
    return how or ("alike" if trained and alike(shipped, again) else "differs")


def _unsettled(part: Slice, away: pd.DataFrame) -> tuple[str, str]:
    with TemporaryDirectory() as scratch:
        moves = unsettled(away, part.run_near_the_end(Path(scratch)))
    return f"{part.chapter}/{part.name}", "unsettled" if moves else "differs"


def alike(shipped: pd.DataFrame, again: pd.DataFrame) -> bool:
    """Whether all runs of a cell could be other runs of it.

    Of every domain and metric, runs have their mean over learning curves and doors. No p-value of
    a Kolmogorov-Smirnov test between the two sets of runs is below LEVEL over their number. Of
    fewer than FEWEST runs, which that test can never tell apart so surely, it is Welch's t-test.
    """
    old, new = (
        rows[rows["metric"] != "cpu_seconds"].pivot_table("value", "run", ["domain", "metric"])
        for rows in (shipped, again)
    )
    if set(old.columns) != set(new.columns):
        return False
    p = [_p_value(old[place].dropna(), new[place].dropna()) for place in old]
    return min(p) > LEVEL / len(p)


def _p_value(old: pd.Series, new: pd.Series) -> float:
    if min(len(old), len(new)) >= FEWEST:
        return scipy.stats.ks_2samp(old, new).pvalue
    if old.nunique() == new.nunique() == 1:  # no spread to measure a difference by
        return float(old.iloc[0] == new.iloc[0])
    return scipy.stats.ttest_ind(old, new, equal_var=False).pvalue


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("chapters", nargs="*", metavar="chapter", help="all if none is named")
    parser.add_argument("--scheduler", help="address of a dask scheduler whose workers compute")
    options = parser.parse_args()
    try:
        table = reproduce(options.chapters, scheduler=options.scheduler)
    except KeyboardInterrupt:
        sys.exit("Interrupted; the same command goes on where it was")
    print(table.to_string(index=False))
    if different := table["differs"].sum():
        sys.exit(f"{different} cells differ from the shipped rows")


if __name__ == "__main__":
    main()
