"""Rules for the ways of opening doors."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import scipy.stats

from experiments.doors.pulling import strategy_of_part, strategy_of_policy
from ipo.stats import mean_interval
from rules.cells import Cells, NoData, label, shown, with_interval
from rules.verdicts import (
    UNDECIDED,
    Finding,
    compare,
    detectable,
    holds,
    verdict,
    within,
)

DOOR = ["method", "run", "steps", "door"]


def ways_of(cells: Cells, domain: float, arm: dict[str, Any]) -> pd.Series:
    """The strategy of every policy of an arm, by run."""
    where = {"metric": "inside_part", "domain": domain, **arm}
    cells.runs(**where)  # complete, or no verdict
    parts = cells.select(**where).groupby("run")["value"]
    return parts.agg(lambda own: strategy_of_policy(own.tolist()))


def most_policies(
    cells: Cells,
    paper: pd.DataFrame,
    domain: float,
    arm: dict[str, Any],
    way: str,
    all_of_them: bool,
) -> Finding:
    """More than half of an arm's policies, or all of them, open doors in one way.

    By the exact (Clopper-Pearson) 95 % interval of their share.
    """
    ways = ways_of(cells, domain, arm)
    method = arm["method"]
    counts = ways.value_counts().reindex(["hook", "mixed", "outside"], fill_value=0)
    low, high = scipy.stats.binomtest(int(counts[way]), len(ways)).proportion_ci()
    theirs = paper[paper["method"] == method].set_index("strategy")["runs"]
    share = theirs[way] / theirs.sum()
    evidence = (
        f"{label(method)}: " + ", ".join(f"{n} {name}" for name, n in counts.items())
    ) + f"; the share of {way} has the 95 % interval [{low:.0%}, {high:.0%}], the paper {share:.0%}"
    if all_of_them:
        return Finding(holds(counts[way] == len(ways)), evidence)
    there = power_beyond_half(share, len(ways))
    evidence += f"; the power to tell that from half of them is {there:.0%}"
    return Finding(verdict(low - 0.5, high - 0.5, share - 0.5), evidence)


def power_beyond_half(share: float, num_policies: int) -> float:
    """How probable it is that the exact interval of a true share lies above one half."""
    counts = np.arange(num_policies + 1)
    above = [scipy.stats.binomtest(k, num_policies).proportion_ci().low > 0.5 for k in counts]
    return float(scipy.stats.binom.pmf(counts, num_policies, share)[above].sum())


def more_often(
    cells: Cells,
    paper: pd.DataFrame,
    domain: float,
    way: str,
    method: dict[str, Any],
    baseline: dict[str, Any],
) -> Finding:
    """More of one arm's policies than of another's open doors in this way, paired by run."""
    theirs = paper.pivot(index="strategy", columns="method", values="runs").fillna(0)
    shares = theirs.loc[way] / theirs.sum()
    ours, base = ((ways_of(cells, domain, arm) == way).astype(float) for arm in (method, baseline))
    found = compare(ours, base, float(shares[method["method"]] - shares[baseline["method"]]))
    evidence = (
        f"{way}: {label(method['method'])} {ours.sum():.0f} of {len(ours)}, "
        f"{label(baseline['method'])} {base.sum():.0f} of {len(base)}; the share differs by "
        f"{found.text()}"
    )
    return Finding(found.verdict, evidence)


def viable(
    cells: Cells,
    paper: pd.DataFrame,
    watched: float,
    tested: float,
    way: str,
    least: float,
    arms: list[dict[str, Any]],
) -> Finding:
    """Policies that open doors in this way open at least so many of them, in the mean."""
    rates = []
    for arm in arms:
        ways = ways_of(cells, watched, arm)
        success = cells.runs(metric="success", domain=tested, **arm)
        rates += success[ways[ways == way].index].tolist()
    if len(rates) < 2:
        raise NoData(f"policies of the way {way}: {len(rates)}, and it takes 2")
    low, high = mean_interval(rates)
    high = min(high, 1.0)  # more doors than all cannot be opened
    evidence = (
        f"{len(rates)} policies of the way {way} open {np.mean(rates):.1%} of the doors at "
        f"friction {tested}, 95 % interval [{low:.1%}, {high:.1%}], the worst of them "
        f"{min(rates):.1%}; with a power of 80 % they would be told from {least:.0%} by "
        f"{100 * detectable(np.std(rates, ddof=1), len(rates)):.1f} points more"
    )
    return Finding(within(low, high, least, np.inf), evidence)


def hooks_are_robust(
    cells: Cells,
    paper: pd.DataFrame,
    watched: float,
    tested: float,
    matched: bool,
    unit: list[str],
    arms: list[dict[str, Any]],
) -> Finding:
    """What is hooked at one friction opens more often at a higher one.

    ``matched`` compares policies at the same doors; otherwise it is policies that are compared.
    """
    if matched:
        doors = pd.concat(doors_of(cells, watched, tested, arm) for arm in arms)
        return matched_on_doors(doors, unit)
    part, success = (
        pd.concat([cells.runs(metric=metric, domain=domain, **arm) for arm in arms])
        for metric, domain in (("inside_part", watched), ("success", tested))
    )
    found = scipy.stats.spearmanr(part, success)
    evidence = (
        f"rank correlation over {len(part)} policies between the share of the hook's inside and "
        f"success: {shown(found.statistic, '+.2f')}, p = {found.pvalue:.3f}"
    )
    clear = found.pvalue < 0.05  # and not NaN, as where all policies are alike
    return Finding(holds(found.statistic > 0) if clear else UNDECIDED, evidence)


def matched_on_doors(doors: pd.DataFrame, unit: list[str]) -> Finding:
    """Policies that hook a door open it more often at a high friction than those that do not.

    The effect is that of least squares with a constant for each door,

        opened[p, d] = a_d + b hooked[p, d]

    over doors d that some policies p hook and others pull with the outside. What a policy does at
    one door goes with what it does at the next, so residuals are summed by ``unit`` before they
    make the standard error (Liang and Zeger, 1986); Student's t has a degree of freedom less than
    there are units.
    """
    both = doors[doors.groupby("door")["hooked"].transform("nunique") == 2]
    if both.empty:
        raise NoData("doors that are opened in both ways: 0")
    own = both[["hooked", "opened"]] - both.groupby("door")[["hooked", "opened"]].transform("mean")
    squares = (own["hooked"] ** 2).sum()
    effect = (own["hooked"] * own["opened"]).sum() / squares
    residuals = own["hooked"] * (own["opened"] - effect * own["hooked"])
    scores = residuals.groupby([both[column] for column in unit]).sum()
    num = len(scores)
    error = np.sqrt((scores**2).sum() * num / (num - 1)) / squares
    low, high = effect + np.array([-1, 1]) * scipy.stats.t.ppf(0.975, num - 1) * error
    evidence = (
        f"at {both['door'].nunique()} doors that are opened in both ways, policies that hook open "
        f"more by {with_interval(effect, low, high)}, over {num} "
        f"{'seeds' if unit == ['run'] else 'trainings'}; with a power of 80 % they would find "
        f"{shown(detectable(error * np.sqrt(num), num), '+.3f')}"
    )
    return Finding(verdict(low, high), evidence)


def doors_of(cells: Cells, watched: float, tested: float, arm: dict[str, Any]) -> pd.DataFrame:
    """Doors that an arm's policies open in one way at one friction, and whether at another."""
    for metric, domain in (("inside_part", watched), ("success", tested)):
        cells.runs(metric=metric, domain=domain, **arm)  # complete, or no verdict
    parts = cells.select(metric="inside_part", domain=watched, **arm).set_index(DOOR)["value"]
    ways = parts.map(strategy_of_part)
    opened = cells.select(metric="success", domain=tested, **arm).groupby(DOOR)["value"].first()
    hooked = (ways[ways != "mixed"] == "hook").astype(float).rename("hooked")
    return hooked.to_frame().join(opened.rename("opened"), how="inner").reset_index()
