"""From saved policies of the door experiment to tidy rows: which doors each of them opens.

Every policy meets the same doors in the same starts, at every friction, so that comparisons are
paired; the first n of them are the same however many there are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import torch

from experiments.doors import players as door_players
from experiments.doors import training as door_training
from experiments.doors.hooking import Hooking
from experiments.doors.pulling import strategy
from experiments.doors.training import (
    CHOICES,
    EVALUATION_SEED,
    NETWORK,
    TRAIN_FRICTIONS,
    last_info,
    policy_path,
)
from experiments.experiment import Experiment
from ipo.checks import Count, Natural, NonNegative, check_choice, check_count, checked
from ipo.distributions import Gaussian
from ipo.networks import Weights
from ipo.worlds.door import DoorParams
from ipo.worlds.one_door import DoorEnv
from ipo.worlds.seeds import seeds_of

TEST_FRICTIONS = (1.1, 1.2, 1.3, 1.4, 1.5)  # of the paper's Table 4
NUM_DOORS = 200


@checked
@dataclass(frozen=True)
class Cell:
    """Policies of one method after so many updates, on so many doors.

    Attributes:
        trained: how they were trained.
        updates: after which the policies were saved; one of ``trained.saved_after``.
        choice: the ``best`` policy so far, as published, or the ``last``.
        player: the number of the player who acts alone; ``None``: all players' average.
        frictions: the domains in which they are tested.
        num_doors: of each friction.
    """

    trained: door_training.Cell
    updates: Count
    choice: str = "best"
    player: Natural | None = None
    frictions: Annotated[tuple[NonNegative, ...], "frictions"] = TEST_FRICTIONS
    num_doors: Count = NUM_DOORS

    def __post_init__(self) -> None:
        if self.updates not in self.trained.saved_after:
            raise ValueError(
                f"updates = {self.updates!r}: must be one of {self.trained.saved_after}, after "
                "which policies are saved"
            )
        check_choice("choice", self.choice, CHOICES)
        check_tested(self.frictions, self.num_doors)
        if self.player is not None and not 0 <= self.player < self.num_players:
            raise ValueError(
                f"player = {self.player!r}: must be None or less than {self.num_players}"
            )

    @property
    def num_players(self) -> int:
        """How many networks a policy averages."""
        moves = self.trained.settings.moves(len(TRAIN_FRICTIONS))
        return len({move.player for move in moves})

    @property
    def columns(self) -> dict[str, Any]:
        settings = self.trained.settings
        alone = "" if self.player is None else f"_player_{self.player}"
        return {
            "method": self.trained.label + alone,
            "train_frictions": self.trained.columns["train_frictions"],
            "steps": self.updates * settings.num_steps * sum(settings.num_envs),
            "choice": self.choice,
        }


def check_tested(frictions: Sequence[float], num_doors: int) -> None:
    check_count("num_doors", num_doors)
    for friction in frictions:
        DoorParams(friction=friction)


def evaluate(cell: Cell, seeds: Sequence[int], policies: str | Path) -> pd.DataFrame:
    """Rows with the cell's columns, ``run``, ``domain``, ``door``, ``metric`` and ``value``.

    The metric is ``success``, 1 or 0; actions are the policy's most likely ones.

    Raises:
        ValueError: a file that is no policy for doors, or that was not made for this run.
    """
    parts = []
    for seed in seeds:
        players = load_players(cell, seed, policies)
        for friction in cell.frictions:
            found = last_info(
                players, friction, cell.num_doors, EVALUATION_SEED, cell.trained.network
            )
            parts.append(
                pd.DataFrame(
                    {
                        **cell.columns,
                        "run": seed,
                        "domain": str(friction),
                        "door": range(cell.num_doors),
                        "metric": "success",
                        "value": found["opened"].astype(float),
                    }
                )
            )
    return pd.concat(parts, ignore_index=True)


def load_players(cell: Cell, seed: int, policies: str | Path) -> list[Weights]:
    """The players of a run who act."""
    players = door_training.load_players(policies, cell.trained, seed, cell.updates, cell.choice)
    return players if cell.player is None else [players[cell.player]]


def door_seeds(num_doors: int = NUM_DOORS) -> list[int]:
    """Seeds with which ``DoorEnv`` makes the doors of the evaluation, one by one."""
    return seeds_of(np.random.SeedSequence(EVALUATION_SEED), num_doors)


def evaluation_doors(num_doors: int = NUM_DOORS) -> pd.DataFrame:
    """What the doors of the evaluation are like: a row for each, without its friction.

    The columns are those of ``DoorParams``, ``lever_arm``, the handle's shift, and ``lever``: from
    the hinge to the shifted handle.
    """
    rows = []
    for seed in door_seeds(num_doors):
        env = DoorEnv(0.0)
        env.reset(seed=seed)
        y, z = env.handle_shift
        lever_arm = env.params.lever_arm
        levers = {"lever_arm": lever_arm, "lever": lever_arm - y}
        rows.append(asdict(env.params) | levers | {"shift_y": y, "shift_z": z})
    return pd.DataFrame(rows).drop(columns="friction").rename_axis("door").reset_index()


@dataclass(frozen=True)
class ScriptedCell:
    """The controller by hand, ``Hooking``, which knows the door it is at."""

    frictions: tuple[float, ...] = TEST_FRICTIONS
    num_doors: int = NUM_DOORS

    def __post_init__(self) -> None:
        check_tested(self.frictions, self.num_doors)

    @property
    def columns(self) -> dict[str, Any]:
        return {"method": "hooking", "train_frictions": "none", "steps": 0, "choice": "last"}


def watch(
    cell: Cell | ScriptedCell, seeds: Sequence[int], policies: str | Path | None = None
) -> pd.DataFrame:
    """How doors are opened: rows like those of :func:`evaluate`, one door after the other.

    Metrics: ``success``; and for doors that were opened ``inside_part``, the part of the pulling
    impulse that the inside of the hook had (:func:`experiments.doors.pulling.strategy`), and
    ``opened_at``, the number of steps that it took.
    """
    rows = []
    for seed in seeds:
        players = load_players(cell, seed, policies) if isinstance(cell, Cell) else None
        for friction in cell.frictions:
            env = DoorEnv(friction)
            for door, door_seed in enumerate(door_seeds(cell.num_doors)):
                observation, _ = env.reset(seed=door_seed)
                act = most_likely(players) if players else scripted(env)
                name, part = strategy(env, act, observation)
                found = {"success": float(name != "failed")}
                if found["success"]:
                    found |= {"inside_part": part, "opened_at": env.step_count}
                rows += [
                    {
                        **cell.columns,
                        "run": seed,
                        "domain": str(friction),
                        "door": door,
                        "metric": metric,
                        "value": float(value),
                    }
                    for metric, value in found.items()
                ]
    return pd.DataFrame(rows)


def most_likely(players: Sequence[Weights]) -> Callable[[np.ndarray], np.ndarray]:
    """The players' average as a function from an observation ``[15]`` to an action ``[6]``."""
    policy = NETWORK.frozen(players)

    def act(observation: np.ndarray) -> np.ndarray:
        row = torch.tensor(observation, dtype=torch.float32)[None, None]
        return Gaussian.mode(policy(row)[0])[0, 0].numpy()

    return act


def scripted(env: DoorEnv) -> Callable[[np.ndarray], np.ndarray]:
    """The controller by hand for the episode that has just begun."""
    hooking = Hooking()
    hooking.begin(env.params, env.handle_shift)
    return lambda _: hooking(env.data.qpos, env.data.qvel)


def short(cell: Cell | ScriptedCell) -> Cell | ScriptedCell:
    """Ten doors at two frictions."""
    return replace(cell, frictions=(0.1, 1.3), num_doors=10)


def reads(cell: Cell, seed: int, policies: str | Path) -> list[Path]:
    return [policy_path(policies, cell.trained.label, seed, cell.updates, cell.choice)]


EXPERIMENTS = {
    "curves": door_training.EXPERIMENT,
    "strategies": Experiment(watch, Cell, short, (0,), reads, runs_at_once=1),
    "scripted": Experiment(watch, ScriptedCell, short, (0,), runs_at_once=1),
    "gaps": door_players.EXPERIMENT,
} | {
    name: Experiment(evaluate, Cell, short, (0,), reads, runs_at_once=1)
    for name in ("success", "controls", "last", "alone")
}
