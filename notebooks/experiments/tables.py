"""Tables of the book's notebooks, in one style."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
from pandas.io.formats.style import Styler

from experiments.store import Store
from ipo.checks import Natural, check_choice, check_choices, checked
from ipo.stats import mean_interval


def _check_values(name: str, values: pd.Series) -> None:
    """pandas leaves NaN out of a mean without a word."""
    if not isinstance(values, pd.Series):
        raise TypeError(f"{name} = {values!r}: must be a pandas.Series")
    if values.empty or values.isna().any():
        raise ValueError(f"{name} = {values.tolist()}: must be numbers, at least one")


Values = Annotated[pd.Series, _check_values]  # of runs; infinite ones are told apart by the eye


@checked
def show(frame: pd.DataFrame, formats: dict[str, str] | str | None = None) -> Styler:
    """A table without its index; ``formats`` of its numbers, by column; ``p`` is a p value.

    A number that there is not is a dash.
    """
    for column in formats if isinstance(formats, dict) else ():
        check_choice("formats", column, frame.columns)
    style = frame.style.format(formats, na_rep="–")
    if "p" in frame.columns:
        style = style.format(_p_value, subset=["p"])
    return style.hide().set_table_attributes('class="dataframe"')


def _p_value(p: float) -> str:
    """Three decimals, or that it is smaller."""
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


@checked
def mean_and_std(values: Values, digits: Natural = 1) -> str:
    """Of runs; the standard deviation is that of the paper (ddof 0)."""
    return f"{values.mean():.{digits}f} ± {values.std(ddof=0):.{digits}f}"


@checked
def costs(folder: str | Path, names: Sequence[str]) -> Styler:
    """What it took to compute experiments, from the record beside the rows of each.

    Raises:
        ValueError: an experiment without rows in ``folder``.
    """

    def row(name: str) -> dict[str, object]:
        batches = Store(Path(folder), name).batches()
        if not batches:
            raise ValueError(f"names: has {name!r}, must be experiments with rows in {folder}")
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


@checked
def beside_shipped(live: pd.DataFrame, shipped: pd.DataFrame) -> pd.DataFrame:
    """Live rows with the shipped ones of the same keys, and how far they are apart.

    A ``relative difference`` is one to the shipped value, or to 0.001 where that is nearly zero.
    Infinite values differ by nothing from each other, and infinitely from all others.

    Raises:
        ValueError: rows that cannot be compared, or a live one of which none is shipped.
    """
    keys = [column for column in live.columns if column != "value"]
    for name, rows in {"live": live, "shipped": shipped}.items():
        _check_comparable(name, rows, keys)
    both = live.rename(columns={"value": "live"}).merge(
        shipped.rename(columns={"value": "shipped"}), on=keys, how="left"
    )
    if both["shipped"].isna().any():
        first = both.loc[both["shipped"].isna(), keys].iloc[0].to_dict()
        raise ValueError(f"shipped: has no row for {first}, must have one for each live row")
    difference = (both["live"] - both["shipped"]).abs().mask(both["live"] == both["shipped"], 0.0)
    relative = difference / (both["shipped"].abs() + 1e-3)
    relative = relative.mask(difference == np.inf, np.inf)
    return both.assign(**{"difference": difference, "relative difference": relative})


def _check_comparable(name: str, rows: pd.DataFrame, keys: Sequence[str]) -> None:
    """Whether a difference, and a mean or a maximum of some, would be of all rows."""
    if absent := [column for column in (*keys, "value") if column not in rows.columns]:
        raise ValueError(f"{name}: has no column {absent[0]!r}, must have {[*keys, 'value']}")
    if rows.empty or rows["value"].isna().any():
        raise ValueError(f"{name}: is empty or has NaN, must have a number in each row")
    if (double := rows[rows.duplicated(keys)]).size:
        first = double.iloc[0][keys].to_dict()
        raise ValueError(f"{name}: has two rows for {first}, must have one")


@checked
def largest_differences(
    live: pd.DataFrame, shipped: pd.DataFrame, by: Sequence[str]
) -> pd.DataFrame:
    """The largest relative difference of live rows from the shipped ones, by groups."""
    check_choices("by", by, live.columns)
    groups = beside_shipped(live, shipped).groupby(list(by), sort=False, dropna=False)
    largest = groups["relative difference"].max().reset_index()
    return largest.rename(columns={"relative difference": "largest relative difference"})


@checked
def mean_and_interval(values: Values, digits: Natural = 2) -> str:
    """Of runs, with the 95 % interval of the mean."""
    low, high = mean_interval(values.to_numpy())
    return f"{values.mean():.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


@checked
def by_method(
    rows: pd.DataFrame, columns: str, names: Mapping[str, str], digits: Natural = 2
) -> pd.DataFrame:
    """A line for each method in the order of its ``names``, a column for each value of a column.

    What stands there is :func:`mean_and_interval` of all runs.

    Raises:
        ValueError: two values of a run in one place of the table.
    """
    check_choice("columns", columns, rows.columns)
    _check_comparable("rows", rows, ["method", columns, "run"])
    groups = rows.groupby(["method", columns])["value"]
    wide = groups.apply(mean_and_interval, digits=digits).unstack()
    present = [method for method in names if method in wide.index]
    return wide.reindex(present).rename(index=names).rename_axis("method")


def chosen_by(rows: pd.DataFrame, criterion: str) -> pd.DataFrame:
    """The rows of the penalty with the lowest ``criterion``: each run chooses by itself."""
    if len(rows):  # without rows, nothing is chosen
        check_choice("criterion", criterion, rows["metric"].unique().tolist())
    keys = ["problem", "method", "run"]
    scores = rows[rows["metric"] == criterion].sort_values("value", kind="stable")
    best = scores.drop_duplicates(keys)[[*keys, "penalty"]]
    return rows.merge(best, on=[*keys, "penalty"])
