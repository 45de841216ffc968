"""The rows that rules look at: cells of results, and the paper's numbers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
import scipy.stats

from experiments.store import select

NAMES = {
    "gradient_descent": "gradient descent",
    "overparameterized": "overparameterised",
    "ipo_fixed_phi": "IPO, fixed Φ",
    "ipo_variable_phi": "IPO, variable Φ",
    "ipo_variable_phi_phi0.01_gain0": "IPO, variable Φ from 0.01",
    "ipo_variable_phi_phi0.1_gain0": "IPO, variable Φ from 0.1",
    "ipo_variable_phi_phi0.3_gain0": "IPO, variable Φ from 0.3",
    "in_turn": "one learner on one domain at a time",
    "in_turn_short": "one learner on one domain at a time, fewer rounds",
    "ipo_together": "IPO, players moving together",
    "gradient_descent_steps": "gradient descent, IPO's rate and steps",
    "oracle": "oracle",
    "ppo": "PPO",
    "ipo": "IPO",
    "ensemble": "the ensemble with pooled data",
    "ppo_lr5e-4": "PPO with IPO's learning rate",
    "ipo_lr1e-3": "IPO with PPO's learning rate",
    "in_turn_lr1e-3": "one learner on one domain at a time, PPO's learning rate",
    "ipo_adam": "IPO with Adam",
    "ipo_plain": "IPO with plain steps",
    "ipo_phi": "IPO with variable Φ",
    "ipo_phi_short": "IPO with variable Φ and half the rounds",
    "ipo_inner2": "IPO with K = 2",
    "irmv1": "IRMv1",
    "irm_game_fixed_phi": "IRM-Games, fixed Φ",
    "irm_game_variable_phi": "IRM-Games, variable Φ",
}


class NoData(Exception):
    """A cell that a rule needs is missing."""


@dataclass(frozen=True)
class Cells:
    """Rows of results, and how many runs make a cell complete."""

    rows: pd.DataFrame
    num_runs: int

    def select(self, **where: Any) -> pd.DataFrame:
        """The rows with these values in these columns; domains are words, also those of doors."""
        words = {"domain": str(where["domain"])} if "domain" in where else {}
        return select(self.rows, where | words)

    def runs(self, **where: Any) -> pd.Series:
        """Value of every run of a cell, or the mean of its values, indexed by run."""
        chosen = self.select(**where)
        values = chosen.groupby("run")["value"].mean(skipna=False)
        if len(values) < self.num_runs or values.isna().any():
            cell = ", ".join(f"{column} {value}" for column, value in where.items())
            raise NoData(f"{cell}: {values.count()} of {self.num_runs} runs")
        return values

    def over(self, domains: list, summary: str, **where: Any) -> pd.Series:
        """The mean or the worst (``min``) over domains of every run."""
        by_domain = [self.runs(domain=domain, **where) for domain in domains]
        return pd.concat(by_domain, axis=1).agg(summary, axis=1)

    def between(self, first: int, last: int) -> Cells:
        """Of these runs alone."""
        runs = self.rows["run"]
        own = self.rows[(first <= runs) & (runs <= last)]
        return replace(self, rows=own, num_runs=min(self.num_runs, last + 1) - first)


def published(paper: pd.DataFrame) -> Iterator[tuple[dict[str, Any], float, float]]:
    """Every cell of the paper's tables: what it is of, its mean and its standard deviation."""
    columns = [name for name in paper.columns if name not in ("table", "mean", "std", "text")]
    for _, row in paper.iterrows():
        yield row[columns].to_dict(), float(row["mean"]), float(row["std"])


def paper_effect(
    paper: pd.DataFrame,
    method: str,
    baseline: str,
    domains: list,
    summary: str = "mean",
    of: str = "mean",
) -> float | None:
    """The paper's mean (or ``std``) of a method minus its baseline's; none, unless it has both."""
    numbers = paper.pivot(index="domain", columns="method", values=of)
    words = [str(domain) for domain in domains]
    if not {method, baseline} <= set(numbers.columns) or not set(words) <= set(numbers.index):
        return None
    over = numbers.loc[words].agg(summary)
    return float(over[method] - over[baseline])


def label(method: str) -> str:
    """The name of a method; one without goes by that of its rows."""
    return NAMES.get(method, method.replace("_", " "))


def shown(number: float, spec: str = "z.1f") -> str:
    """By a format, with a true minus sign; one decimal and no negative zero unless it is given."""
    return format(number, spec).replace("-", "−")


def with_interval(mean: float, low: float, high: float, digits: int = 3) -> str:
    """An effect and its 95 % interval, with their signs."""
    return in_brackets(mean, low, high, f"+.{digits}f").replace(" [", ", 95 % interval [")


def in_brackets(mean: float, low: float, high: float, spec: str) -> str:
    """The same, shorter, for several in a row: the page says what brackets are."""
    effect, *ends = (shown(number, spec) for number in (mean, low, high))
    return f"{effect} [{', '.join(ends)}]"


def welch_of_tables(
    paper: pd.DataFrame, method: str, baseline: str, num_runs: int
) -> tuple[np.ndarray, np.ndarray]:
    """P of the paper's own differences ``[cells]`` by Welch's test, from its tables.

    The ± of a table may be the deviation of its runs themselves (ddof 0), or the estimate of that
    of all runs there could be (ddof 1): p of the one reading, and of the other.
    """
    columns = [name for name in paper.columns if name not in ("method", "mean", "std", "text")]
    ours, theirs = (
        paper[paper["method"] == name].sort_values(columns) for name in (method, baseline)
    )
    zero, one = (
        scipy.stats.ttest_ind_from_stats(
            *(ours["mean"], ours["std"] * scale, num_runs),
            *(theirs["mean"], theirs["std"] * scale, num_runs),
            equal_var=False,
        ).pvalue
        for scale in (np.sqrt(num_runs / (num_runs - 1)), 1.0)
    )
    return zero, one


def paper_tests(paper: pd.DataFrame, method: str, baseline: str, num_runs: int) -> str:
    """What the paper's own means and standard deviations say, by Welch's test."""
    zero, one = welch_of_tables(paper, method, baseline, num_runs)
    return f"by Welch's test p = {span(zero)} where its ± has ddof 0, {span(one)} where it has 1"


def span(values: np.ndarray) -> str:
    """The least and the largest of some numbers, or the only one."""
    least, most = f"{min(values):.2f}", f"{max(values):.2f}"
    return least if least == most else f"{least} to {most}"
