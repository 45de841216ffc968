"""From a family of scalar control problems to tidy rows, one per problem and metric."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from experiments import players
from experiments.experiment import Experiment
from experiments.rows import tidy
from ipo.causality.scalar_control import costs
from ipo.causality.small_games import GameSettings, last, residual
from ipo.checks import check_choice
from ipo.game import average

FAMILIES = ("given", "grid", "random")
GRID = np.linspace(-1, 1, 21)
START = (0.3, 0.0)


@dataclass(frozen=True)
class Cell:
    """Scalar control problems that are trained in one way.

    Attributes:
        label: the method's name in the rows, such as ``pooled`` or ``ipo_bound2``.
        settings: how it is trained.
        betas: of the training domains. ``None`` is filled in run by run.
        family: ``given``: all betas are; ``grid``: the first two run over :data:`GRID`, run i at
            row ``i // 21`` and column ``i % 21``; ``random``: those of run i are uniform on
            [-1, 1], from a stream of i.
        start: of all players.
    """

    label: str
    settings: GameSettings
    betas: tuple[float | None, ...]
    family: str = "given"
    start: tuple[float, float] = START

    def __post_init__(self) -> None:
        check_choice("family", self.family, FAMILIES)

    @property
    def columns(self) -> dict[str, Any]:
        betas = " ".join("*" if beta is None else f"{beta:g}" for beta in self.betas)
        start = " ".join(f"{weight:g}" for weight in self.start)
        return {"method": self.label, "family": self.family, "betas": betas, "start": start}


def standard(num_domains: int) -> dict[str, GameSettings]:
    """The ways of training that the chapter compares, by their label in the rows.

    With plain steps, IPO's average moves by learning_rate / E times the mean gradient in a
    round; its players have E times the learning rate, so that it is comparable with pooling.
    The bound on the gradients' norm acts only next to instability.
    """
    plain = {"learning_rate": 0.2 * num_domains, "num_rounds": 2000, "max_gradient_norm": 1.0}
    adam = {"optimizer": "adam", "learning_rate": 2e-3, "num_rounds": 4000}
    bounded = {
        f"ipo_bound{bound:g}": GameSettings("ipo", bound=bound, **plain) for bound in (0.5, 1, 2, 5)
    }
    return bounded | {
        "pooled": GameSettings("pooled", **(plain | {"learning_rate": 0.05})),
        "pooled_adam": GameSettings("pooled", **adam),
        "ipo_plain": GameSettings(
            "ipo", **(plain | {"learning_rate": 0.002 * num_domains, "num_rounds": 10_000})
        ),
        "ipo_plain_large": GameSettings("ipo", **(plain | {"learning_rate": 0.05 * num_domains})),
        "ipo_plain_together": GameSettings(
            "ipo", order="together", **(plain | {"learning_rate": 0.05 * num_domains})
        ),
        "ipo_adam": GameSettings("ipo", **adam),
        "ipo_adam_together": GameSettings("ipo", order="together", **adam),
        "ipo_adam_large": GameSettings("ipo", **(adam | {"learning_rate": 2e-2})),
        "ensemble_adam": GameSettings("ensemble", **adam),
        "separate_adam": GameSettings("separate", **adam),
    }


def problems(cell: Cell, runs: Sequence[int]) -> Tensor:
    """The betas ``[R, E]`` of a cell's runs."""
    rows = []
    for run in runs:
        free = {
            "given": lambda run: iter(()),
            "grid": lambda run: iter((GRID[run // len(GRID)], GRID[run % len(GRID)])),
            "random": lambda run: iter(np.random.default_rng(run).uniform(-1, 1, len(cell.betas))),
        }[cell.family](run)
        rows.append([next(free) if beta is None else beta for beta in cell.betas])
    return torch.tensor(rows, dtype=torch.float64)


def run_cell(cell: Cell, seeds: list[int]) -> pd.DataFrame:
    """The average's gains, the players' largest weight, and how far from an equilibrium it is."""
    training = costs(problems(cell, seeds))
    start = torch.tensor([cell.start] * len(seeds), dtype=torch.float64)
    players = last(training, start, cell.settings)
    gains = average(players)
    metrics = {
        ("all", "k_1"): gains[:, 0],
        ("all", "k_2"): gains[:, 1],
        ("all", "largest_weight"): players.abs().flatten(1).amax(1),
        ("train", "residual"): residual(training, players, cell.settings.bound),
    }
    return tidy(cell, seeds, metrics)


def gains_of(rows: pd.DataFrame) -> Tensor:
    """The gains ``[R, 2]`` in the rows of one cell, in the order of their runs."""
    wide = rows.pivot(index="run", columns="metric", values="value").sort_index()
    return torch.tensor(wide[["k_1", "k_2"]].to_numpy())


def short(cell: Cell) -> Cell:
    """Thirty rounds."""
    return replace(cell, settings=replace(cell.settings, num_rounds=30))


EXPERIMENTS = {
    "table": Experiment(run_cell, Cell, short, (0,)),
    "starts": Experiment(run_cell, Cell, short, (0,)),
    "players": players.EXPERIMENT,
} | {
    name: Experiment(run_cell, Cell, short, (0, 1, 200)) for name in ("grid", "random", "ablation")
}
