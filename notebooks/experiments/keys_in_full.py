"""Algorithm 1 with all its parts on the coloured keys: K inner rounds, and a variable Phi.

Phi is the network's convolutions, which the players share. It moves first in a round, on rollouts
in all domains with as many frames as those of all players together. So a round has 1 + K times the
frames of IPO as published. The arm called short has half the rounds, and as many frames as IPO in
all; a variable Phi with all rounds has as many as two inner rounds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import pandas as pd

from experiments.keys import TESTED, TRAINED, Cell, arm, main_arms
from experiments.keys_tables import gap, runs_of
from experiments.tables import mean_and_std

NAMES = {
    "ipo": "IPO, as published",
    "ipo_phi_short": "variable Φ, half the rounds",
    "ipo_inner2": "K = 2",
    "ipo_phi": "variable Φ",
    "ipo_phi_inner2": "variable Φ, K = 2",
    "ensemble_inner2": "ensemble, K = 2",
    "ensemble_phi": "ensemble, variable Φ",
}
ASKED_AGAIN = ("ipo_phi", "ipo_inner2")  # as many frames; in more runs, after a first look


def full_arms(num_updates: int, train_colors: Sequence[str] = TRAINED) -> list[Cell]:
    """All of them but IPO as published; the ensemble, which is IPO without its domains, as well."""
    of = partial(arm, method="ipo", train_colors=tuple(train_colors))
    without = partial(of, method="ensemble", learning_rate=5e-4, num_updates=num_updates)
    return [
        of("ipo_phi_short", num_updates=math.ceil(num_updates / 2), variable_phi=True),
        of("ipo_inner2", num_updates=num_updates, num_inner_rounds=2),
        of("ipo_phi", num_updates=num_updates, variable_phi=True),
        of("ipo_phi_inner2", num_updates=num_updates, variable_phi=True, num_inner_rounds=2),
        without("ensemble_inner2", num_inner_rounds=2),
        without("ensemble_phi", variable_phi=True),
    ]


def num_frames(cell: Cell) -> int:
    """Of a run."""
    settings = cell.settings
    collected = settings.num_inner_rounds + settings.variable_phi
    return settings.num_updates * collected * settings.num_envs * settings.num_steps


def difference(rows: pd.DataFrame, label: str, other: str = "ipo") -> str:
    """The difference on grey to another arm, IPO as published, in the runs that both have."""
    runs, others = (set(rows.loc[rows["method"] == arm, "run"]) for arm in (label, other))
    return gap(rows[rows["run"].isin(runs & others)], label, other)


def at_equal_frames(rows: pd.DataFrame, runs: Sequence[int]) -> str:
    """A variable Phi beside K = 2 in some runs; nothing to say of fewer than two."""
    return difference(rows[rows["run"].isin(runs)], *ASKED_AGAIN) if len(runs) > 1 else "–"


def full_table(rows: pd.DataFrame, num_updates: int, train_colors: Sequence[str]) -> pd.DataFrame:
    """Exact returns, mean ± standard deviation, and on grey the difference to IPO as published."""

    def row(cell: Cell) -> dict[str, Any]:
        trained = pd.concat([runs_of(rows, cell.label, color) for color in train_colors], axis=1)
        return {
            "arm": NAMES[cell.label],
            "runs": len(trained),
            "rounds": cell.settings.num_updates,
            "frames": num_frames(cell),
            "training colours": mean_and_std(trained.mean(axis=1), 3),
            TESTED: mean_and_std(runs_of(rows, cell.label, TESTED), 3),
            "difference on grey": "" if cell.label == "ipo" else difference(rows, cell.label),
        }

    ipo = next(cell for cell in main_arms(num_updates, train_colors) if cell.label == "ipo")
    return pd.DataFrame(map(row, [ipo, *full_arms(num_updates, train_colors)]))
