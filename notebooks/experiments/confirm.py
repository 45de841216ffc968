"""One full batch of every cell again: before a release, or after a change on purpose.

    python -m experiments.confirm [--since COMMIT] [--scheduler tcp://...] [lqr keys/main ...]

For each cell the first recorded batch is computed again and held beside the shipped rows:

- ``exact``: equal in all nine digits, as on the same kind of machine;
- ``close``: every value within ten times the tolerance of the chapter's slices;
- ``alike``: for networks, whose training is chaotic, runs that could be others of the same cell;
- ``unsettled``: a training that never comes to rest, whose rounding decides where it stands in the
  end: runs no further away than they move in its last part, and in no direction;
- ``differs`` otherwise, and the command fails in the end.

The outcome stands in ``data/confirmed.json`` with the commit of the code, machine and packages.
What has been confirmed at the present commit of the code, or since COMMIT, is not computed again,
so that an interrupted run goes on.
"""

from __future__ import annotations

import argparse
import datetime
import json
import sys
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pandas as pd
import scipy.stats
from filelock import FileLock
from tqdm import tqdm

from experiments import origin
from experiments.orphans import interrupt_on_sigterm
from experiments.registry import DATA, chosen
from experiments.sealed import read_record, write_record
from experiments.store import Store, select
from experiments.witness import Slice, side_by_side, within
from experiments.work import finished

CONFIRMED = DATA / "confirmed.json"
CHAOTIC = (
    *("keys/main", "keys/turns", "keys/variants", "keys/larger", "keys/curves"),
    *("keys/in_full", "keys/regularized", "keys/fair", "keys/labels", "algorithm/players"),
    *("door/curves", "door/gaps"),
    "causality/digits",  # a game of networks goes round there, and runs stop anywhere on the way
    *("cue/many_steps", "cue/varied", "cue/encodings"),
    *("cue/two_domains", "cue/three_domains", "cue/four_domains"),
)
LEVEL, MANY = 0.001, 5
UNREST = 2.0  # times what runs move by before the end: a little more than where they were stopped
LONGER = 10.0  # times the tolerance of a slice: rounding grows over thousands of steps
NOT_PLACES = ("run", "value", "value_now", "_merge")


def full_batches(names: Sequence[str]) -> Iterator[Slice]:
    """The first batch of every cell."""
    for chapter, name in chosen(names):
        seen = set()
        for batch in Store(DATA / "results" / chapter, name).batches():
            columns = json.dumps(batch["columns"])
            if columns not in seen:
                seen.add(columns)
                yield Slice(chapter, name, batch)


def title(part: Slice) -> str:
    """What a cell is called in the record."""
    return " ".join([f"{part.chapter}/{part.name}", *map(str, part.batch["columns"].values())])


def confirm(
    names: Sequence[str] = (), since: str | None = None, scheduler: str | None = None
) -> list[str]:
    """Confirm what is not, on all cores or by a dask scheduler; returns the cells that differ."""
    done = confirmed()
    waiting = [part for part in full_batches(names) if not _is_done(done, title(part), since)]
    waiting.sort(key=lambda part: -part.batch["cpu_seconds"])  # long ones first: no idle core
    total = sum(part.batch["cpu_seconds"] for part in waiting) / 60
    print(f"{len(waiting)} cells, {total:.0f} CPU-minutes by their records", flush=True)
    with TemporaryDirectory() as scratch:
        jobs = [partial(_outcome, part, Path(scratch)) for part in waiting]
        work = finished(jobs, -1, scheduler)
        for cell, outcome in tqdm(work, total=len(waiting), unit="cell"):
            _save(cell, outcome)
    record = confirmed()
    return [cell for cell in map(title, full_batches(names)) if record[cell]["how"] == "differs"]


def confirmed() -> dict[str, dict[str, Any]]:
    """The record: by cell how it was confirmed, when, and at which commit of the code."""
    return read_record(CONFIRMED) if CONFIRMED.exists() else {}


def compared(part: Slice, rows: pd.DataFrame) -> str:
    """How rows that were computed again compare with the shipped ones."""
    store = Store(DATA / "results" / part.chapter, part.name)
    recorded = store.rows_of(part.batch)
    if how := agreement(f"{part.chapter}/{part.name}", recorded, rows):
        return how
    both = side_by_side(recorded, rows)
    chaotic = both is not None and f"{part.chapter}/{part.name}" in CHAOTIC
    return "alike" if chaotic and alike(store.rows(), part.batch["columns"], both) else "differs"


def agreement(experiment: str, recorded: pd.DataFrame, rows: pd.DataFrame) -> str | None:
    """Whether rows are ``exact`` or ``close``; None: neither."""
    both = side_by_side(recorded, rows)
    if both is None:
        return None
    if (both["value"] == both["value_now"]).all():
        return "exact"
    return "close" if within(both, experiment, LONGER).all() else None


