"""The how-to's functions on two of gymnasium's environments: for a witness, no chapter shows it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium
import pandas as pd

from experiments.experiment import Experiment
from ipo.own_domains import compare

# What differs between domains: an attribute of the environment, and its values in training.
VARIED = {"CartPole-v1": ("length", (0.4, 0.6)), "Pendulum-v1": ("m", (0.8, 1.2))}


@dataclass(frozen=True)
class Cell:
    """All arms of a comparison, on two variants of an environment.

    Attributes:
        environment: discrete or continuous.
        num_updates, num_steps: of the training.
    """

    environment: str
    num_updates: int = 2
    num_steps: int = 64

    @property
    def columns(self) -> dict[str, Any]:
        return {"environment": self.environment}


def run_cell(cell: Cell, seeds: list[int]) -> pd.DataFrame:
    name, values = VARIED[cell.environment]

    def domain(value: float) -> Callable[[], gymnasium.Env]:
        def make() -> gymnasium.Env:
            env = gymnasium.make(cell.environment)
            setattr(env.unwrapped, name, value)
            return env

        return make

    rows = compare(
        {str(value): domain(value) for value in values},
        {"new": domain(1.0)},
        seeds=list(seeds),
        controls=True,
        num_episodes=3,
        num_updates=cell.num_updates,
        num_steps=cell.num_steps,
    )
    rows.insert(0, "environment", cell.environment)
    return rows


EXPERIMENTS = {"compare": Experiment(run_cell, Cell)}
CELLS = [Cell(environment) for environment in VARIED]
