"""From a configuration of the coloured-keys experiment to tidy rows, and to saved policies."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from minigrid.core.constants import OBJECT_TO_IDX

from experiments.experiment import Experiment
from experiments.rows import tidy
from experiments.tabulated import load_or_tabulate
from ipo.checks import check_choice
from ipo.distributions import Categorical
from ipo.networks import GridNetwork, OnTable, Weights, save_policy
from ipo.ppo import Settings, train
from ipo.worlds.colored_keys import COLORS, ColoredKeysEnv
from ipo.worlds.tabular import (
    TabularDomains,
    TabularTask,
    expected_return,
    optimal_policy,
    reach,
    tabulate,
)

ENCODINGS = ("integer", "one_hot", "none")
COLOR_CHANNEL = 1
NUM_COPIES, NUM_EPISODES = 50, 100  # of the published evaluation
NUM_SAVED = 10  # runs of a cell whose weights are kept


@dataclass(frozen=True)
class Cell:
    """One configuration of the experiment.

    Attributes:
        label: the method's name in the rows, such as ``ppo`` or ``ipo_lr1e-3``.
        settings: how it is trained.
        train_colors: the training domains.
        color_encoding: what the network sees of a colour: MiniGrid's ``integer``, a ``one_hot``
            code, or ``none``.
        size: of the grid.
    """

    label: str
    settings: Settings
    train_colors: tuple[str, ...] = ("red", "green")
    color_encoding: str = "integer"
    size: int = 5

    def __post_init__(self) -> None:
        check_choice("color_encoding", self.color_encoding, ENCODINGS)
        for color in self.train_colors:
            check_choice("train_colors", color, COLORS)
        if not self.train_colors:
            raise ValueError("train_colors = (): must name at least one colour")
        if len(set(self.train_colors)) < len(self.train_colors):
            raise ValueError(f"train_colors = {self.train_colors}: must not name a colour twice")

    @property
    def name(self) -> str:
        """Names the files of a cell's policies."""
        return "_".join(map(str, self.columns.values()))

    @property
    def columns(self) -> dict[str, Any]:
        return {
            "method": self.label,
            "train_colors": "+".join(self.train_colors),
            "color_encoding": self.color_encoding,
            "size": self.size,
        }


def run_cell(
    cell: Cell, seeds: list[int], tables: str | Path, policies: str | Path | None = None
) -> pd.DataFrame:
    """Train all runs of a cell and evaluate them in every colour.

    ``tables`` is the folder of tabulated tasks. The weights of the first ten runs are saved in
    ``policies``.
    """
    task = Keys(tables, cell.color_encoding, cell.size)
    *_, (_, players) = task.train(cell, seeds)
    if policies is not None and seeds[0] == 0:
        first = [{name: w[:NUM_SAVED] for name, w in player.items()} for player in players]
        about = {"cell": cell.name, "seeds": seeds[:NUM_SAVED]}
        save_policy(Path(policies) / f"{cell.name}.safetensors", first, about)
    return tidy(cell, seeds, evaluate(task, players, seeds))


def run_curve(cell: Cell, seeds: list[int], tables: str | Path) -> pd.DataFrame:
    """Exact returns in every colour after each update: rows with a column ``frames``."""
    task = Keys(tables, cell.color_encoding, cell.size)
    parts = []
    for frames, players in task.train(cell, seeds):
        parts.append(tidy(cell, seeds, exact(task, players), frames=frames))
    return pd.concat(parts, ignore_index=True)


class Keys:
    """The tabulated task in all colours, for one encoding of colours and one size."""

    def __init__(self, tables: str | Path, color_encoding: str = "integer", size: int = 5) -> None:
        self.color_encoding = color_encoding
        self.tasks = {
            color: load_or_tabulate(ColoredKeysEnv, tables, size=size, color=color)
            for color in COLORS
        }
        self.network = GridNetwork(encode(self.tasks["red"].images, color_encoding).shape[-1])

    def train(self, cell: Cell, seeds: list[int]) -> Iterator[tuple[int, list[Weights]]]:
        """:func:`ipo.ppo.train` in the cell's training colours."""
        domains = TabularDomains([self.tasks[color] for color in cell.train_colors])
        network = OnTable(self.network, encode(domains.images, self.color_encoding))
        num_domains = len(cell.train_colors)
        return train(network, self.network.start, domains, num_domains, cell.settings, seeds)

    def logits(self, players: Sequence[Weights], images: np.ndarray) -> torch.Tensor:
        """Of the average policy ``[R, K, A]`` for MiniGrid's ``images [K, 7, 7, 3]``.

        In double precision, so that a saved policy has the same return on every machine.
        """
        images = encode(images, self.color_encoding)
        doubled = [{name: w.double() for name, w in player.items()} for player in players]
        return OnTable(self.network, images.double()).average(doubled)[0]


