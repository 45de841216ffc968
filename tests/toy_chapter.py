"""A toy chapter, whose second experiment reads what the first one saves."""

from pathlib import Path

import pandas as pd
import toy_experiment
from toy_experiment import Cell

from experiments.experiment import Experiment
from experiments.sealed import read_sealed, write_sealed


def train(cell: Cell, seeds: list[int], policies: Path) -> pd.DataFrame:
    """The toy, and a policy that adds nothing."""
    write_sealed(policy(cell, 0, policies)[0], b"0.0")
    return toy_experiment.run(cell, seeds)


def policy(cell: Cell, seed: int, policies: Path) -> list[Path]:
    return [policies / f"{cell.method}_{cell.size}"]


def play(cell: Cell, seeds: list[int], policies: Path) -> pd.DataFrame:
    rows = toy_experiment.run(cell, seeds)
    return rows.assign(value=rows["value"] + float(read_sealed(policy(cell, 0, policies)[0])))


EXPERIMENTS = {
    "played": Experiment(play, Cell, reads=policy, runs_at_once=1),
    "trained": Experiment(train, Cell, runs_at_once=1),
}
