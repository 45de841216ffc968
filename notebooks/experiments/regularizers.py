"""Regularisers that the paper names and does not run, on pooled training, for keys and for LQR.

Weight decay (decoupled, AdamW), dropout, and penalties on what differs between training domains:
the variance of returns or costs (V-REx) and their slope in a factor on the policy (IRMv1).

How strong a regulariser is comes from training domains alone, by a rule that was fixed, with the
grids below, before anything was trained: the largest weight that does no harm there. A return may
be lower by 0.02 than the best of the grid's, no regulariser included, and a cost higher by 1 %.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from experiments import keys, lqr

NAMES = {
    "weight_decay": "weight decay",
    "dropout": "dropout",
    "variance_penalty": "V-REx",
    "scale_penalty": "IRMv1",
}
KEYS_GRID = {
    "weight_decay": (0.1, 1.0),
    "dropout": (0.1, 0.3),
    "variance_penalty": (1.0, 10.0, 100.0),
    "scale_penalty": (1.0, 10.0, 100.0),
}
LQR_GRID = {
    "weight_decay": (0.01, 0.1, 1.0),
    "dropout": (0.1, 0.3),
    "variance_penalty": (0.01, 1.0, 100.0),
    "scale_penalty": (0.0001, 0.01, 1.0),
}
LOST_RETURN, LOST_COST = 0.02, 0.01  # that do no harm; the second is a share


def label(baseline: str, name: str, weight: float) -> str:
    """Of an arm, such as ``ppo_dropout0.1``; of the baseline itself where the weight is 0."""
    return f"{baseline}_{name}{weight:g}" if weight else baseline


def keys_arms(num_updates: int, train_colors: Sequence[str] = keys.TRAINED) -> list[keys.Cell]:
    """PPO as published, with each regulariser at each weight."""
    return [
        keys.arm(
            label("ppo", name, weight),
            "ppo",
            train_colors=tuple(train_colors),
            num_updates=num_updates,
            **{name: weight},
        )
        for name, weights in KEYS_GRID.items()
        for weight in weights
    ]


def lqr_cells(num_domains: int, dim_distractor: int, num_iterations: int) -> list[lqr.Cell]:
    """Gradient descent as published, with each regulariser at each weight."""
    plain = lqr.published_cell("gradient_descent", num_domains, dim_distractor, num_iterations)
    return [
        replace(
            plain,
            label=label(plain.label, name, weight),
            settings=replace(plain.settings, **{name: weight}),
        )
        for name, weights in LQR_GRID.items()
        for weight in weights
    ]


def largest_harmless(losses: Mapping[float, float], allowed: float) -> float:
    """The largest weight whose loss in training is at most ``allowed`` above the lowest.

    ``losses`` are by weight, that of no regulariser at 0 among them.
    """
    lowest = min(losses.values())
    return max((w for w, loss in losses.items() if loss <= lowest + allowed), default=0.0)
