"""The coloured-keys experiment: arms, their rows, and saved policies."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import torch
from minigrid.core.constants import OBJECT_TO_IDX

from experiments.experiment import Experiment
from experiments.files import check_file_name
from experiments.policies import check_place, load_policy, save_policy
from experiments.regularized.networks import training_of
from experiments.rows import tidy
from experiments.tabulated import load_or_tabulate
from experiments.visits import reach
from ipo.checks import Count, Positive, check_choice, check_choices, checked, one_of
from ipo.distributions import Categorical
from ipo.networks import Weights
from ipo.ppo import MakeEnvironments, PPOSettings
from ipo.worlds.colored_keys import COLORS, ColoredKeysEnv
from ipo.worlds.minigrid_tables import tabulate
from ipo.worlds.networks import GridNetwork, OnTable
from ipo.worlds.tabular import (
    TabularDomains,
    TabularEnvironments,
    TabularTask,
    expected_return,
    optimal_policy,
)

TRAINED, TESTED = ("red", "green"), "grey"
INSIDE = ("red", "yellow")  # codes with all others but grey between them
ENCODINGS = ("integer", "one_hot", "none")
COLOR_CHANNEL = 1
NUM_COPIES, NUM_EPISODES = 50, 100  # of the published evaluation
NUM_SAVED = 10  # runs of a cell whose weights are kept


def published(method: str, **changes: Any) -> PPOSettings:
    """The settings of the paper's runs on the coloured keys, with ``changes``."""
    paper = {
        "learning_rate": 5e-4 if method == "ipo" else 1e-3,
        "time_outs": "terminal",
        "skip_last_frames": True,
    }
    return PPOSettings(method, **(paper | changes))


@checked
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
        width: of the networks, relative to the published ones.
    """

    label: str
    settings: PPOSettings
    train_colors: tuple[str, ...] = TRAINED
    color_encoding: Annotated[str, one_of(ENCODINGS)] = "integer"
    size: Count = 5
    width: Positive = 1.0

    def __post_init__(self) -> None:
        check_file_name("label", self.label)  # of policies
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


def arm(
    label: str,
    method: str,
    train_colors: tuple[str, ...] = TRAINED,
    color_encoding: str = "integer",
    size: int = 5,
    width: float = 1.0,
    **changes: Any,
) -> Cell:
    """An arm of the experiment: the published settings, but for what is named."""
    return Cell(label, published(method, **changes), train_colors, color_encoding, size, width)


# Arms by label, as tables name them.
MAIN = {
    "ppo": "PPO, as published",
    "ipo": "IPO, as published",
    "ppo_lr5e-4": "PPO, IPO's learning rate",
    "ipo_lr1e-3": "IPO, PPO's learning rate",
    "ensemble": "ensemble, pooled data",
}
TURNS = {
    "in_turn": "one network, one domain at a time",
    "in_turn_lr1e-3": "one network, one domain at a time, PPO's learning rate",
}
ARMS = MAIN | TURNS
LARGER = {
    "ppo": "PPO, 122,880 frames",
    "ipo": "IPO, 122,880 frames",
    "ppo_long": "PPO, four times as many",
    "ipo_long": "IPO, four times as many",
}


def check_train_colors(train_colors: object) -> None:
    """Two colours other than the test domain's.

    The 48 copies of the environment are split evenly among the players and domains of an ensemble,
    and once more among these colours and a third.
    """
    check_choices("train_colors", train_colors, [color for color in COLORS if color != TESTED])
    if len(train_colors) != 2:
        raise ValueError(f"train_colors = {train_colors!r}: must be two colours")


def main_arms(num_updates: int, train_colors: Sequence[str] = TRAINED) -> list[Cell]:
    """PPO and IPO as published, each with the other's learning rate, and IPO without the game."""
    of = partial(arm, train_colors=tuple(train_colors), num_updates=num_updates)
    return [
        of("ppo", "ppo"),
        of("ipo", "ipo"),
        of("ppo_lr5e-4", "ppo", learning_rate=5e-4),
        of("ipo_lr1e-3", "ipo", learning_rate=1e-3),
        of("ensemble", "ensemble", learning_rate=5e-4),
    ]


def turn_arms(num_updates: int, train_colors: Sequence[str] = TRAINED) -> list[Cell]:
    """IPO without players and their average: one network, on one domain at a time."""
    of = partial(arm, train_colors=tuple(train_colors), num_updates=num_updates)
    return [
        of("in_turn", "in_turn", learning_rate=5e-4),
        of("in_turn_lr1e-3", "in_turn", learning_rate=1e-3),
    ]


