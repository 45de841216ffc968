"""What players of door policies gain when they go on alone: the Nash gap, from below."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd
from tqdm import tqdm

from experiments.doors import training as door_training
from experiments.doors.training import (
    EVALUATION_SEED,
    NETWORK,
    TRAIN_FRICTIONS,
    last_info,
    policy_path,
)
from experiments.experiment import Experiment, rebuilt
from experiments.policies import load_policy
from experiments.rows import tidy
from ipo.checks import check_count
from ipo.networks import Weights


@dataclass(frozen=True)
class Cell:
    """The last policies of an arm of IPO, whose players go on one at a time.

    Attributes:
        trained: how they were trained; a player goes on in the same way, with a new Adam and a
            new running standard deviation of its rewards.
        updates: after which the policies were saved.
        num_alone: updates of the player who goes on, while the others stand still.
        num_doors: new doors of the player's own friction, for its return before and after.
    """

    trained: door_training.Cell
    updates: int
    num_alone: int = 5
    num_doors: int = 100

    def __post_init__(self) -> None:
        check_count("num_alone", self.num_alone)
        check_count("num_doors", self.num_doors)

    @property
    def columns(self) -> dict[str, Any]:
        return {**self.trained.columns, "updates": self.updates, "num_alone": self.num_alone}


def gains_alone(cell: Cell, seeds: Sequence[int], policies: str | Path) -> pd.DataFrame:
    """Rows with the mean return in every player's domain, ``before`` and ``after`` it went on.

    Actions are the most likely ones, at the doors of the evaluation. The largest gain of a player
    is a lower bound on the Nash gap of the run.
    """
    parts = []
    for seed in seeds:
        players = load_players(policies, cell, seed)
        metrics = {}
        for d, friction in enumerate(TRAIN_FRICTIONS):
            for name, own in (("before", players), ("after", gone_on(cell, seed, players, d))):
                found = last_info(own, friction, cell.num_doors, EVALUATION_SEED)
                metrics[str(friction), name] = [found["episode_return"].mean()]
        parts.append(tidy(cell, [seed], metrics))
    return pd.concat(parts, ignore_index=True)


def load_players(policies: str | Path, cell: Cell, seed: int) -> list[Weights]:
    """The last policy of a run, trained as the cell says; a slice goes on with shorter rollouts.

    Raises:
        ValueError: a file that is no policy for doors, or that was not made for this run.
    """
    (path,) = reads(cell, seed, policies)
    made_for = {"seed": seed, "updates": cell.updates, "choice": "last"}
    players, about = load_policy(path, NETWORK, made_for)
    settings = rebuilt(door_training.Cell, about["settings"]).settings
    if cell.trained.settings not in (settings, door_training.shorter(settings)):
        raise ValueError(f"{path}: was made with {settings}, not with {cell.trained.settings}")
    return players


def gone_on(cell: Cell, seed: int, players: Sequence[Weights], d: int) -> list[Weights]:
    """The players after player d has learnt for some updates, in its own doors, alone."""
    training = door_training.new_training(cell.trained, [seed])
    training.learners.set(players)
    for _ in tqdm(range(cell.num_alone), desc=f"player {d}", unit="update", leave=False):
        training.update(only=d)
    return training.players


def short(cell: Cell) -> Cell:
    """One update of every player on short rollouts, ten doors."""
    trained = replace(cell.trained, settings=door_training.shorter(cell.trained.settings))
    return replace(cell, trained=trained, num_alone=1, num_doors=10)


def reads(cell: Cell, seed: int, policies: str | Path) -> list[Path]:
    return [policy_path(policies, cell.trained.label, seed, cell.updates, "last")]


EXPERIMENT = Experiment(gains_alone, Cell, short, (0,), reads, runs_at_once=1)
