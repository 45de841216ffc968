"""Invariant causal prediction: the features that predict in the same way in all domains.

Source: Peters, Bühlmann and Meinshausen (2016).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated

import numpy as np
import scipy.stats
import torch
from torch import Tensor

from ipo.causality.predictors import check_domains
from ipo.checks import check_count, check_number, checked


@dataclass(frozen=True)
class ICPResult:
    """What invariant causal prediction finds.

    Attributes:
        p_values: of the hypothesis that a set of features is invariant, by set.
        accepted: the sets that were not rejected.
        estimate: features in all of them; ``None`` where none was accepted: the model is wrong.
        coefficients: ``[d]``, pooled least squares on the estimate, zero elsewhere.
    """

    p_values: dict[tuple[int, ...], float]
    accepted: list[tuple[int, ...]]
    estimate: tuple[int, ...] | None
    coefficients: np.ndarray


@checked
def icp(
    features: Sequence[Tensor],
    targets: Sequence[Tensor],
    alpha: Annotated[float, partial(check_number, above=0, below=1)] = 0.05,
) -> ICPResult:
    """Invariant causal prediction for one run: ``[N_e, d]`` and ``[N_e]`` for every domain.

    A set S is accepted if the residuals of one pooled regression on S have the same mean and
    variance in all domains, by a t-test and an F-test of each domain against the others, with
    Bonferroni's correction for the 2 (E - 1) of them. The causes are in every accepted set, with
    probability at least 1 - alpha, so the estimate is

        S = intersection of all S that are accepted at level alpha.

    Source: Peters, Bühlmann and Meinshausen (2016), Section 3.1.2.

    Raises:
        ValueError: see :func:`ipo.causality.predictors.check_domains`; also for a level outside
            (0, 1), a single domain, a single sample of one, and features of which one is constant
            or a sum of others.
    """
    check_domains([x.unsqueeze(0) for x in features], [y.unsqueeze(0) for y in targets])
    check_count("features: number of domains", len(features), minimum=2)
    check_count("features: samples of a domain", min(map(len, features)), minimum=2)
    dim = features[0].shape[1]
    pooled = torch.cat(list(features)).double()
    if torch.linalg.matrix_rank(torch.column_stack([pooled, torch.ones(len(pooled))])) <= dim:
        raise ValueError(
            f"features: with a constant, {dim} have a smaller rank, must be independent"
        )

    # Columns: the features, the target, and ones; their products tell all that is needed.
    tables = [
        torch.column_stack([x, y, torch.ones_like(y)]).double().numpy()
        for x, y in zip(features, targets, strict=True)
    ]
    products = np.stack([table.T @ table for table in tables])
    sets = [S for size in range(dim + 1) for S in itertools.combinations(range(dim), size)]
    fits = np.stack([_pooled_fit(products.sum(0), S) for S in sets])  # [sets, d + 2]
    p_values = _same_mean_and_variance(fits, products)
    accepted = [S for S, p in zip(sets, p_values, strict=True) if p > alpha]
    estimate = tuple(sorted(set.intersection(*map(set, accepted)))) if accepted else None
    coefficients = -_pooled_fit(products.sum(0), estimate)[:dim] if estimate else np.zeros(dim)
    return ICPResult(
        dict(zip(sets, map(float, p_values), strict=True)), accepted, estimate, coefficients
    )


def _pooled_fit(product: np.ndarray, chosen: tuple[int, ...]) -> np.ndarray:
    """``r [d + 2]`` such that ``table @ r`` are the residuals of a regression on ``chosen``."""
    target = len(product) - 2
    columns = [*chosen, target + 1]
    fit = np.zeros(len(product))
    fit[columns] = -np.linalg.solve(product[np.ix_(columns, columns)], product[columns, target])
    fit[target] = 1
    return fit


def _same_mean_and_variance(fits: np.ndarray, products: np.ndarray) -> np.ndarray:
    """p-value of each fit: smallest of all tests of a domain against the others, corrected."""
    ones = products[:, -1, -1]  # samples of each domain
    sums = fits @ products[:, -1].T  # [sets, E]
    squares = np.einsum("si,eij,sj->se", fits, products, fits)

    def mean_and_variance(
        n: np.ndarray, total: np.ndarray, square: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return n, total / n, (square - total**2 / n) / (n - 1)

    n, mean, variance = mean_and_variance(ones, sums, squares)
    m, others_mean, others_variance = mean_and_variance(
        ones.sum() - ones,
        sums.sum(1, keepdims=True) - sums,
        squares.sum(1, keepdims=True) - squares,
    )
    same_mean = scipy.stats.ttest_ind_from_stats(
        mean, np.sqrt(variance), n, others_mean, np.sqrt(others_variance), m, equal_var=False
    ).pvalue
    ratio = scipy.stats.f(n - 1, m - 1)
    below, above = ratio.cdf(variance / others_variance), ratio.sf(variance / others_variance)
    smallest = np.minimum(same_mean, 2 * np.minimum(below, above)).min(1)
    return np.minimum(1, 2 * (len(products) - 1) * smallest)
