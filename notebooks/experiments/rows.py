"""Tidy rows of what a batch of runs came to."""

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
