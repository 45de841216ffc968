"""Linear regression as a game: a causal feature, a spurious one, and a player for each domain.

    y = c x_1 + e,        x_1, e ~ N(0, 1) independent,        J_d(w) = E (y - w_1 x_1 - w_2 x_2)^2

``x_2`` is related to y differently in every domain, so ``w = (c, 0)`` is the invariant predictor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ipo.causality.vector_game import Cost
from ipo.checks import check_number


@dataclass(frozen=True)
class Regression:
    """What least squares needs to know of R problems with E domains and P features.

    Attributes:
        gram: ``E[x x'] [R, E, P, P]``.
        moment: ``E[x y] [R, E, P]``.
        power: ``E[y^2] [R, E]``.
    """

    gram: Tensor
    moment: Tensor
    power: Tensor

    @property
    def costs(self) -> list[Cost]:
        """``J_d(w) = E[y^2] - 2 w' E[x y] + w' E[x x'] w`` of every domain."""

        def cost_of(d: int) -> Cost:
            def cost(w: Tensor) -> Tensor:
                bent = torch.einsum("rp,rpq,rq->r", w, self.gram[:, d], w)
                return self.power[:, d] - 2 * (w * self.moment[:, d]).sum(-1) + bent

            return cost

        return [cost_of(d) for d in range(self.gram.shape[1])]

    @property
    def optima(self) -> Tensor:
        """Each domain's own least squares ``[R, E, P]``."""
        return torch.linalg.solve(self.gram, self.moment)

    def pooled(self, shares: Sequence[float] | None = None) -> Tensor:
        """Least squares on the data of all domains ``[R, P]``, with each one's share of the data.

        Shares are equal if none are given.

        Raises:
            ValueError: not one share for each domain, a share that is not positive.
        """
        num = self.gram.shape[1]
        shares = [1.0] * num if shares is None else list(shares)
        if len(shares) != num:
            raise ValueError(f"shares = {shares}: must be {num} numbers, one for each domain")
        for d, share in enumerate(shares):
            check_number(f"shares[{d}]", share, above=0)
        weights = torch.tensor(shares, dtype=self.gram.dtype)
        gram = torch.einsum("e,repq->rpq", weights, self.gram)
        return torch.linalg.solve(gram, torch.einsum("e,rep->rp", weights, self.moment))


def correlated_noise(spurious: Tensor, causal: float = 1.0) -> Regression:
    """``x_2 = rho_d e + sqrt(1 - rho_d^2) n``: related to the noise of y, uncorrelated with x_1.

    Features have variance 1, so costs are separable and a domain's own optimum is
    ``(c, rho_d)``. ``spurious [R, E]`` holds the rho_d.

    Raises:
        ValueError: fewer than two domains, a coefficient that is NaN or outside [-1, 1].
    """
    _check_spurious(spurious)
    if bool((spurious.abs() > 1).any()):
        raise ValueError(f"spurious: holds {spurious.abs().max():.3g}, must be within [-1, 1]")
    gram = torch.eye(2, dtype=spurious.dtype).expand(*spurious.shape, 2, 2)
    moment = torch.stack([torch.full_like(spurious, causal), spurious], dim=-1)
    return Regression(gram, moment, torch.full_like(spurious, causal**2 + 1))


def effect_of_target(spurious: Tensor, causal: float = 1.0) -> Regression:
    """``x_2 = beta_d y + n``: an effect of y, and so correlated with x_1, too.

    ``spurious [R, E]`` holds the beta_d. Costs are not separable.

    Raises:
        ValueError: fewer than two domains, a coefficient that is not finite.
    """
    _check_spurious(spurious)
    power = causal**2 + 1
    ones = torch.ones_like(spurious)
    rows = [ones, causal * spurious, causal * spurious, power * spurious**2 + 1]
    gram = torch.stack(rows, dim=-1).unflatten(-1, (2, 2))
    moment = torch.stack([causal * ones, power * spurious], dim=-1)
    return Regression(gram, moment, power * ones)


def irm_v1(problem: Regression, penalty_weight: float) -> Cost:
    """The objective of IRMv1 for a linear predictor w, ``[R]`` (Arjovsky et al., 2019):

    mean over d of J_d(w) + lambda (d/ds J_d(s w) at s = 1)^2
    """
    check_number("penalty_weight", penalty_weight, least=0)

    def objective(w: Tensor) -> Tensor:
        bent = torch.einsum("rp,repq,rq->re", w, problem.gram, w)
        straight = (w.unsqueeze(1) * problem.moment).sum(-1)
        risk = problem.power - 2 * straight + bent
        slope = 2 * (bent - straight)
        return (risk + penalty_weight * slope**2).mean(1)

    return objective


def _check_spurious(spurious: Tensor) -> None:
    if spurious.dim() != 2 or spurious.shape[1] < 2:
        raise ValueError(
            f"spurious: has shape {tuple(spurious.shape)}, must be [problems, domains] "
            "with at least 2 domains"
        )
    if not bool(torch.isfinite(spurious).all()):
        raise ValueError("spurious: holds NaN or infinite coefficients, must be finite")
