"""Gradient descent in LQR with a regulariser: weight decay, dropout, V-REx's or IRMv1's penalty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from experiments import lqr
from experiments.experiment import Experiment
from experiments.rows import tidy
from ipo.checks import NonNegative, check_number, checked
from ipo.game import LinearPlayers
from ipo.lqr import LQR, training_costs
from ipo.lqr_learners import LQRSettings
from ipo.optimizers import make_optimizer

SCALED_BY = 0.01  # a gain, to see how its cost changes


@checked
@dataclass(frozen=True)
class RegularizedLQRSettings(LQRSettings):
    """How gradient descent is trained that lowers :func:`regularized_cost`."""

    variance_penalty: NonNegative = 0.0
    scale_penalty: NonNegative = 0.0
    dropout: Annotated[float, partial(check_number, least=0, below=1)] = 0.0

    def __post_init__(self) -> None:
        if self.method != "gradient_descent":
            raise ValueError(f"method = {self.method!r}: must be 'gradient_descent'")


@dataclass(frozen=True)
class RegularizedCell(lqr.Cell):
    """Gradient descent with regularisers."""

    settings: RegularizedLQRSettings


def run_cell(cell: RegularizedCell, seeds: list[int]) -> pd.DataFrame:
    """As :func:`experiments.lqr.run_cell`."""
    settings = cell.settings
    if not (settings.variance_penalty or settings.scale_penalty or settings.dropout):
        return lqr.run_cell(cell, seeds)  # weight decay is the optimiser's
    problem = lqr.problem_of(cell, seeds)
    return tidy(cell, seeds, lqr.evaluate(regularized_gain(problem, settings, seeds), problem))


def regularized_gain(
    problem: LQR, settings: RegularizedLQRSettings, seeds: Sequence[int]
) -> Tensor:
    """Where gradient descent from zero ends, ``[R, n_u, n_o]``."""
    start = torch.zeros(problem.num_runs, 1, *problem.gain_shape, dtype=problem.A.dtype)
    player = LinearPlayers(
        start,
        lambda weights: make_optimizer(
            settings.optimizer, weights, settings.learning_rate, settings.weight_decay
        ),
        max_gradient_norm=settings.max_gradient_norm,
    )
    streams = [np.random.default_rng(np.random.SeedSequence(s).spawn(2)[1]) for s in seeds]
    for _ in range(settings.num_iterations):
        player.round([lambda K: regularized_cost(K, problem, settings, streams)])
    return player.policy


def regularized_cost(
    K: Tensor,
    problem: LQR,
    settings: RegularizedLQRSettings,
    generators: Sequence[np.random.Generator],
) -> Tensor:
    """What gains ``[R, n_u, n_o]`` are to lower instead of the pooled cost, ``[R]``::

        mean_d J_d + variance_penalty var_d J_d + scale_penalty mean_d (d J_d(w K) / d w)^2

    The derivative, at w = 1, is a central difference: the gradient of a cost is analytic and cannot
    be differentiated again. With ``dropout`` an observation is left out with that probability,
    drawn anew in each step, and what is left is scaled up. Where a closed loop is unstable the
    whole is infinite.

    Sources: Krueger et al. (2021) for V-REx, Arjovsky et al. (2019) for IRMv1.
    """
    if settings.dropout:
        uniform = np.stack([generator.random((1, K.shape[-1])) for generator in generators])
        kept = (uniform >= settings.dropout) / (1 - settings.dropout)
        K = K * torch.from_numpy(kept).to(K)
    costs = training_costs(K, problem)
    total = costs.mean(1)
    if settings.variance_penalty:
        total = total + settings.variance_penalty * costs.var(1, unbiased=False)
    if settings.scale_penalty:
        more, less = (training_costs((1 + by) * K, problem) for by in (SCALED_BY, -SCALED_BY))
        slopes = (more - less) / (2 * SCALED_BY)
        total = total + settings.scale_penalty * slopes.square().mean(1)
    return torch.where(total.isfinite(), total, torch.inf)


EXPERIMENTS = {"regularized": Experiment(run_cell, RegularizedCell, lqr.short)}
