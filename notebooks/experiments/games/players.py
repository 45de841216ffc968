"""What the players of a game between networks do while they are trained on coloured keys."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from experiments import keys
from experiments.experiment import Experiment
from experiments.keys import Keys, encode
from experiments.rows import tidy
from ipo.game import nash_gap
from ipo.networks import Weights, copied
from ipo.ppo import Training
from ipo.worlds.networks import OnTable
from ipo.worlds.tabular import TabularDomains, optimal_policy


@dataclass(frozen=True)
class Cell:
    """Players that are looked at while they are trained on coloured keys.

    Attributes:
        trained: how.
        checkpoints: updates after which every player goes on alone.
        num_alone: for so many updates.
    """

    trained: keys.Cell
    checkpoints: tuple[int, ...] = ()
    num_alone: int = 5

    @property
    def columns(self) -> dict[str, Any]:
        return self.trained.columns


def run_players(cell: Cell, seeds: list[int], tables: str | Path) -> pd.DataFrame:
    """Train on coloured keys and look at the players: rows with a column ``update``.

    After every update: how far the first and the last player are apart in their weights, how far
    the first is from its start, and whether what the two have learnt points in the same direction
    (the correlation of the changes of their scores since the start, over all observations and
    actions of the training domains).

    At the checkpoints also what each player gains in its own domain when it goes on alone while
    the others stand still. The best of them is a lower bound on the Nash gap. An upper bound is
    what is missing to the optimal return in the worst domain.
    """
    trained = cell.trained
    colors = trained.train_colors
    task = Keys(tables, trained.color_encoding, trained.size)
    domains = TabularDomains([task.tasks[color] for color in colors])
    network = OnTable(task.network, encode(domains.images, trained.color_encoding))
    training = Training(network, domains, len(colors), trained.settings, seeds)
    start = copied(training.players)
    scores_at_start = [_scores(task, player, colors) for player in start]
    best = [optimal_policy(task.tasks[color])[1] for color in colors]
    parts = []
    for update in range(trained.settings.num_updates + 1):
        if update:
            training.update()
        returns = keys.returns(task, training.players, colors)
        now = np.stack(list(returns.values()), 1)  # [R, E]
        metrics = returns | {
            ("all", "distance_players"): _distance(training.players[0], training.players[-1]),
            ("all", "distance_start"): _distance(training.players[0], start[0]),
            ("train", "gap_upper"): _gap(now, np.broadcast_to(best, now.shape)),
        }
        if update:
            moves = [
                _scores(task, player, colors) - before
                for player, before in zip(training.players, scores_at_start, strict=True)
            ]
            metrics["all", "move_correlation"] = _correlation(moves[0], moves[-1])
        if update in cell.checkpoints:
            better = [
                keys.returns(task, _alone(training, d, cell.num_alone), [color])
                for d, color in enumerate(colors)
            ]
            after = np.stack([own for found in better for own in found.values()], 1)
            metrics["train", "gap_lower"] = _gap(now, after).clip(min=0)
        parts.append(tidy(cell, seeds, metrics, update=update))
    return pd.concat(parts, ignore_index=True)


def _gap(returns: np.ndarray, better: np.ndarray) -> np.ndarray:
    """The Nash gap ``[R]`` in returns ``[R, E]``, which are negative costs."""
    return nash_gap(torch.tensor(-returns), torch.tensor(-better)).numpy()


def _alone(training: Training, d: int, num_updates: int) -> list[Weights]:
    """The players after player d has gone on for some updates while the others stood still.

    They take their turns all the same, and what they have learnt is taken back: all players draw
    from the same random streams, so what d sees depends on how much the others have drawn.
    """
    training = copy.deepcopy(training)
    for _ in range(num_updates):
        for e in range(len(training.players)):
            before = copied(training.players)
            training.update(only=e)
            if e != d:
                training.learners.set(before)
    return training.players


def _scores(task: Keys, player: Weights, colors: Sequence[str]) -> Tensor:
    """What a player alone says ``[R, observations, A]``, up to what the softmax ignores."""
    everywhere = task.logits_in_all_colors([player])
    scores = torch.cat([task.seen_in(color, everywhere) for color in colors], dim=1)
    return scores - scores.mean(-1, keepdim=True)


def _correlation(one: Tensor, other: Tensor) -> Tensor:
    """Of all numbers of a run, ``[R]``."""
    one, other = one.flatten(1), other.flatten(1)
    return torch.cosine_similarity(one - one.mean(1, True), other - other.mean(1, True), dim=1)


@torch.no_grad()
def _distance(one: Weights, other: Weights) -> Tensor:
    """Euclidean distance ``[R]`` over all weights."""
    squares = [(one[name] - other[name]).flatten(1).square().sum(1) for name in one]
    return torch.stack(squares).sum(0).sqrt()


def short(cell: Cell) -> Cell:
    """Two updates, and one of every player alone at the beginning and the end."""
    return replace(cell, trained=keys.short(cell.trained), checkpoints=(0, 2), num_alone=1)


EXPERIMENT = Experiment(run_players, Cell, short)