def fair_arms(num_updates: int, train_colors: Sequence[str] = TRAINED) -> list[Cell]:
    """PPO with as many weights as IPO's two players; three quarters of the data from one colour.

    As with the doors, the players' minibatches differ in size then, and not in number.
    """
    of = partial(arm, train_colors=tuple(train_colors), num_updates=num_updates)
    unequal = {"num_envs": (36, 12)}
    return [
        of("ppo_wide", "ppo", width=2**0.5),
        of("ppo_wide_lr5e-4", "ppo", width=2**0.5, learning_rate=5e-4),
        of("ppo_75_25", "ppo", **unequal),
        of("ipo_75_25", "ipo", num_minibatches=12, **unequal),
    ]


def with_a_third(train_colors: Sequence[str]) -> tuple[str, ...]:
    """Training colours and the first of the others."""
    return (*train_colors, next(color for color in COLORS if color not in train_colors))


def setting_names(train_colors: Sequence[str]) -> dict[str, str]:
    """Names of the arms with a third colour and with normalised advantages, by label."""
    three = in_words(with_a_third(train_colors))
    return {
        "ppo": "PPO, as published",
        "ipo": "IPO, as published",
        "ppo_3colors": f"PPO, {three}",
        "ipo_3colors": f"IPO, {three}",
        "ppo_normalized": "PPO, advantages normalised",
        "ipo_normalized": "IPO, advantages normalised",
    }


def fair_names(train_colors: Sequence[str]) -> dict[str, str]:
    """Names of the arms with a larger network and with unequal shares, by label."""
    most = f"three quarters in {train_colors[0]}"
    return {
        "ppo": "PPO, as published",
        "ppo_wide": "PPO, as many weights as IPO",
        "ppo_wide_lr5e-4": "PPO, as many weights, IPO's learning rate",
        "ppo_75_25": f"PPO, {most}",
        "ipo": "IPO, as published",
        "ipo_75_25": f"IPO, {most}",
    }


def in_words(colors: Sequence[str]) -> str:
    """Such as "red, green and blue"."""
    return f"{', '.join(colors[:-1])} and {colors[-1]}"


def variant_arms(num_updates: int, train_colors: Sequence[str] = TRAINED) -> list[Cell]:
    """A third colour, normalised advantages, a test inside the range of codes, other encodings."""
    of = partial(arm, train_colors=tuple(train_colors), num_updates=num_updates)
    arms = []
    for method in ("ppo", "ipo"):
        arms += [
            of(f"{method}_3colors", method, train_colors=with_a_third(train_colors)),
            of(f"{method}_normalized", method, normalize_advantages="minibatch"),
            of(f"{method}_inside", method, train_colors=INSIDE),
        ]
    for encoding in ("one_hot", "none"):
        arms += [
            of("ppo", "ppo", color_encoding=encoding),
            of("ipo", "ipo", color_encoding=encoding),
            of("ensemble", "ensemble", color_encoding=encoding, learning_rate=5e-4),
        ]
    return arms


def larger_arms(num_updates: int, size: int, train_colors: Sequence[str] = TRAINED) -> list[Cell]:
    """Both methods on a larger grid, with the same number of updates and four times as many."""
    of = partial(arm, train_colors=tuple(train_colors), size=size)
    return [
        of(f"{method}{suffix}", method, num_updates=factor * num_updates)
        for suffix, factor in (("", 1), ("_long", 4))
        for method in ("ppo", "ipo")
    ]


def run_cell(
    cell: Cell, seeds: list[int], tables: str | Path, policies: str | Path | None = None
) -> pd.DataFrame:
    """Train all runs of a cell and evaluate them in every colour.

    ``tables`` is the folder of tabulated tasks. The weights of the first ten runs are saved in
    ``policies``.

    Raises:
        ValueError: policies of other settings or runs are where these would be saved.
    """
    saves = policies is not None and seeds[:1] == [0]
    made_for = {"cell": cell, "seeds": seeds[:NUM_SAVED]}
    if saves:
        check_place(policy_path(policies, cell), made_for)
    task = Keys(tables, cell.color_encoding, cell.size, cell.width)
    *_, (_, players) = task.train(cell, seeds)
    if saves:
        first = [{name: w[:NUM_SAVED] for name, w in player.items()} for player in players]
        save_policy(policy_path(policies, cell), first, made_for)
    return tidy(cell, seeds, evaluate(task, players, seeds))


