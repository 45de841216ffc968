"""Regularisers that the paper names and does not run, on pooled training, for keys and for LQR.

Weight decay (decoupled, AdamW), dropout, and penalties on what differs between training domains:
the variance of returns or costs (V-REx) and their slope in a factor on the policy (IRMv1).

How strong a regulariser is comes from training domains alone, by a rule that was fixed, with the
grids, before anything was trained: the largest weight that does no harm there. A return may be
lower by 0.02 than the best of the grid's, no regulariser included, and a cost higher by 1 %.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from experiments import keys
from experiments.experiment import Experiment
from experiments.regularized.linear import RegularizedCell, RegularizedLQRSettings
from experiments.regularized.networks import RegularizedSettings
from experiments.tables import mean_and_std
from ipo.lqr_learners import published_lqr
from ipo.stats import paired_difference

NAMES = {
    "weight_decay": "weight decay",
    "dropout": "dropout",
    "variance_penalty": "V-REx",
    "scale_penalty": "IRMv1",
}


@dataclass(frozen=True)
class Trial:
    """Regularisers of one baseline.

    Attributes:
        baseline: the arm without any.
        ipo: the arm that they are compared with, besides.
        grid: the weights of each that are tried.
        loss: of what is measured in the training domains, less is better.
        allowed: more of it does no harm.
        digits: of numbers in tables.
    """

    baseline: str
    ipo: str
    grid: dict[str, tuple[float, ...]]
    loss: Callable[[pd.Series], pd.Series]
    allowed: float
    digits: int

    def label(self, name: str, weight: float) -> str:
        """Of an arm, such as ``ppo_dropout0.1``; of the baseline where the weight is 0."""
        return f"{self.baseline}_{name}{weight:g}" if weight else self.baseline

    @property
    def settings(self) -> dict[str, dict[str, float]]:
        """What each arm changes, by its label."""
        return {
            self.label(name, weight): {name: weight}
            for name, weights in self.grid.items()
            for weight in weights
        }

    def chosen(self, values: pd.DataFrame) -> dict[str, float]:
        """The weight of each regulariser by the rule; 0 where all of them do harm."""
        losses = self.loss(values["training"].groupby("method").mean())
        return {
            name: largest_harmless(
                {weight: losses[self.label(name, weight)] for weight in (0.0, *weights)},
                self.allowed,
            )
            for name, weights in self.grid.items()
        }

    def table(self, values: pd.DataFrame) -> pd.DataFrame:
        """Every weight, and which one the rule chooses: means ± standard deviations over runs."""
        chosen = self.chosen(values)

        def row(name: str, weight: float) -> dict[str, Any]:
            runs = values.loc[self.label(name, weight)]
            return {
                "regulariser": NAMES[name],
                "weight": f"{weight:g}",
                "in training": self.spread(runs["training"]),
                "new domain": self.spread(runs["new"]),
                "difference to none": self.gap(values, name, weight, self.baseline),
                "difference to IPO": self.gap(values, name, weight, self.ipo),
                "chosen": "✓" if weight == chosen[name] else "",
            }

        grid = self.grid.items()
        return pd.DataFrame([row(name, weight) for name, own in grid for weight in own])

    def chosen_table(self, by_place: Mapping[Any, pd.DataFrame], place: str) -> pd.DataFrame:
        """What the rule chooses in each place; values by place, whose column is named."""

        def row(here: Any, name: str, weight: float) -> dict[str, Any]:
            gaps = [self.gap(by_place[here], name, weight, o) for o in (self.baseline, self.ipo)]
            none, ipo = gaps if weight else ("–", "–")
            return {
                place: here,
                "regulariser": NAMES[name],
                "weight": f"{weight:g}" if weight else "none",
                "difference to none": none,
                "difference to IPO": ipo,
            }

        found = {here: self.chosen(values) for here, values in by_place.items()}
        rows = [(here, *one) for here, chosen in found.items() for one in chosen.items()]
        return pd.DataFrame([row(*one) for one in rows])

    def spread(self, runs: pd.Series) -> str:
        """Mean ± standard deviation, or in how many runs a cost is infinite."""
        lost = np.isinf(runs)
        if lost.any():
            return f"infinite in {lost.sum()} of {len(runs)} runs"
        return mean_and_std(runs, self.digits)

    def gap(self, values: pd.DataFrame, name: str, weight: float, other: str) -> str:
        """In the new domain to another arm, paired by run, with its 95 % interval, in words."""
        pair = [values.loc[arm, "new"] for arm in (self.label(name, weight), other)]
        both = pd.concat(pair, axis=1, join="inner")
        if np.isinf(both).any(axis=None):
            return "–"
        mean, low, high, _ = paired_difference(both.iloc[:, 0], both.iloc[:, 1])
        return f"{mean:+.{self.digits}f} [{low:+.{self.digits}f}, {high:+.{self.digits}f}]"


KEYS = Trial(
    "ppo",
    "ipo",
    {
        "weight_decay": (0.1, 1.0),
        "dropout": (0.1, 0.3),
        "variance_penalty": (1.0, 10.0, 100.0),
        "scale_penalty": (1.0, 10.0, 100.0),
    },
    operator.neg,
    allowed=0.02,
    digits=3,
)
LQR = Trial(
    "gradient_descent",
    "ipo_fixed_phi",
    {
        "weight_decay": (0.01, 0.1, 1.0),
        "dropout": (0.1, 0.3),
        "variance_penalty": (0.01, 1.0, 100.0),
        "scale_penalty": (0.0001, 0.01, 1.0),
    },
    np.log,
    allowed=np.log(1.01),
    digits=1,
)
WITNESSED = (
    *("ppo_weight_decay0.1", "ppo_dropout0.1"),
    *("ppo_variance_penalty10", "ppo_scale_penalty10"),
)


@dataclass(frozen=True)
class KeysCell(keys.Cell):
    """PPO with regularisers."""

    settings: RegularizedSettings


def keys_arms(num_updates: int, train_colors: Sequence[str] = keys.TRAINED) -> list[KeysCell]:
    """PPO as published, with each regulariser at each weight."""
    plain = vars(keys.published(KEYS.baseline, num_updates=num_updates))
    return [
        KeysCell(label, RegularizedSettings(**plain, **changes), tuple(train_colors))
        for label, changes in KEYS.settings.items()
    ]


def short(cell: KeysCell) -> KeysCell | None:
    """As of other arms, of one weight of each regulariser: the others are of no other kind."""
    return keys.short(cell) if cell.label in WITNESSED else None


EXPERIMENTS = {"regularized": Experiment(keys.run_rows, KeysCell, short, runs_at_once=25)}


def lqr_cells(num_domains: int, dim_distractor: int, num_iterations: int) -> list[RegularizedCell]:
    """Gradient descent as published, with each regulariser at each weight."""
    plain = vars(replace(published_lqr(LQR.baseline), num_iterations=num_iterations))
    return [
        RegularizedCell(
            label,
            num_domains,
            dim_distractor,
            RegularizedLQRSettings(**(plain | changes)),
        )
        for label, changes in LQR.settings.items()
    ]


def largest_harmless(losses: Mapping[float, float], allowed: float) -> float:
    """The largest weight whose loss in training is at most ``allowed`` above the lowest; or 0.

    ``losses`` are by weight, that of no regulariser at 0 among them.
    """
    lowest = min(losses.values())
    return max((weight for weight, loss in losses.items() if loss <= lowest + allowed))


def keys_values(rows: pd.DataFrame, train_colors: Sequence[str] = keys.TRAINED) -> pd.DataFrame:
    """Exact returns by arm and run: the mean of ``training`` colours, and the ``new`` one's."""
    exact = rows[rows["metric"] == "return_exact"]
    wide = exact.pivot_table("value", ["method", "run"], "domain")
    return pd.DataFrame(
        {"training": wide[list(train_colors)].mean(axis=1), "new": wide[keys.TESTED]}
    )


def lqr_values(rows: pd.DataFrame) -> pd.DataFrame:
    """Costs of one configuration by arm and run, ``training`` and ``new``."""
    wide = rows.pivot_table("value", ["method", "run"], "metric")
    return pd.DataFrame({"training": wide["train_cost"], "new": wide["test_cost"]})
