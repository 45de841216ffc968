"""A control problem with two weights, in which domains agree or disagree about one of them.

    s' = 0.99 s + u + w,        w ~ N(0, 1)
    o_1 = s + n_1,              n_1 ~ N(0, 1)             the same in every domain
    o_2 = beta_d s + n_2,       n_2 ~ N(0, 0.1^2)         means something else in each
    u = - k_1 o_1 - k_2 o_2,    J_d(k) = E[s^2 + u^2] in the stationary state

``o_2`` shows the state ten times as precisely as ``o_1``, but a controller that relies on it
works only where beta is what it was. The invariant controller has ``k_2 = 0``.
"""

from __future__ import annotations

from typing import Annotated

import torch
from scipy.optimize import minimize_scalar
from torch import Tensor

from ipo.checks import checked
from ipo.game import Cost

DECAY = 0.99
NOISE_1, NOISE_2 = 1.0, 0.1
EDGE = 0.01  # room to instability below which training sees a straight line instead of the cost


@checked
def stationary_cost(gains: Annotated[Tensor, "... 2"], beta: Annotated[Tensor, "..."]) -> Tensor:
    """``J(k) [...]`` of gains ``[..., 2]`` at ``beta [...]``; inf where the loop is unstable.

    f = k_1 + beta k_2,        v = 1 k_1^2 + 0.1^2 k_2^2        (variance of the input's noise)
    V = (1 + v) / (1 - (0.99 - f)^2)                            (variance of the state)
    J = V + f^2 V + v
    """
    feedback, noise, room = _loop(gains, beta)
    cost = (1 + noise) / room * (1 + feedback**2) + noise
    return torch.where(room > 0, cost, torch.inf)


def training_cost(gains: Tensor, beta: Tensor) -> Tensor:
    """The same where the loop is stable by a margin, and finite everywhere.

    Within ``EDGE`` of instability, and beyond, the tangent of ``1 / room`` takes its place: a
    learner that steps over the edge is pushed back instead of being stuck at infinity.
    """
    feedback, noise, room = _loop(gains, beta)
    inverse = torch.where(room > EDGE, 1 / room.clamp(min=EDGE), (2 - room / EDGE) / EDGE)
    return (1 + noise) * inverse * (1 + feedback**2) + noise


def _loop(gains: Tensor, beta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Feedback, variance of the input's noise, and ``1 - (0.99 - f)^2``, positive if stable."""
    k_1, k_2 = gains.unbind(-1)
    feedback = k_1 + beta * k_2
    noise = NOISE_1**2 * k_1**2 + NOISE_2**2 * k_2**2
    return feedback, noise, 1 - (DECAY - feedback) ** 2


@checked
def costs(betas: Annotated[Tensor, "R E"]) -> list[Cost]:
    """The training cost of every domain; ``betas [R, E]``.

    Raises:
        ValueError: a shape other than [problems, domains], a beta that is not finite.
    """

    def cost_at(beta: Tensor) -> Cost:
        return lambda gains: training_cost(gains, beta)

    return [cost_at(beta) for beta in betas.unbind(1)]


@checked
def unseen_cost(gains: Annotated[Tensor, "R 2"], betas: Annotated[Tensor, "B"]) -> Tensor:
    """Mean cost ``[R]`` of gains ``[R, 2]`` over ``betas [B]``; inf if one of them is unstable."""
    return stationary_cost(gains.unsqueeze(1), betas).mean(1)


def invariant_gains() -> Tensor:
    """The best controller ``[2]`` among those with ``k_2 = 0``; it costs the same everywhere."""

    def cost(k_1: float) -> float:
        return float(stationary_cost(torch.tensor([k_1, 0.0]).double(), torch.tensor(0.0).double()))

    best = minimize_scalar(cost, bounds=(0.0, 1.9), method="bounded", options={"xatol": 1e-12})
    return torch.tensor([best.x, 0.0], dtype=torch.float64)
