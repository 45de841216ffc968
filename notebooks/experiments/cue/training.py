"""The arms of the cued maze, and their rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
import pandas as pd
import torch

from experiments.cue.theory import PENALTIES, Cues, text
from experiments.experiment import Experiment
from experiments.regularized.networks import RegularizedSettings, training_of
from experiments.rows import tidy
from ipo.checks import checked, one_of
from ipo.networks import Weights
from ipo.ppo import Training
from ipo.worlds.cued_maze import Cue, cued_maze
from ipo.worlds.networks import DenseOnTable
from ipo.worlds.tabular import TabularDomains, expected_return

ENCODINGS = ("signs", "one_hot")
EXTREMES = (-1.0, 1.0)  # cues between which every return is linear
METHODS = ("ppo", "in_turn", "ensemble", "ipo")


@checked
@dataclass(frozen=True)
class Cell:
    """One method at one point of a phase diagram.

    Attributes:
        settings: how it is trained.
        cues: of the training domains.
        encoding: what the network sees: landmark, cue and whether it is at the junction as numbers
            (``signs``), or which of the eight observations it is (``one_hot``).
    """

    settings: RegularizedSettings
    cues: Annotated[tuple[Cue, ...], "domains"]
    encoding: Annotated[str, one_of(ENCODINGS)] = "signs"

    @property
    def columns(self) -> dict[str, Any]:
        penalty = self.settings.variance_penalty
        method = f"vrex_{penalty:g}" if penalty else self.settings.method
        return {"method": method, "cues": text(self.cues), "encoding": self.encoding}


class Varied(Cell):
    """A cell by its gradient steps on each rollout, and by how many frames that has."""

    @property
    def columns(self) -> dict[str, Any]:
        of = self.settings
        more = {"steps": of.num_epochs, "frames": of.num_steps * of.num_envs}
        return super().columns | more


def one_step(method: str, num_updates: int) -> RegularizedSettings:
    """A player makes one gradient step on each rollout, as the theory has it."""
    return RegularizedSettings(
        method,
        learning_rate=2e-2,
        num_updates=num_updates,
        num_envs=144,  # a multiple of 2^2, 3^2 and 4^2, for the players of an ensemble
        num_steps=4,
        num_epochs=1,
        num_minibatches=1,
        discount=0.9,  # it pays to hurry: with 0.99, some runs learn to choose and not to walk
    )


def many_steps(method: str, num_updates: int) -> RegularizedSettings:
    """A player learns from each rollout in four epochs of four minibatches, as PPO usually does."""
    return RegularizedSettings(
        method,
        learning_rate=1e-2,
        num_updates=num_updates,
        num_envs=144,
        num_steps=8,
        num_minibatches=4,
    )


def phase_cells(points: Sequence[Cues], num_updates: int) -> list[Cell]:
    """Every arm at some points."""
    ppo = one_step("ppo", num_updates)
    return [
        cell
        for cues in points
        for cell in (
            *(Cell(one_step(method, num_updates), cues) for method in METHODS),
            *(Cell(replace(ppo, variance_penalty=float(p)), cues) for p in PENALTIES),
        )
    ]


def encoding_cells(points: Sequence[Cues], num_updates: int) -> list[Cell]:
    """PPO and IPO where observations have no signs in common."""
    return [
        Cell(one_step(method, num_updates), cues, "one_hot")
        for cues in points
        for method in ("ppo", "ipo")
    ]


def many_step_cells(points: Sequence[Cues], num_updates: int) -> list[Cell]:
    """PPO and IPO with many steps on each rollout."""
    return [
        Cell(many_steps(method, num_updates), cues) for cues in points for method in ("ppo", "ipo")
    ]


def varied_cells(cues: Cues, num_updates: int) -> list[Varied]:
    """PPO and IPO at one point: more steps before the others answer, or more data for each.

    All make as many gradient steps in all.
    """
    return [
        Varied(replace(one_step(method, max(1, num_updates // steps)), **changes), cues)
        for steps, changes in (
            *((steps, {"num_epochs": steps}) for steps in (1, 2, 4, 8, 16)),
            (1, {"num_envs": 4 * 144}),
        )
        for method in ("ppo", "ipo")
    ]


def training(cell: Cell, seeds: list[int]) -> Training:
    """Runs of a cell that have not begun."""
    domains = TabularDomains([cued_maze(cue) for cue in cell.cues])
    return training_of(network(cell.encoding), domains, len(cell.cues), cell.settings, seeds)


def network(encoding: str) -> DenseOnTable:
    """A player's, with 16 tanh units. All domains have the same eight observations."""
    images = torch.tensor(TabularDomains([cued_maze(0.0)]).images).float()
    table = images if encoding == "signs" else torch.eye(len(images))
    return DenseOnTable(table, num_actions=3, hidden=(16,))


def run_cell(cell: Cell, seeds: list[int]) -> pd.DataFrame:
    """Train, and give the exact returns where the cue is always wrong and where it is right."""
    *_, (_, players) = training(cell, seeds).reports()
    return tidy(cell, seeds, exact(network(cell.encoding), players))


def exact(network: DenseOnTable, players: Sequence[Weights]) -> dict[tuple[str, str], np.ndarray]:
    """Exact returns ``[R]`` of the average policy at both extremes of the cue."""
    doubled = [{name: w.double() for name, w in player.items()} for player in players]
    policy = network.average(doubled)[0].softmax(-1).numpy()
    (seen,) = TabularDomains([cued_maze(0.0)]).observation_of
    return {
        (f"{cue:g}", "return_exact"): expected_return(cued_maze(cue), policy[:, seen])[0]
        for cue in EXTREMES
    }


def short(cell: Cell) -> Cell | None:
    """Two updates, where the last domain's cue is strong and opposite: others are no other kind."""
    first, last = cell.cues[0], cell.cues[-1]
    if last not in (-0.3, -0.9) or (len(cell.cues) > 2 and first != 0.6):
        return None
    return replace(cell, settings=replace(cell.settings, num_updates=2))


def short_varied(cell: Varied) -> Varied | None:
    """One update, on rollouts that are not large."""
    if cell.columns["frames"] > one_step("ppo", 1).num_envs * 4:
        return None
    return replace(cell, settings=replace(cell.settings, num_updates=1))


PHASES = {2: "two_domains", 3: "three_domains", 4: "four_domains"}  # by numbers of domains
EXPERIMENTS = {
    name: Experiment(run_cell, Cell, short)
    for name in (*PHASES.values(), "encodings", "many_steps")
} | {"varied": Experiment(run_cell, Varied, short_varied)}
