"""What players of door policies gain when they go on alone: the Nash gap, from below."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from tqdm import tqdm

from experiments import door_training
from experiments.door_training import (
    EVALUATION_SEED,
    NETWORK,
    TRAIN_FRICTIONS,
    copied,
    make_doors,
    policy_path,
)
from experiments.experiment import Experiment
from ipo.checks import check_count
from ipo.distributions import Gaussian
from ipo.networks import Weights, load_policy
from ipo.ppo import Training, improve
from ipo.rollouts import collect
from ipo.worlds.many_doors import VectorDoor


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

    The largest gain of a player is a lower bound on the Nash gap of the run.
    """
    rows = []
    for seed in seeds:
        path = policy_path(policies, cell.trained.label, seed, cell.updates, "last")
        players, _ = load_policy(path, NETWORK, {"seed": seed, "choice": "last"})
        for d, friction in enumerate(TRAIN_FRICTIONS):
            better = gone_on(cell, seed, players, d)
            found = {
                "before": mean_return(players, friction, cell.num_doors),
                "after": mean_return(better, friction, cell.num_doors),
            }
            rows += [
                {
                    **cell.columns,
                    "run": seed,
                    "domain": str(friction),
                    "metric": metric,
                    "value": value,
                }
                for metric, value in found.items()
            ]
    return pd.DataFrame(rows)


def gone_on(cell: Cell, seed: int, players: Sequence[Weights], d: int) -> list[Weights]:
    """The players after player d has learnt for some updates, in its own doors, alone."""
    settings = cell.trained.settings
    training = Training(NETWORK, NETWORK.start, make_doors, len(TRAIN_FRICTIONS), settings, [seed])
    with torch.no_grad():
        for own, saved in zip(training.players, players, strict=True):
            for name, weight in own.items():
                weight.copy_(saved[name])
    observations = training.observations[d]
    for _ in tqdm(range(cell.num_alone), desc=f"player {d}", unit="update", leave=False):
        rollout, observations = collect(
            NETWORK.frozen(training.players),
            NETWORK.distribution,
            training.environments[d],
            observations,
            settings.num_steps,
            training.draws,
            training.normalizers[d],
            settings.discount,
            settings.gae_lambda,
            settings.time_outs,
        )
        improve(
            NETWORK,
            training.players,
            d,
            training.optimizers[d],
            rollout.frames(),
            settings,
            training.orders,
        )
    return copied(training.players)


def mean_return(players: Sequence[Weights], friction: float, num_doors: int) -> float:
    """Of the most likely actions of the players' average, over the doors of the evaluation."""
    doors = VectorDoor([friction] * num_doors)
    policy = NETWORK.frozen(players)
    observations, _ = doors.reset(seed=EVALUATION_SEED)
    while True:
        rows = torch.tensor(observations, dtype=torch.float32).unsqueeze(0)
        actions = Gaussian.mode(policy(rows)[0])[0]
        observations, _, _, truncated, info = doors.step(actions.numpy())
        if truncated.all():
            return float(np.mean(info["episode_return"]))


def short(cell: Cell) -> Cell:
    """One update of every player on short rollouts, ten doors."""
    trained = replace(cell.trained, settings=door_training.shorter(cell.trained.settings))
    return replace(cell, trained=trained, num_alone=1, num_doors=10)


def reads(cell: Cell, seed: int, policies: str | Path) -> list[Path]:
    return [policy_path(policies, cell.trained.label, seed, cell.updates, "last")]


EXPERIMENT = Experiment(gains_alone, Cell, short, (0,), reads, runs_at_once=1)
