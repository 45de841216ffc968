"""The arms of the chapter on doors, four from two trainings, and controls; rows of an arm.

An arm is a cell of :mod:`experiments.doors.success`; its rows are those with the cell's columns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from experiments.doors import training as door_training
from experiments.doors.success import Cell
from experiments.store import select
from experiments.tables import mean_and_std
from ipo.stats import mean_interval

NAMES = {
    "ppo_half": "PPO, half",
    "ppo": "PPO, as published",
    "ipo_half": "IPO, as published",
    "ipo": "IPO, as in the text",
}
CONTROLS = {
    "ppo_half": "PPO",
    "in_turn": "one network, one domain at a time",
    "ensemble": "ensemble, all doors for both networks",
    "ipo_lr1e-3": "IPO with PPO's learning rate",
    "ppo_same_doors": "PPO, same doors",
    "ppo_wide_same_doors": "PPO, same doors, as many weights",
    "ppo_16_16": "PPO, same doors, as many of both frictions",
    "ppo_by_domain": "PPO, same doors, rewards normalised by friction",
    "ensemble_same_doors": "ensemble, same doors",
}  # as long as IPO as published was trained
PUBLISHED = ("ppo", "ipo_half")  # with the steps of the published runs


def trainings(num_updates: int, num_steps: int) -> dict[str, door_training.Cell]:
    """PPO and IPO as published, saved at half time and in the end; minibatches keep their size."""
    changes = {"num_updates": num_updates, **_sizes(num_steps)}
    return {
        method: door_training.Cell(
            method,
            door_training.published_door(method, **changes),
            saved_after=(num_updates // 2, num_updates),
            curve_every=_curve_every(num_updates),
        )
        for method in ("ppo", "ipo")
    }


def controls(num_updates: int, num_steps: int) -> dict[str, door_training.Cell]:
    """Trainings beside these, until half time: what a difference is due to."""
    every = _curve_every(num_updates)
    return door_training.controls(num_updates // 2, every, **_sizes(num_steps))


def controls_of(trained: Mapping[str, door_training.Cell], **options: Any) -> dict[str, Cell]:
    """Their policies in the end; ``options`` of :class:`Cell`."""
    return {label: Cell(cell, *cell.saved_after, **options) for label, cell in trained.items()}


def _sizes(num_steps: int) -> dict[str, int]:
    """Of rollouts, and how many minibatches keep their size."""
    return {"num_steps": num_steps, "num_minibatches": max(1, 256 * num_steps // 4096)}


def _curve_every(num_updates: int) -> int:
    return max(num_updates // 19, 1)


def arms_of(trained: Mapping[str, door_training.Cell], **options: Any) -> dict[str, Cell]:
    """Both trainings at half time and in the end; ``options`` of :class:`Cell`."""
    return {
        arm: Cell(trained[method], trained[method].saved_after[age], **options)
        for arm, method, age in (
            ("ppo_half", "ppo", 0),
            ("ppo", "ppo", 1),
            ("ipo_half", "ipo", 0),
            ("ipo", "ipo", 1),
        )
    }


def of_arm(rows: pd.DataFrame, cell: Cell, friction: float | None = None) -> pd.DataFrame:
    """Rows of an arm's policies, in one domain or in all."""
    chosen = select(rows, cell.columns)
    return chosen if friction is None else chosen[chosen["domain"] == str(friction)]


def cell_of(row: pd.Series, arms: Mapping[str, Cell]) -> Cell:
    """The arm that a row belongs to."""
    return next(cell for cell in arms.values() if dict(row[list(cell.columns)]) == cell.columns)


def rate(rows: pd.DataFrame, cell: Cell, friction: float) -> pd.Series:
    """Part of the doors opened, by run."""
    return of_arm(rows, cell, friction).groupby("run")["value"].mean()


def mean_rate(rows: pd.DataFrame, cell: Cell, frictions: Sequence[float]) -> pd.Series:
    """Part of the doors opened, mean over frictions, by run."""
    return sum(rate(rows, cell, friction) for friction in frictions) / len(frictions)


def rate_by_friction(rows: pd.DataFrame) -> pd.Series:
    """Part of the doors opened by all runs together."""
    found = rows[rows["metric"] == "success"].groupby("domain")["value"].mean()
    found.index = found.index.astype(float)
    return found.sort_index()


def percent(values: pd.Series) -> str:
    return mean_and_std(100 * values)


def percent_with_interval(values: pd.Series) -> str:
    """Mean over runs with its 95 % interval."""
    values = 100 * values  # before the mean, as in `percent`: they round alike
    low, high = mean_interval(values.to_numpy())
    return f"{values.mean():.1f} [{low:.0f}, {high:.0f}]"
