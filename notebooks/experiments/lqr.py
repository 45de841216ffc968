"""From a configuration of the LQR experiment to tidy rows, one per run, domain and metric."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import pandas as pd
import torch
from torch import Tensor

from experiments.experiment import Experiment
from experiments.rows import tidy
from ipo.checks import check_count
from ipo.game import nash_gap
from ipo.lqr import (
    LQR,
    expected_cost,
    minimum_norm_gain,
    project,
    riccati_gain,
    row_space,
    sample_problem,
    training_costs,
)
from ipo.lqr_learners import Settings, train

VALIDATION_INTERVAL = 20  # iterations between two looks at the held-out domain


@dataclass(frozen=True)
class Cell:
    """One configuration of the experiment.

    Attributes:
        label: the method's name in the rows: a method, a control such as
            ``gradient_descent_lr5e-4``, or ``oracle`` and ``minimum_norm``, which are not trained.
        num_domains: training domains n_d.
        dim_distractor: n_y.
        settings: how the method is trained; ``None`` for what is not trained.
        early_stopping: train on all training domains but the last, and keep the controller
            that costs least in that one.
        precision: ``float32`` (as published) or ``float64``.
    """

    label: str
    num_domains: int
    dim_distractor: int
    settings: Settings | None
    early_stopping: bool = False
    precision: str = "float32"

    @property
    def columns(self) -> dict[str, Any]:
        return {
            "method": self.label,
            "num_domains": self.num_domains,
            "dim_distractor": self.dim_distractor,
            "optimizer": self.settings.optimizer if self.settings else "none",
        }


def run_cell(cell: Cell, seeds: list[int]) -> pd.DataFrame:
    """Train all runs of a cell and evaluate the controllers that they end with.

    The oracle, which sees the state, costs the same in every domain.
    """
    problem = _problem(cell, seeds)
    if cell.label == "oracle":
        _, cost = riccati_gain(problem)
        return tidy(cell, seeds, {("test", "test_cost"): cost})
    return tidy(cell, seeds, evaluate(final_gain(cell, problem, seeds), problem))


def run_curve(cell: Cell, seeds: list[int], num_points: int = 40) -> pd.DataFrame:
    """The same, evaluated on the way: rows with a column ``iteration``, even in its logarithm."""
    problem = _problem(cell, seeds)
    last = cell.settings.num_iterations
    checkpoints = {round(last ** (i / num_points)) for i in range(num_points + 1)} | {0}
    parts = []
    for iteration, gain in train(problem, cell.settings, seeds, checkpoints=sorted(checkpoints)):
        parts.append(tidy(cell, seeds, evaluate(gain, problem), iteration=iteration))
    return pd.concat(parts, ignore_index=True)


def final_gain(cell: Cell, problem: LQR, seeds: list[int]) -> Tensor:
    """The controllers ``[R, n_u, n_o]`` of a cell."""
    if cell.label == "minimum_norm":
        return minimum_norm_gain(problem)
    if cell.early_stopping:
        return _early_stopped_gain(problem, cell.settings, seeds)
    *_, (_, gain) = train(problem, cell.settings, seeds)
    return gain


def evaluate(gain: Tensor, problem: LQR) -> dict[tuple[str, str], Tensor]:
    """Every metric ``[R]`` of gains ``[R, n_u, n_o]``, keyed by domain and metric.

    ``outside`` is the part of a gain that no training domain can show; ``projected`` is the
    gain without it.
    """
    n_x = problem.A.shape[-1]
    basis = row_space(problem)
    inside = project(gain, basis)
    closed_form = minimum_norm_gain(problem)
    costs = training_costs(gain, problem)
    _, oracle = riccati_gain(problem)
    return {
        ("train", "train_cost"): costs.mean(1),
        ("train", "train_cost_projected"): training_costs(inside, problem).mean(1),
        ("test", "test_cost"): expected_cost(gain, problem, problem.W_test),
        ("test", "test_cost_projected"): expected_cost(inside, problem, problem.W_test),
        ("train", "nash_gap"): nash_gap(costs, oracle[:, None]),
        ("all", "gain_norm_state"): _norm(gain[..., :n_x]),
        ("all", "gain_norm_distractor"): _norm(gain[..., n_x:]),
        ("all", "gain_norm_inside"): _norm(inside),
        ("all", "gain_norm_outside"): _norm(gain - inside),
        ("all", "distance_to_minimum_norm"): _norm(gain - closed_form) / _norm(closed_form),
    }


def _early_stopped_gain(problem: LQR, settings: Settings, seeds: list[int]) -> Tensor:
    n_x = problem.A.shape[-1]
    check_count("num_domains", problem.num_domains, minimum=2)
    inner = replace(problem, seen=problem.seen[..., :-n_x])
    held_out = problem.seen[..., -n_x:]
    best = torch.zeros(problem.num_runs, *problem.gain_shape, dtype=problem.A.dtype)
    best_cost = torch.full((problem.num_runs,), torch.inf, dtype=problem.A.dtype)
    looks = range(0, settings.num_iterations + 1, VALIDATION_INTERVAL)
    for _, gain in train(inner, settings, seeds, checkpoints=looks):
        cost = expected_cost(gain, problem, held_out)
        better = cost < best_cost
        best[better], best_cost[better] = gain[better], cost[better]
    return best


def _problem(cell: Cell, seeds: list[int]) -> LQR:
    dtype = getattr(torch, cell.precision)
    return sample_problem(seeds, cell.num_domains, cell.dim_distractor, dtype=dtype)


def _norm(gain: Tensor) -> Tensor:
    return torch.linalg.matrix_norm(gain)


def short(cell: Cell) -> Cell | None:
    """Some dozens of iterations. More domains or distractors cost more and are of no other kind."""
    if cell.num_domains > 5 or cell.dim_distractor > 1000:
        return None
    if cell.settings is None:
        return cell
    few = 3 if cell.settings.optimizer == "lbfgs" else 30
    return replace(cell, settings=replace(cell.settings, num_iterations=few))


EXPERIMENTS = {
    name: Experiment(run_cell, Cell, short)
    for name in ("tables", "starts", "more_domains", "closed_form", "optimizers", "controls")
} | {"curves": Experiment(run_curve, Cell, short)}
