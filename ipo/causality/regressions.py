"""Regression problems with two weights, in which domains disagree about one of them.

A causal feature and a spurious one predict a target,

    y = c x_1 + e,        x_1, e ~ N(0, 1) independent,        J_d(w) = E (y - w_1 x_1 - w_2 x_2)^2

``x_2`` is related to y differently in every domain, so ``w = (c, 0)`` is the invariant predictor.
"""

from __future__ import annotations

from typing import Annotated

import torch
from torch import Tensor

from ipo.causality.predictors import Regression
from ipo.checks import checked


def _at_least_two_domains(name: str, spurious: Tensor) -> None:
    if spurious.shape[1] < 2:
        raise ValueError(f"{name}: has shape {tuple(spurious.shape)}, must have 2 or more domains")


Spurious = Annotated[Tensor, "R E", _at_least_two_domains]


@checked
def correlated_noise(spurious: Spurious, causal: float = 1.0) -> Regression:
    """``x_2 = rho_d e + sqrt(1 - rho_d^2) n``: related to the noise of y, uncorrelated with x_1.

    Features have variance 1, so costs are separable and a domain's own optimum is
    ``(c, rho_d)``. ``spurious [R, E]`` holds the rho_d.

    Raises:
        ValueError: fewer than two domains, a coefficient that is NaN or outside [-1, 1].
    """
    if bool((spurious.abs() > 1).any()):
        raise ValueError(f"spurious: holds {spurious.abs().max():.3g}, must be within [-1, 1]")
    gram = torch.eye(2, dtype=spurious.dtype).expand(*spurious.shape, 2, 2)
    moment = torch.stack([torch.full_like(spurious, causal), spurious], dim=-1)
    return Regression(gram, moment, torch.full_like(spurious, causal**2 + 1))


@checked
def effect_of_target(spurious: Spurious, causal: float = 1.0) -> Regression:
    """``x_2 = beta_d y + n``: an effect of y, and so correlated with x_1, too.

    ``spurious [R, E]`` holds the beta_d. Costs are not separable.

    Raises:
        ValueError: fewer than two domains, a coefficient that is not finite.
    """
    power = causal**2 + 1
    ones = torch.ones_like(spurious)
    rows = [ones, causal * spurious, causal * spurious, power * spurious**2 + 1]
    gram = torch.stack(rows, dim=-1).unflatten(-1, (2, 2))
    moment = torch.stack([causal * ones, power * spurious], dim=-1)
    return Regression(gram, moment, power * ones)
