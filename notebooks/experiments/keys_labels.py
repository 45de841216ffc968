"""Coloured keys whose domains are hidden: they are inferred from the pooled task, then IPO plays.

An *environment* is a layout in one of the training colours. A *labelling* says for each run which
of two inferred domains an environment belongs to. No labelling is told a colour:

    clustered   k-means of what is seen on average while acting at random
    inferred    environment inference: the domains that violate invariance most, for a policy that
                was trained on the pooled task
    random      halves that are drawn anew in each run

Source: Creager, Jacobsen and Zemel, Environment inference for invariant learning (2021).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import scipy.special
from sklearn.cluster import KMeans

from experiments import keys
from experiments.experiment import Experiment
from experiments.keys import TESTED, Keys, evaluate
from experiments.keys_tables import gap, runs_of
from experiments.rows import tidy
from experiments.tables import mean_and_std
from experiments.visits import occupancy
from ipo.checks import checked, one_of
from ipo.distributions import Generators
from ipo.networks import Weights
from ipo.worlds.tabular import (
    TabularDomains,
    TabularEnvironments,
    TabularTask,
    values,
)

NUM_LABELS = 2
STEP = 1e-3  # of the difference quotient in the policy's scale

Labels = np.ndarray  # [R, C], of each environment in each run
NAMES = {
    "ipo": "IPO, labels given",
    "ipo_clustered": "IPO, labels by clustering",
    "ipo_inferred": "IPO, labels by environment inference",
    "ipo_random": "IPO, labels at random",
    "ensemble": "ensemble, no labels",
}


def clustered(task: Keys, pooled: TabularTask, cell: keys.Cell, seeds: Sequence[int]) -> Labels:
    """k-means of the mean image of an episode with random actions, exact, the same for all runs."""
    num_actions = pooled.next_state.shape[1]
    uniform = np.full((1, len(pooled.images), num_actions), 1 / num_actions)
    seen = [occupancy(starting_in(pooled, [start]), uniform)[0] for start in environments(pooled)]
    weights = np.array(seen) / np.sum(seen, axis=1, keepdims=True)  # [C, S]
    images = pooled.images[pooled.observation].reshape(len(pooled.start), -1)
    found = KMeans(NUM_LABELS, n_init=10, random_state=0).fit_predict(weights @ images)
    return np.tile(found, (len(seeds), 1))


def inferred(task: Keys, pooled: TabularTask, cell: keys.Cell, seeds: Sequence[int]) -> Labels:
    """The halves that maximise IRM's penalty of PPO's policy, which knows no domains.

    With J_c(w) the return in environment c of a policy whose scores are multiplied by w, and
    g_c = J_c'(1), the penalty of domains D_1 and D_2 is the sum of the squares of

        d/dw (1 / |D_e|) sum_(c in D_e) J_c(w),   at w = 1.

    Of all halves it is largest where the g_c are apart at their median. (Of all pairs of domains,
    it is largest where one of them has a single environment.)
    """
    learning_rate = keys.published("ppo").learning_rate
    ppo = replace(cell.settings, method="ppo", learning_rate=learning_rate)
    *_, (_, players) = task.train(replace(cell, settings=ppo), list(seeds))
    slopes = slopes_in_scale(task, pooled, players)
    order = slopes.argsort(axis=1, kind="stable").argsort(axis=1)
    return (order >= slopes.shape[1] // 2).astype(int)


def at_random(task: Keys, pooled: TabularTask, cell: keys.Cell, seeds: Sequence[int]) -> Labels:
    """Halves of the environments, drawn anew in each run."""
    halves = np.arange(len(environments(pooled))) % NUM_LABELS
    return np.stack([np.random.default_rng([seed, 1]).permutation(halves) for seed in seeds])


LABELLINGS: dict[str, Callable[..., Labels]] = {
    "clustered": clustered,
    "inferred": inferred,
    "random": at_random,
}


@checked
@dataclass(frozen=True)
class Cell:
    """IPO on inferred domains.

    Attributes:
        trained: how, and in which colours, which it is not told.
        labels: how environments are told apart; one of ``LABELLINGS``.
    """

    trained: keys.Cell
    labels: Annotated[str, one_of(tuple(LABELLINGS))]

    @property
    def columns(self) -> dict[str, Any]:
        return self.trained.columns | {"method": f"{self.trained.label}_{self.labels}"}


def label_cells(num_updates: int, train_colors: Sequence[str] = keys.TRAINED) -> list[Cell]:
    """IPO as published, with each of the labellings."""
    ipo = keys.arm("ipo", "ipo", train_colors=tuple(train_colors), num_updates=num_updates)
    return [Cell(ipo, labels) for labels in LABELLINGS]


def run_labels(cell: Cell, seeds: list[int], tables: str | Path) -> pd.DataFrame:
    """Label, train and evaluate; beside the metrics of keys, what the labels are.

    ``agreement`` is |2 a - 1|, with a the part of the environments whose label is their colour's:
    1 for the colours themselves, 0 for labels that say nothing of them. ``smaller_domain`` is the
    part of the environments in the smaller domain.
    """
    trained = cell.trained
    task = Keys(tables, trained.color_encoding, trained.size)
    pooled = joined([task.tasks[color] for color in trained.train_colors])
    labels = LABELLINGS[cell.labels](task, pooled, trained, seeds)
    domains = LabelledDomains(pooled, labels)
    *_, (_, players) = task.train_in(domains, domains.images, NUM_LABELS, trained, seeds)
    share = labels.mean(1)
    metrics = evaluate(task, players, seeds) | {
        ("train", "agreement"): agreement(labels, len(trained.train_colors)),
        ("train", "smaller_domain"): np.minimum(share, 1 - share),
    }
    return tidy(cell, seeds, metrics)


def agreement(labels: Labels, num_colors: int) -> np.ndarray:
    """|2 a - 1| ``[R]`` of labels of environments that go by colour, half of them in each."""
    colors = np.repeat(np.arange(num_colors), labels.shape[1] // num_colors)
    return np.abs(2 * (labels == colors).mean(1) - 1)


def joined(tasks: Sequence[TabularTask]) -> TabularTask:
    """One task that begins in each of some tasks equally often."""
    first = np.cumsum([0] + [len(task.start) for task in tasks])
    seen = np.cumsum([0] + [len(task.images) for task in tasks])

    def together(name: str) -> np.ndarray:
        return np.concatenate([getattr(task, name) for task in tasks])

    return replace(
        tasks[0],
        next_state=np.concatenate([t.next_state + n for t, n in zip(tasks, first, strict=False)]),
        observation=np.concatenate([t.observation + n for t, n in zip(tasks, seen, strict=False)]),
        start=together("start") / len(tasks),
        **{
            name: together(name)
            for name in ("goal", "done", "images", "progress", "position", "signature")
        },
    )


def starting_in(task: TabularTask, states: Sequence[int] | np.ndarray) -> TabularTask:
    """The same task, where episodes begin in these states alone, in proportion to before."""
    start = np.zeros_like(task.start)
    start[states] = task.start[states]
    return replace(task, start=start / start.sum())


def environments(task: TabularTask) -> np.ndarray:
    """The states ``[C]`` in which an episode can begin."""
    return np.flatnonzero(task.start)


def slopes_in_scale(task: Keys, pooled: TabularTask, players: Sequence[Weights]) -> np.ndarray:
    """g_c ``[R, C]``: how the return in each environment changes with the scores' scale."""
    logits = task.logits(players, pooled.images).numpy()
    up, down = (
        values(pooled, scipy.special.softmax(scale * logits, axis=-1))[0]
        for scale in (1 + STEP, 1 - STEP)
    )
    return ((up - down) / (2 * STEP))[environments(pooled)].T


