"""Tables of the book's notebooks, in one style."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd
from pandas.io.formats.style import Styler

from experiments.store import Store
from ipo.stats import mean_interval


def show(frame: pd.DataFrame, formats: dict[str, str] | str | None = None) -> Styler:
    """A table without its index; ``formats`` of its numbers, by column."""
    return frame.style.format(formats).hide().set_table_attributes('class="dataframe"')


def mean_and_std(values: pd.Series, digits: int = 1) -> str:
    """Of runs; the standard deviation is that of the paper (ddof 0)."""
    return f"{values.mean():.{digits}f} ± {values.std(ddof=0):.{digits}f}"


def costs(folder: str | Path, names: Sequence[str]) -> Styler:
    """What it took to compute experiments, from the record beside the rows of each."""

    def row(name: str) -> dict[str, object]:
        batches = Store(Path(folder), name).batches()
        return {
            "experiment": name,
            "batches": len(batches),
            "runs": sum(len(batch["seeds"]) for batch in batches),
            "CPU minutes": sum(batch["cpu_seconds"] for batch in batches) / 60,
            "machine": ", ".join(sorted({batch["machine"] for batch in batches})),
            "torch": ", ".join(sorted({batch["versions"]["torch"] for batch in batches})),
            "commit": ", ".join(sorted({batch["commit"] for batch in batches})),
        }

    return show(pd.DataFrame(map(row, names)), {"CPU minutes": "{:.1f}"})


def beside_shipped(live: pd.DataFrame, shipped: pd.DataFrame) -> pd.DataFrame:
    """Live rows with the shipped ones of the same keys, and how far they are apart.

    A ``relative difference`` is one to the shipped value, or to 0.001 where that is nearly zero.

    Raises:
        ValueError: a live row of which none is shipped.
    """
    keys = [column for column in live.columns if column != "value"]
    both = live.rename(columns={"value": "live"}).merge(
        shipped.rename(columns={"value": "shipped"}), on=keys, how="left", validate="one_to_one"
    )
    if both["shipped"].isna().any():
        first = both.loc[both["shipped"].isna(), keys].iloc[0].to_dict()
        raise ValueError(f"shipped: has no row for {first}, must have one for each live row")
    difference = (both["live"] - both["shipped"]).abs()
    relative = difference / (both["shipped"].abs() + 1e-3)
    return both.assign(**{"difference": difference, "relative difference": relative})


def largest_differences(
    live: pd.DataFrame, shipped: pd.DataFrame, by: Sequence[str]
) -> pd.DataFrame:
    """The largest relative difference of live rows from the shipped ones, by groups."""
    groups = beside_shipped(live, shipped).groupby(list(by), sort=False)
    largest = groups["relative difference"].max().reset_index()
    return largest.rename(columns={"relative difference": "largest relative difference"})


def mean_and_interval(values: pd.Series, digits: int = 2) -> str:
    """Of runs, with the 95 % interval of the mean."""
    low, high = mean_interval(values.to_numpy())
    return f"{values.mean():.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def by_method(
    rows: pd.DataFrame, columns: str, names: Mapping[str, str], digits: int = 2
) -> pd.DataFrame:
    """A line for each method in the order of its ``names``, a column for each value of a column.

    What stands there is :func:`mean_and_interval` of all runs.
    """
    groups = rows.groupby(["method", columns])["value"]
    wide = groups.apply(mean_and_interval, digits=digits).unstack()
    present = [method for method in names if method in wide.index]
    return wide.reindex(present).rename(index=names).rename_axis("method")
