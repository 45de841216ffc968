"""Rules for coloured keys."""

from __future__ import annotations

import numpy as np
import pandas as pd

from rules.cells import Cells, label, paper_effect
from rules.verdicts import Compared, Finding, compare, holds, together


def smaller_spread(
    cells: Cells,
    paper: pd.DataFrame,
    method: str,
    baseline: str,
    domain: str,
    metric: str,
    paired: bool,
) -> Finding:
    """The method's runs vary less.

    The test of Brown and Forsythe, paired by run where it can be: of distances of runs from the
    median of their arm. The mean distance of normal runs is sqrt(2 / pi) standard deviations, which
    makes the paper's deviations comparable.
    """
    ours, theirs = (
        cells.runs(method=name, domain=domain, metric=metric) for name in (method, baseline)
    )
    effect = paper_effect(paper, baseline, method, [domain], of="std")
    if effect is not None:
        effect *= np.sqrt(2 / np.pi)
    found = narrower(ours, theirs, effect, paired)
    evidence = (
        f"standard deviation over runs on {domain}: {label(method)} {ours.std(ddof=0):.3f}, "
        f"{label(baseline)} {theirs.std(ddof=0):.3f}; {label(method)} is nearer to its median by "
        f"{found.text()}"
    )
    return Finding(found.verdict, evidence)


def narrower(
    values: pd.Series, baseline: pd.Series, effect: float | None = None, paired: bool = True
) -> Compared:
    """By how much values are nearer to their median than the baseline's are to theirs."""
    own, others = ((runs - runs.median()).abs() for runs in (values, baseline))
    return compare(others, own, effect, paired)


def not_better(
    cells: Cells,
    paper: pd.DataFrame,
    domain: str,
    metric: str,
    comparisons: dict[str, dict],
) -> Finding:
    """In no comparison is a method better than its baseline beyond chance.

    A comparison names both, and the ``first`` and ``last`` of the runs that count.
    """
    verdicts, parts = [], []
    for name, own in comparisons.items():
        chosen = cells.between(own["first"], own["last"])
        ours, theirs = (
            chosen.runs(method=own[arm], domain=domain, metric=metric)
            for arm in ("method", "baseline")
        )
        found = compare(ours, theirs)
        verdicts.append(holds(found.difference.low <= 0))
        parts.append(
            f"{name}, {len(ours)} runs: {label(own['method'])} has {ours.mean():.3f} on {domain}, "
            f"{label(own['baseline'])} {theirs.mean():.3f}, {found.text()}"
        )
    return Finding(together(verdicts), "; ".join(parts))


def degrades(
    cells: Cells,
    paper: pd.DataFrame,
    method: str,
    trained: list[str],
    tested: str,
    metric: str,
) -> Finding:
    """The return in the training domains is higher than in the tested one."""
    before = cells.over(trained, "mean", method=method, metric=metric)
    after = cells.runs(method=method, domain=tested, metric=metric)
    means = paper[paper["method"] == method].set_index("domain")["mean"]
    found = compare(before, after, float(means[trained].mean() - means[tested]))
    evidence = (
        f"{label(method)} has {before.mean():.3f} in training and {after.mean():.3f} on {tested}, "
        f"a loss of {found.text()}"
    )
    return Finding(found.verdict, evidence)
