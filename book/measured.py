"""Differences between two arms, from the rows, for the pages on fairness and on deviations."""

from __future__ import annotations

from functools import cache
from typing import Any

import pandas as pd

from experiments.registry import DATA
from experiments.store import Store
from rules.cells import Cells
from rules.verdicts import compare

FEWEST_RUNS = 10  # of an arm, unless an entry says that it has fewer
NO_BREAK = "\N{NO-BREAK SPACE}"


def difference(problem: dict, arms: dict) -> str:
    """How far an arm is ahead of another in the problem's measure, with its 95 % interval.

    Args:
        problem: ``where``, the columns of its rows; ``domains`` whose mean is taken; ``sign``, -1
            where less is better, and ``scale`` of the values; ``digits`` that are shown.
        arms: ``of`` and ``against``, the columns of the two; ``results``, in which they are;
            ``where`` and ``domains``, if they are others than the problem's; ``num_runs``, if an
            arm has fewer than the others, which is then said.
    """
    ahead, behind = (values(problem, arms, arms[side]) for side in ("of", "against"))
    runs = ahead.index.intersection(behind.index)  # some arms have more
    sign, digits = problem["sign"] * problem["scale"], problem["digits"]
    mean, low, high, _ = compare(sign * ahead[runs], sign * behind[runs]).difference
    text = f"{mean:+.{digits}f} [{low:+.{digits}f}, {high:+.{digits}f}]".replace("-", "−")
    few = f" ({len(runs)} pairs)" if len(runs) < FEWEST_RUNS else ""
    return text.replace(" ", NO_BREAK) + few


def listed(problem: dict, entry: dict) -> list[str]:
    """Every difference of an entry, a line each."""
    measured = entry.get("measured", {})
    return [f"→ {name}: **{difference(problem, arms)}**" for name, arms in measured.items()]


def values(problem: dict, arms: dict, arm: dict) -> pd.Series:
    """Of every run, the mean over the domains."""
    num_runs = arms.get("num_runs", FEWEST_RUNS)
    cells = Cells(pd.concat(map(rows, arms["results"]), ignore_index=True), num_runs)
    where: dict[str, Any] = problem["where"] | arms.get("where", {}) | arm
    return cells.over(arms.get("domains", problem["domains"]), "mean", **where)


@cache
def rows(name: str) -> pd.DataFrame:
    """Of ``chapter/name``."""
    chapter, _, file = name.partition("/")
    return Store(DATA / "results" / chapter, file).rows()
