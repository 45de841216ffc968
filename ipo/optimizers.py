"""The optimisers that a player can be given, all behind one call: :func:`step`.

``adam`` is what the paper's runs use, ``plain`` is the gradient descent of its text, and
``lbfgs`` shows what a quasi-Newton method makes of the same costs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated

import torch
from torch import Tensor

from ipo.checks import NonNegative, Positive, checked, one_of

OPTIMIZERS = ("adam", "plain", "lbfgs")
Slope = tuple[Tensor, Sequence[Tensor]]  # costs [runs], and a gradient for each leaf


@checked
def make_optimizer(
    name: Annotated[str, one_of(OPTIMIZERS)],
    weights: Annotated[Sequence[Tensor], "leaves"],
    learning_rate: Positive,
    weight_decay: NonNegative = 0.0,
) -> torch.optim.Optimizer:
    """An optimiser for leaves ``[runs, ...]``.

    Adam and plain steps act on each number or each run alone, so runs never mix. L-BFGS
    builds one curvature model of all the numbers it is given: give it one run at a time.

    Raises:
        ValueError: an unknown name, a learning rate that is not positive, a negative decay.
    """
    if name == "adam":  # decoupled decay (AdamW); with weight_decay = 0 it is Adam itself
        return torch.optim.AdamW(weights, learning_rate, weight_decay=weight_decay, fused=True)
    if name == "plain":
        return torch.optim.SGD(weights, learning_rate, weight_decay=weight_decay)
    return torch.optim.LBFGS(
        weights, learning_rate, max_iter=1, max_eval=25, line_search_fn="strong_wolfe"
    )


def descend(
    optimizer: torch.optim.Optimizer,
    objective: Callable[[], Tensor],
    max_gradient_norm: float | None = None,
) -> None:
    """One step down ``objective() -> [runs]``, for all runs at once, differentiated by autograd.

    Only the optimiser's own leaves are differentiated, so nobody else moves and no time is
    spent on gradients that are not used.
    """
    leaves = _leaves(optimizer)
    step(
        optimizer,
        differentiate(objective(), leaves),
        lambda: differentiate(objective(), leaves),
        max_gradient_norm,
    )


def differentiate(costs: Tensor, leaves: Sequence[Tensor], share: float = 1.0) -> Slope:
    """Costs ``[runs]`` and ``share`` times their gradient in leaves ``[runs, ...]``, by autograd.

    A run whose cost is infinite has no way down: its gradient is 0.
    """
    # The runs do not interact: the gradient of their sum holds the gradient of each.
    gradients = torch.autograd.grad(share * costs.sum(), leaves)
    lost = costs.detach().isinf()
    return costs.detach(), [
        gradient.masked_fill(lost.view(-1, *[1] * (gradient.dim() - 1)), 0.0)
        for gradient in gradients
    ]


def step(
    optimizer: torch.optim.Optimizer,
    first: Slope,
    again: Callable[[], Slope],
    max_gradient_norm: float | None = None,
) -> None:
    """One step down costs whose slope where the leaves are is known.

    ``again()`` is the slope where they are then: L-BFGS tries several weights in a step.
    ``max_gradient_norm`` bounds the norm of each leaf's gradient, run by run.
    """
    leaves, known = _leaves(optimizer), [first]

    def closure() -> float:
        costs, gradients = known.pop() if known else again()
        for leaf, gradient in zip(leaves, gradients, strict=True):
            leaf.grad = clip_gradient(gradient, max_gradient_norm)
        return float(costs.sum())

    optimizer.step(closure)
    for leaf in leaves:
        leaf.grad = None  # the next gradient takes its memory, which is still in the cache


def _leaves(optimizer: torch.optim.Optimizer) -> list[Tensor]:
    return [leaf for group in optimizer.param_groups for leaf in group["params"]]


def clip_gradient(gradient: Tensor, max_norm: float | None) -> Tensor:
    """A gradient ``[runs, ...]``, scaled so that its norm is at most ``max_norm`` in each run."""
    if max_norm is None:
        return gradient
    dims = tuple(range(1, gradient.dim()))
    norm = torch.linalg.vector_norm(gradient, dim=dims, keepdim=True)
    return gradient * (max_norm / norm).clamp(max=1.0)
