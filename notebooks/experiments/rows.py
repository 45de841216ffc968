"""Tidy rows of what a batch of runs came to, and what makes rows unfit to be stored."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from experiments.experiment import Cell


def tidy(
    cell: Cell, seeds: Sequence[int], metrics: Mapping[tuple[str, str], Any], **more: Any
) -> pd.DataFrame:
    """A row for each run, domain and metric: the cell's columns, ``more``, and the value.

    ``metrics`` holds the values ``[R]`` of all runs, keyed by domain and metric.
    """
    return pd.DataFrame(
        {
            **cell.columns,
            **more,
            "run": seed,
            "domain": domain,
            "metric": metric,
            "value": float(value),
        }
        for (domain, metric), values in metrics.items()
        for seed, value in zip(seeds, values, strict=True)
    )


class ResultsError(ValueError):
    """Rows that cannot be used; nothing was changed."""


def check_rows(cell: Cell, seeds: Sequence[int], rows: pd.DataFrame) -> None:
    """Whether rows are those of a cell and seeds, each once, with a number in each.

    Infinite numbers are allowed: a controller that is not stable has an infinite cost.

    Raises:
        ResultsError: rows that are not; the message names the cell and what is wrong.
    """
    if problem := _problem(cell.columns, set(seeds), rows):
        raise ResultsError(f"rows of {cell.columns}, runs {list(seeds)}: {problem}")


def types_of(rows: pd.DataFrame) -> dict[str, str]:
    """The type of every column, as the record of results names them; ``str`` for what is left."""
    kinds = {"i": "int64", "u": "int64", "f": "float64", "b": "bool"}
    return {column: kinds.get(rows[column].dtype.kind, "str") for column in rows.columns}


def _problem(columns: Mapping[str, Any], seeds: set[int], rows: pd.DataFrame) -> str | None:
    """What is wrong with rows, in words; None: nothing."""
    if rows.empty:
        return "there are none"
    if absent := [column for column in (*columns, "run", "value") if column not in rows.columns]:
        return f"column {absent[0]!r} is missing"
    for column, kind in types_of(rows).items():
        if rows[column].isna().any():
            return f"column {column!r} has no value, or NaN, in {rows[column].isna().sum()} rows"
        if kind == "str" and (odd := [v for v in rows[column] if not isinstance(v, str)]):
            return (
                f"column {column!r} has {odd[0]!r}, must be all text or all of one kind of number"
            )
    for column, value in columns.items():
        if (others := rows.loc[rows[column] != value, column]).size:
            return f"{column} = {others.iloc[0]!r}, must be {value!r}"
    if (found := set(rows["run"])) != seeds:
        return f"they are of runs {sorted(found)}"
    places = rows.drop(columns="value")
    if (double := places[places.duplicated()]).size:
        return f"two of them are of {double.iloc[0].to_dict()}"
    return None