def run_rows(cell: Cell, seeds: list[int], tables: str | Path) -> pd.DataFrame:
    """The same, of which no weights are kept."""
    return run_cell(cell, seeds, tables)


def policy_path(policies: str | Path, cell: Cell) -> Path:
    """The file of a cell's first runs."""
    return Path(policies) / f"{cell.name}.safetensors"


def run_curve(cell: Cell, seeds: list[int], tables: str | Path) -> pd.DataFrame:
    """Exact returns in every colour after each update: rows with a column ``frames``."""
    return curve(Keys(tables, cell.color_encoding, cell.size), cell, seeds, exact)


def curve(
    task: Keys, cell: Cell, seeds: Sequence[int], measure: Callable[..., dict[tuple[str, str], Any]]
) -> pd.DataFrame:
    """Rows of ``measure(task, players)`` before training and after each update."""
    parts = [
        tidy(cell, seeds, measure(task, players), frames=frames)
        for frames, players in task.train(cell, seeds)
    ]
    return pd.concat(parts, ignore_index=True)


@functools.lru_cache(maxsize=2)
def in_all_colors(tables: str | Path, size: int) -> tuple[dict[str, TabularTask], TabularDomains]:
    """The task in each colour, and in all; a process reads the files once, not for each cell."""
    tasks = {
        color: load_or_tabulate(ColoredKeysEnv, tables, size=size, color=color) for color in COLORS
    }
    return tasks, TabularDomains(list(tasks.values()))


class Keys:
    """The tabulated task in all colours, for one encoding of colours, one size and width."""

    def __init__(
        self,
        tables: str | Path,
        color_encoding: str = "integer",
        size: int = 5,
        width: float = 1.0,
    ) -> None:
        self.color_encoding = color_encoding
        self.tasks, self.domains = in_all_colors(tables, size)
        num_channels = encode(self.domains.images[:1], color_encoding).shape[-1]
        self.network = GridNetwork(num_channels, width=width)

    def train(self, cell: Cell, seeds: list[int]) -> Iterator[tuple[int, list[Weights]]]:
        """:meth:`ipo.ppo.Training.reports` in the cell's training colours."""
        domains = TabularDomains([self.tasks[color] for color in cell.train_colors])
        return self.train_in(domains, domains.images, len(cell.train_colors), cell, seeds)

    def train_in(
        self,
        domains: MakeEnvironments,
        images: np.ndarray,
        num_domains: int,
        cell: Cell,
        seeds: list[int],
    ) -> Iterator[tuple[int, list[Weights]]]:
        """The same in domains that are not colours; they index ``images [K, 7, 7, 3]``."""
        network = OnTable(self.network, encode(images, self.color_encoding))
        return training_of(network, domains, num_domains, cell.settings, seeds).reports()

    def logits(self, players: Sequence[Weights], images: np.ndarray) -> torch.Tensor:
        """Of the average policy ``[R, K, A]`` for MiniGrid's ``images [K, 7, 7, 3]``.

        In double precision, so that a saved policy has the same return on every machine.
        """
        return self._on_table(images).average(_in_double(players))[0]

    def logits_in_all_colors(self, players: Sequence[Weights]) -> torch.Tensor:
        """The same for ``domains.images``."""
        return self._on_domains.average(_in_double(players))[0]

    def policies(
        self, players: Sequence[Weights], colors: Sequence[str] = COLORS
    ) -> dict[str, np.ndarray]:
        """Probabilities ``[R, K, A]`` of the average policy in some colours, by observation."""
        logits = self.logits_in_all_colors(players)
        return {color: self.seen_in(color, logits).softmax(-1).numpy() for color in colors}

    def seen_in(self, color: str, logits: torch.Tensor) -> torch.Tensor:
        """Of logits in all colours those for the images of one."""
        return logits[:, self.domains.observation_of[COLORS.index(color)]]

    @functools.cached_property
    def _on_domains(self) -> OnTable:
        return self._on_table(self.domains.images)

    def _on_table(self, images: np.ndarray) -> OnTable:
        return OnTable(self.network, encode(images, self.color_encoding).double())

    def saved(self, cell: Cell, policies: Path) -> tuple[list[Weights], list[int]]:
        """Weights of the saved runs of a cell, a dictionary per player, and their seeds."""
        path = policy_path(policies, cell)
        players, about = load_policy(path, self.network, {"cell": cell})
        return players, about["seeds"]


def _in_double(players: Sequence[Weights]) -> list[Weights]:
    return [{name: w.double() for name, w in player.items()} for player in players]


