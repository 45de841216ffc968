"""What a controller costs in a new domain, and which columns and directions its gain uses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from experiments.figures import STYLES
from experiments.lqr import OPTIMIZERS
from experiments.store import select
from ipo.lqr import oracle_cost
from ipo.lqr_learners import LQR_METHODS

CELL = ["method", "optimizer", "num_domains", "dim_distractor"]
# Metrics whose means over runs are shown, by their names in the data.
MEANS = {
    "train": "train_cost",
    "state": "gain_norm_state",
    "distractors": "gain_norm_distractor",
    "inside": "gain_norm_inside",
    "outside": "gain_norm_outside",
}
METHODS = (*LQR_METHODS, "minimum_norm")


def costs_and_gains(tables: Sequence[pd.DataFrame], sizes: Mapping[str, int]) -> dict[str, Any]:
    """The data: per cell, the cost in a new domain of every run, and means over runs.

    Args:
        tables: rows of experiments; a run that is in several counts once.
        sizes: ``num_domains`` and ``dim_distractor`` that are shown first.
    """
    rows = pd.concat(tables).drop_duplicates([*CELL, "run", "metric"]).sort_values("run")
    return {
        "first": {"method": "gradient_descent", "optimizer": "adam", **sizes},
        "methods": {name: {"name": STYLES[name][0], "color": STYLES[name][1]} for name in METHODS},
        "optimizers": OPTIMIZERS,
        "oracle": oracle_cost(),
        "cells": [
            dict(zip(CELL, cell, strict=True)) | _numbers(of_cell)
            for cell, of_cell in rows[rows["method"].isin(METHODS)].groupby(CELL)
        ],
    }


def _numbers(rows: pd.DataFrame) -> dict[str, Any]:
    values = {metric: part["value"] for metric, part in rows.groupby("metric")}
    means = {name: round(values[metric].mean(), 4) for name, metric in MEANS.items()}
    return {"test": values["test_cost"].round(3).tolist(), **means}


def picture(data: Mapping[str, Any]) -> Figure:
    """What the script shows first."""
    cells = pd.DataFrame(data["cells"])
    shown = select(cells, {key: data["first"][key] for key in ("num_domains", "dim_distractor")})
    shown = shown.sort_values("test", key=lambda costs: costs.map(np.mean))
    fig, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2))
    for place, cell in enumerate(shown.itertuples()):
        color = data["methods"][cell.method]["color"]
        left.scatter(cell.test, [place] * len(cell.test), color=color, s=16, alpha=0.7)
    left.axvline(data["oracle"], color="black", ls="--", lw=1)
    left.set_yticks(range(len(shown)), [_name(data, cell) for cell in shown.itertuples()])
    left.set(xlabel="cost in a new domain (dashed: oracle)")
    (chosen,) = select(cells, data["first"]).itertuples()
    parts = ["outside", "inside", "distractors", "state"]
    right.barh(parts, [getattr(chosen, part) for part in parts], color="0.6")
    right.set(xlabel="norm of K, mean over runs", title=_name(data, chosen))
    return fig


def _name(data: Mapping[str, Any], cell: Any) -> str:
    name = data["methods"][cell.method]["name"]
    return name if cell.optimizer == "none" else f"{name}, {data['optimizers'][cell.optimizer]}"
