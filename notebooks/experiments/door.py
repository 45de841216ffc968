"""From saved policies of the door experiment to tidy rows: which doors each of them opens.

Every policy meets the same doors in the same starts, at every friction, so that comparisons are
paired; the first n of them are the same however many there are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ipo import door_training
from ipo.checks import check_choice, check_count
from ipo.door import DoorEnv, DoorParams
from ipo.door_training import CHOICES, NETWORK, TRAIN_FRICTIONS, opened, policy_path
from ipo.networks import Weights, load_policy

MODULES = ("door_experiments",)
TEST_FRICTIONS = (1.1, 1.2, 1.3, 1.4, 1.5)  # of the paper's Table 4
MORE_FRICTIONS = (0.0, 0.1, 0.5, 2.0, 3.0)
NUM_DOORS = 200
EVALUATION_SEED = 20210607


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
    updates: int
    choice: str = "best"
    player: int | None = None
    frictions: tuple[float, ...] = TEST_FRICTIONS
    num_doors: int = NUM_DOORS

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
        return len(self.trained.settings.domains_of_players(len(TRAIN_FRICTIONS)))

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
            found = opened(players, friction, cell.num_doors, EVALUATION_SEED)
            parts.append(
                pd.DataFrame(
                    {
                        **cell.columns,
                        "run": seed,
                        "domain": str(friction),
                        "door": range(cell.num_doors),
                        "metric": "success",
                        "value": found.astype(float),
                    }
                )
            )
    return pd.concat(parts, ignore_index=True)


def load_players(cell: Cell, seed: int, policies: str | Path) -> list[Weights]:
    """The players of a run who act."""
    path = policy_path(policies, cell.trained.label, seed, cell.updates, cell.choice)
    players, _ = load_policy(path, NETWORK, {"seed": seed, "choice": cell.choice})
    return players if cell.player is None else [players[cell.player]]


def door_seeds(num_doors: int = NUM_DOORS) -> list[int]:
    """Seeds with which :class:`ipo.door.DoorEnv` makes the doors of the evaluation, one by one."""
    streams = np.random.SeedSequence(EVALUATION_SEED).spawn(num_doors)
    return [int(stream.generate_state(1)[0]) for stream in streams]


def evaluation_doors(num_doors: int = NUM_DOORS) -> pd.DataFrame:
    """What the doors of the evaluation are like: a row for each, without its friction.

    The columns are those of :class:`ipo.door.DoorParams`, ``lever_arm``, and the handle's shift.
    """
    rows = []
    for seed in door_seeds(num_doors):
        env = DoorEnv(0.0)
        env.reset(seed=seed)
        y, z = env.handle_shift
        lever_arm = env.params.lever_arm
        rows.append(asdict(env.params) | {"lever_arm": lever_arm, "shift_y": y, "shift_z": z})
    return pd.DataFrame(rows).drop(columns="friction").rename_axis("door").reset_index()