def returns(
    task: Keys, players: Sequence[Weights], colors: Sequence[str] = COLORS
) -> dict[tuple[str, str], np.ndarray]:
    """The exact return ``[R]`` alone of :func:`exact`, in some colours."""
    return {
        (color, "return_exact"): expected_return(task.tasks[color], policy)[0]
        for color, policy in task.policies(players, colors).items()
    }


def exact(task: Keys, players: Sequence[Weights]) -> dict[tuple[str, str], np.ndarray]:
    """Metrics ``[R]`` without sampling error, keyed by colour and metric.

    Besides return and success: those of the most likely actions (``greedy``), the probability
    of ever holding the key and of ever unlocking the door, and the policy's entropy in nats,
    averaged over the observations of the colour.
    """
    metrics = {}
    everywhere = task.logits_in_all_colors(players)
    for color, table in task.tasks.items():
        logits = task.seen_in(color, everywhere)
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
    generators = [
        [np.random.default_rng([seed, code]) for seed in seeds] for code in range(len(COLORS))
    ]
    logits = task.logits_in_all_colors(players)
    by_color = zip(COLORS, published_protocol(task.domains, logits, generators), strict=True)
    protocol = {(color, "return_published_protocol"): values for color, values in by_color}
    return exact(task, players) | protocol


def published_protocol(
    domains: TabularDomains,
    logits: torch.Tensor,
    generators: Sequence[Sequence[np.random.Generator]],
) -> np.ndarray:
    """Mean return ``[E, R]`` as the published runs measure it.

    Fifty copies act until at least a hundred episodes are over; the mean is over those. Short
    episodes end first, so they count too often, and the number is too high.

    Args:
        domains: E of them.
        logits: ``[R, K, A]`` of what is seen in all domains together.
        generators: R for each domain. All act side by side, as if they were E R runs.
    """
    (num_runs, num_seen, num_actions), streams = logits.shape, list(itertools.chain(*generators))
    own = np.repeat(np.arange(len(generators)), num_runs)[:, None].repeat(NUM_COPIES, axis=1)
    first = num_seen * torch.arange(num_runs).repeat(len(generators))[:, None]  # row of each run
    rows, copies = logits.reshape(-1, num_actions), TabularEnvironments(domains, own, streams)
    observation = copies.reset()
    episodes, total = np.zeros(len(own)), np.zeros(len(own))
    while (running := episodes < NUM_EPISODES).any():
        step = copies.step(Categorical.sample(rows[first + observation], streams))
        ended = (step.terminated | step.truncated).sum(1).numpy()
        episodes += running * ended
        total += running * step.reward.sum(1).numpy()
        observation = step.observation
    return (total / episodes).reshape(len(generators), num_runs)


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
    facts = description(tabulate(ColoredKeysEnv(size=grid.size), max_states=1_000_000))
    return tidy(grid, seeds, {(TESTED, name): [value] for name, value in facts.items()})


def description(task: TabularTask) -> dict[str, float]:
    """How large a table is, and what the best policy, which knows the state, gets."""
    return {
        "layouts": (task.start > 0).sum(),
        "states": len(task.start),
        "distinct observations": len(task.images),
        "optimal return": optimal_policy(task)[1],
    }


def short(cell: Cell) -> Cell | None:
    """Two updates. Larger grids take minutes to tabulate; other colours are of no other kind.

    Nor are inner rounds without a variable Phi.

    Normalised advantages are large while returns are nearly zero: there one update is enough for
    rounding to become visible, and two make another policy of it.
    """
    if cell.size != 5 or "yellow" in cell.train_colors:
        return None
    if cell.settings.method == "ensemble" and cell.color_encoding != "integer":
        return None
    if cell.settings.num_inner_rounds > 1 and not cell.settings.variable_phi:
        return None
    num_updates = 2 if cell.settings.normalize_advantages == "none" else 1
    return replace(cell, settings=replace(cell.settings, num_updates=num_updates))


EXPERIMENTS = (
    {
        name: Experiment(run_cell, Cell, short, runs_at_once=25)
        for name in ("main", "turns", "variants", "larger")
    }
    | {name: Experiment(run_rows, Cell, short, runs_at_once=25) for name in ("in_full", "fair")}
    | {
        "curves": Experiment(run_curve, Cell, short, runs_at_once=25),
        "grids": Experiment(run_grid, Grid, lambda grid: grid if grid.size == 5 else None, (0,)),
    }
)