def exact(task: Keys, players: Sequence[Weights]) -> dict[tuple[str, str], np.ndarray]:
    """Metrics ``[R]`` without sampling error, keyed by colour and metric.

    Besides return and success: those of the most likely actions (``greedy``), the probability
    of ever holding the key and of ever unlocking the door, and the policy's entropy in nats,
    averaged over the observations of the colour.
    """
    metrics = {}
    for color, table in task.tasks.items():
        logits = task.logits(players, table.images)
        policy = logits.softmax(-1).numpy()
        greedy = np.eye(policy.shape[-1])[policy.argmax(-1)]
        metrics[color, "return_exact"], metrics[color, "success"] = expected_return(table, policy)
        metrics[color, "return_greedy"], _ = expected_return(table, greedy)
        metrics[color, "reaches_key"] = reach(table, policy, table.progress >= 1)
        metrics[color, "unlocks_door"] = reach(table, policy, table.progress >= 2)
        metrics[color, "entropy"] = Categorical.entropy(logits).mean(1).numpy()
    return metrics


def evaluate(
    task: Keys, players: Sequence[Weights], seeds: list[int]
) -> dict[tuple[str, str], np.ndarray]:
    """:func:`exact`, and the published protocol beside it."""
    metrics = exact(task, players)
    for color, table in task.tasks.items():
        logits = task.logits(players, table.images)
        generators = [np.random.default_rng([seed, COLORS.index(color)]) for seed in seeds]
        metrics[color, "return_published_protocol"] = published_protocol(table, logits, generators)
    return metrics


def published_protocol(
    table: TabularTask, logits: torch.Tensor, generators: Sequence[np.random.Generator]
) -> np.ndarray:
    """Mean return ``[R]`` as the published runs measure it.

    Fifty copies act until at least a hundred episodes are over; the mean is over those. Short
    episodes end first, so they count too often, and the number is too high.
    """
    domain = TabularDomains([table])
    # The distinct images of a single domain are the domain's own, in another order.
    logits = logits[:, np.argsort(domain.observation_of[0])]
    copies = domain([0], NUM_COPIES, generators)
    observation = copies.reset()
    episodes = np.zeros(len(generators))
    total = np.zeros(len(generators))
    while (running := episodes < NUM_EPISODES).any():
        rows = observation.unsqueeze(-1).expand(-1, -1, logits.shape[-1])
        step = copies.step(Categorical.sample(logits.gather(1, rows), generators))
        ended = (step.terminated | step.truncated).sum(1).numpy()
        episodes += running * ended
        total += running * step.reward.sum(1).numpy()
        observation = step.observation
    return total / episodes


def encode(images: np.ndarray, color_encoding: str) -> torch.Tensor:
    """MiniGrid's images ``[K, 7, 7, 3]`` as the network's input ``[K, 7, 7, C]``."""
    check_choice("color_encoding", color_encoding, ENCODINGS)
    images = torch.tensor(images)
    if color_encoding == "integer":
        return images.float()
    others = images[..., [c for c in range(images.shape[-1]) if c != COLOR_CHANNEL]].float()
    if color_encoding == "none":
        return others
    codes = torch.nn.functional.one_hot(images[..., COLOR_CHANNEL].long(), len(COLORS))
    return torch.cat([others, codes.float()], dim=-1)


def recolor(images: np.ndarray, codes: dict[str, int]) -> np.ndarray:
    """Images with another colour code for some kinds of object, such as ``{"key": 7}``."""
    images = images.copy()
    for kind, code in codes.items():
        images[images[..., 0] == OBJECT_TO_IDX[kind], COLOR_CHANNEL] = code
    return images


@dataclass(frozen=True)
class Grid:
    """A grid whose table is made and measured."""

    size: int

    @property
    def columns(self) -> dict[str, Any]:
        return {"size": self.size}


def run_grid(grid: Grid, seeds: list[int]) -> pd.DataFrame:
    """How large the table of a grid is; nothing about it is random."""
    task = tabulate(ColoredKeysEnv(size=grid.size), max_states=1_000_000)
    counts = {
        "layouts": (task.start > 0).sum(),
        "states": len(task.start),
        "distinct observations": len(task.images),
        "optimal return": optimal_policy(task)[1],
    }
    return tidy(grid, seeds, {("grey", name): [count] for name, count in counts.items()})


def short(cell: Cell) -> Cell | None:
    """Two updates. Larger grids take minutes to tabulate; other colours are of no other kind."""
    if cell.size != 5 or "yellow" in cell.train_colors:
        return None
    if cell.settings.method == "ensemble" and cell.color_encoding != "integer":
        return None
    return replace(cell, settings=replace(cell.settings, num_updates=2))


EXPERIMENTS = {
    name: Experiment(run_cell, Cell, short, runs_at_once=25)
    for name in ("main", "variants", "larger")
} | {
    "curves": Experiment(run_curve, Cell, short, runs_at_once=25),
    "grids": Experiment(run_grid, Grid, lambda grid: grid if grid.size == 5 else None, (0,)),
}
