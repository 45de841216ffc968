"""Which part of IPO lowers the cost under Adam: players, their average, turns, or single domains?

Between gradient descent and IPO more than one thing changes. These arms change one at a time:

    gradient_descent_steps      pooled cost, with IPO's learning rate and number of steps
    ensemble                    as many players as IPO, in turn, but each on the pooled cost
    ipo_together                IPO, whose players all move at the same average
    in_turn                     one controller, one optimiser, on the cost of one domain at a time
    in_turn_short               the same with as many steps as gradient descent
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import pandas as pd

from experiments.lqr import Cell, published_cell
from experiments.store import select
from experiments.tables import mean_and_std
from ipo.stats import paired_difference

ARMS = {
    "gradient_descent": "gradient descent",
    "gradient_descent_steps": "gradient descent, IPO's rate and steps",
    "ensemble": "ensemble: players on the pooled cost",
    "in_turn": "one controller, one domain at a time",
    "in_turn_short": "… with gradient descent's steps",
    "ipo_together": "IPO, players move together",
    "ipo_fixed_phi": "IPO",
}


def turn_cells(sizes: Iterable[tuple[int, int]], num_iterations: int) -> list[Cell]:
    """The arms that are not in the paper's tables, for pairs of n_d and n_y."""
    return [arm for size in sizes for arm in arms(*size, num_iterations)]


def arms(num_domains: int, dim_distractor: int, num_iterations: int) -> list[Cell]:
    """All of them in one configuration."""
    ipo = published_cell("ipo_fixed_phi", num_domains, dim_distractor, num_iterations)

    def arm(label: str, **changes: object) -> Cell:
        return replace(ipo, label=label, settings=replace(ipo.settings, **changes))

    steps = num_domains * num_iterations
    few = max(1, num_iterations // num_domains)
    return [
        arm("in_turn", method="in_turn"),
        arm("in_turn_short", method="in_turn", num_iterations=few),
        arm("ipo_together", order="together"),
        arm("gradient_descent_steps", method="gradient_descent", num_iterations=steps),
        arm("ensemble", method="ensemble"),
    ]


def costs(rows: pd.DataFrame, **fixed: int) -> pd.DataFrame:
    """Cost in a new domain, mean ± standard deviation over runs, by arm and number of domains."""
    chosen = select(rows, {"metric": "test_cost", "optimizer": "adam", **fixed})
    groups = chosen.groupby(["method", "num_domains"])["value"]
    table = groups.agg(mean_and_std).unstack().reindex(list(ARMS))
    table = table.rename(index=ARMS, columns="{} domains".format)
    return table.rename_axis(index="arm", columns=None).reset_index()


def recovered(rows: pd.DataFrame) -> pd.DataFrame:
    """The share of IPO's advantage over gradient descent that each arm has, per configuration.

        (cost of gradient descent - cost of the arm) / (cost of gradient descent - cost of IPO)

    in means over runs; 1 is all of it.
    """
    gained = ahead(rows)
    return gained.div(gained["ipo_fixed_phi"], axis=0).reindex(columns=list(ARMS))


def ahead(rows: pd.DataFrame) -> pd.DataFrame:
    """How much less each arm costs in a new domain than gradient descent, per configuration."""
    mean = _by_arm(rows).groupby(level=["num_domains", "dim_distractor"]).mean()
    return mean.rsub(mean["gradient_descent"], axis=0)


def shares_table(rows: pd.DataFrame) -> pd.DataFrame:
    """:func:`recovered`, and how much more one domain at a time costs than IPO, paired by run."""
    shares = recovered(rows).drop(columns=["gradient_descent", "ipo_fixed_phi"])
    table = shares.map("{:.2f}".format).rename(columns=ARMS)
    table["one domain at a time − IPO, cost"] = [
        f"{found.mean:+.1f} [{found.low:+.1f}, {found.high:+.1f}]"
        for _, own in _by_arm(rows).groupby(level=["num_domains", "dim_distractor"])
        for found in [paired_difference(own["in_turn"], own["ipo_fixed_phi"])]
    ]
    return table.rename_axis(index=["domains", "distractors"], columns=None).reset_index()


def _by_arm(rows: pd.DataFrame) -> pd.DataFrame:
    """Cost in a new domain, a row per configuration and run, a column per arm."""
    chosen = select(rows, {"metric": "test_cost", "optimizer": "adam"})
    return chosen.pivot_table(
        "value", index=["num_domains", "dim_distractor", "run"], columns="method"
    )