def alike(shipped: pd.DataFrame, columns: dict[str, Any], both: pd.DataFrame) -> bool:
    """Whether runs could be other runs of a cell, by metric and domain.

    Many runs: no p-value of a Kolmogorov-Smirnov test is below LEVEL over their number. Few, whose
    learning curves say more than their number: at most half of a curve lies outside all others.
    """
    others = select(shipped, columns)
    if both["run"].nunique() >= MANY:
        place = [column for column in ("frames", "update", "domain", "metric") if column in both]
        p = [
            scipy.stats.ks_2samp(own["value"], own["value_now"]).pvalue
            for _, own in both.groupby(place)
        ]
        return min(p) > LEVEL / len(p)
    place = [column for column in both.columns if column not in (*NOT_PLACES, *columns)]
    range_ = others.groupby(place)["value"].agg(["min", "max"]).reset_index()
    beside = both.merge(range_, on=place)
    outside = (beside["value_now"] < beside["min"]) | (beside["value_now"] > beside["max"])
    return bool((outside.groupby([beside["domain"], beside["metric"]]).mean() <= 0.5).all())


def unsettled(both: pd.DataFrame, moments: Iterable[pd.DataFrame]) -> bool:
    """Whether rows differ from the shipped ones by no more than where a training was stopped.

    Of each metric and domain runs are on average at most UNREST times as far from what is shipped
    as they were, at the most, from their own end at some ``moments`` before it; and by a paired
    t-test they are to neither side of what is shipped. A single run has no side. So it is never
    true of a training that is at rest. Only as many moments are looked at as it takes.
    """
    both = both.reset_index(drop=True)
    apart, kinds = both["value_now"] - both["value"], [both["domain"], both["metric"]]
    moved = pd.Series(0.0, both.index)
    for rows in moments:
        keys = [column for column in rows.columns if column not in ("value", "round")]
        before = both[keys].merge(rows, on=keys, how="left")["value"]
        moved = moved.combine((both["value_now"] - before).abs(), max)
        if (apart.abs().groupby(kinds).mean() <= UNREST * moved.groupby(kinds).mean()).all():
            return not _sided([own for _, own in apart.groupby(kinds)])
    return False


def _sided(groups: Sequence[pd.Series]) -> bool:
    """Whether differences are to one side in some group of them."""
    runs = [own for own in groups if own.any() and len(own) > 1]
    return any(scipy.stats.ttest_1samp(own, 0).pvalue <= LEVEL / len(groups) for own in runs)


def elsewhere(experiment: str, recorded: pd.DataFrame, rows: pd.DataFrame) -> pd.DataFrame | None:
    """The record and ``rows`` in those domains and metrics where some run is not close to it."""
    both = side_by_side(recorded, rows)
    if both is None:
        return None
    away = ~within(both, experiment, LONGER)
    return both[away.groupby([both["domain"], both["metric"]]).transform("any")]


def how_far(both: pd.DataFrame | None) -> str:
    """By how much rows are away from the record: on average, where they are not close."""
    if both is None:
        return "other rows"
    both = both.assign(apart=(both["value_now"] - both["value"]).abs())
    means = both.groupby(["domain", "metric"])[["apart", "value"]].mean()
    return ", ".join(
        f"{metric} in {domain} by {apart:.2g} of {size:.4g}"
        for (domain, metric), apart, size in means.itertuples()
    )


def _outcome(part: Slice, scratch: Path) -> tuple[str, dict[str, Any]]:
    rows = part.run(scratch)
    how, apart = compared(part, rows), {}
    if how == "differs":
        recorded = Store(DATA / "results" / part.chapter, part.name).rows_of(part.batch)
        away = elsewhere(f"{part.chapter}/{part.name}", recorded, rows)
        if away is not None and unsettled(away, part.run_near_the_end(scratch)):
            how = "unsettled"
        else:
            apart = {"apart": how_far(away)}
    return title(part), {
        "how": how,
        **apart,
        "runs": len(part.batch["seeds"]),
        "commit": origin.commit(),
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "machine": origin.machine(),
        "packages": ", ".join(f"{name} {number}" for name, number in origin.versions().items()),
    }


def _is_done(done: dict[str, dict[str, Any]], name: str, since: str | None) -> bool:
    if name not in done or done[name]["how"] == "differs":
        return False
    return origin.is_since(since or origin.commit(), done[name]["commit"])


def _save(name: str, outcome: dict[str, Any]) -> None:
    with FileLock(CONFIRMED.with_suffix(".lock")):
        write_record(CONFIRMED, dict(sorted((confirmed() | {name: outcome}).items())))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", help="chapters, or experiments such as lqr/tables")
    parser.add_argument("--since", help="what was confirmed at this commit, or later, counts")
    parser.add_argument("--scheduler", help="address of a dask scheduler whose workers compute")
    options = parser.parse_args()
    interrupt_on_sigterm()
    if different := confirm(options.names, options.since, options.scheduler):
        sys.exit("These cells differ from the shipped rows:\n" + "\n".join(different))


if __name__ == "__main__":
    main()