class LabelledDomains:
    """Inferred domains of one task, in each run others: ``ppo.MakeEnvironments``."""

    def __init__(self, pooled: TabularTask, labels: Labels) -> None:
        starts = environments(pooled)
        own = [starting_in(pooled, starts[run == e]) for run in labels for e in range(NUM_LABELS)]
        self.table, self.num_runs = TabularDomains(own), len(labels)

    @property
    def images(self) -> np.ndarray:
        return self.table.images

    def __call__(
        self, domains: list[int], num_copies: list[int], generators: Generators
    ) -> TabularEnvironments:
        first = NUM_LABELS * np.arange(self.num_runs)[:, None]
        chosen = first + np.repeat(domains, num_copies)  # [R, N]
        return TabularEnvironments(self.table, chosen, generators)


def table(rows: pd.DataFrame) -> pd.DataFrame:
    """By method: what its labels are, its return on grey, and its difference to given labels."""
    means = rows.groupby(["method", "metric"])["value"].mean().unstack()
    # Given labels are the colours themselves; an ensemble has none.
    means.loc["ipo", ["agreement", "smaller_domain"]] = 1, 0.5
    return pd.DataFrame(
        {
            "arm": NAMES,
            "agreement": means["agreement"],
            "smaller domain": means["smaller_domain"],
            "return on grey": {m: mean_and_std(runs_of(rows, m, TESTED), 3) for m in NAMES},
            "− given labels": {m: gap(rows, m, "ipo") if m != "ipo" else "" for m in NAMES},
        }
    ).loc[list(NAMES)]


def short(cell: Cell) -> Cell:
    """Two updates."""
    return replace(cell, trained=keys.short(cell.trained))


EXPERIMENTS = {"labels": Experiment(run_labels, Cell, short, runs_at_once=25)}
