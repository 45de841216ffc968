"""Prediction that is to hold in domains not trained on: ERM, ICP, IRMv1, V-REx and IRM-Games.

A predictor is linear, ``f(x) = v . x``, with coefficients ``v [R, d]``: R runs are trained at
once. What a domain makes of it comes from a *task*, which gives

    risks(v) [R, E],        R_e(v) = E_e[loss(v . x, y)],
    gradients(v) [R, E, d], their derivatives by v,

for E domains. The methods need nothing else, so they are the same for regression and for
classification. Only ICP looks at samples.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.stats
import torch
from torch import Tensor

from ipo.checks import check_count, check_number
from ipo.game import average, best_response_round, new_players, split_players
from ipo.optimizers import descend, make_optimizer


class Task(Protocol):
    """Domains in which a linear predictor is judged."""

    shape: tuple[int, int, int]  # runs R, domains E, features d
    dtype: torch.dtype

    def risks(self, v: Tensor) -> Tensor: ...

    def gradients(self, v: Tensor) -> Tensor: ...

    def domain(self, e: int) -> Task: ...


@dataclass(frozen=True)
class Regression:
    """Squared error, of which second moments tell everything.

        R_e(v) = v' A_e v - 2 b_e' v + c_e,    A_e = E[x x'], b_e = E[x y], c_e = E[y^2]

    Attributes:
        A: ``[R, E, d, d]``.
        b: ``[R, E, d]``.
        c: ``[R, E]``.
    """

    A: Tensor
    b: Tensor
    c: Tensor

    @classmethod
    def from_samples(cls, features: Sequence[Tensor], targets: Sequence[Tensor]) -> Regression:
        """From ``[R, N_e, d]`` and ``[R, N_e]`` for every domain; see :func:`check_domains`."""
        check_domains(features, targets)
        pairs = list(zip(features, targets, strict=True))
        return cls(
            A=torch.stack([x.mT @ x / x.shape[1] for x, _ in pairs], 1),
            b=torch.stack([(x * y.unsqueeze(-1)).mean(1) for x, y in pairs], 1),
            c=torch.stack([y.square().mean(1) for _, y in pairs], 1),
        )

    @property
    def shape(self) -> tuple[int, int, int]:
        return tuple(self.b.shape)

    @property
    def dtype(self) -> torch.dtype:
        return self.b.dtype

    def risks(self, v: Tensor) -> Tensor:
        v = v.unsqueeze(1)
        return ((self.A @ v.unsqueeze(-1)).squeeze(-1) * v - 2 * self.b * v).sum(-1) + self.c

    def gradients(self, v: Tensor) -> Tensor:
        return 2 * ((self.A @ v[:, None, :, None]).squeeze(-1) - self.b)

    def domain(self, e: int) -> Regression:
        return Regression(self.A[:, e : e + 1], self.b[:, e : e + 1], self.c[:, e : e + 1])


@dataclass(frozen=True)
class Classification:
    """Logistic loss for labels 0 and 1: ``R_e(v) = E[log(1 + exp(f)) - y f]``, ``f = v . x``.

    Attributes:
        features: ``[R, N_e, d]`` for every domain.
        targets: ``[R, N_e]`` for every domain.
    """

    features: Sequence[Tensor]
    targets: Sequence[Tensor]

    def __post_init__(self) -> None:
        check_domains(self.features, self.targets)

    @property
    def shape(self) -> tuple[int, int, int]:
        return self.features[0].shape[0], len(self.features), self.features[0].shape[2]

    @property
    def dtype(self) -> torch.dtype:
        return self.features[0].dtype

    def _outputs(self, v: Tensor) -> list[tuple[Tensor, Tensor, Tensor]]:
        """Features, targets and outputs ``[R, N_e]`` of every domain."""
        pairs = zip(self.features, self.targets, strict=True)
        return [(x, y, (x @ v.unsqueeze(-1)).squeeze(-1)) for x, y in pairs]

    def risks(self, v: Tensor) -> Tensor:
        losses = [torch.nn.functional.softplus(f) - y * f for _, y, f in self._outputs(v)]
        return torch.stack([loss.mean(1) for loss in losses], 1)

    def gradients(self, v: Tensor) -> Tensor:
        slopes = [(x, (f.sigmoid() - y) / y.shape[1]) for x, y, f in self._outputs(v)]
        return torch.stack([(x.mT @ s.unsqueeze(-1)).squeeze(-1) for x, s in slopes], 1)

    def errors(self, v: Tensor) -> Tensor:
        """Share of wrong labels ``[R, E]``."""
        wrong = [((f > 0) != (y > 0.5)).double().mean(1) for _, y, f in self._outputs(v)]
        return torch.stack(wrong, 1)

    def domain(self, e: int) -> Classification:
        return Classification(self.features[e : e + 1], self.targets[e : e + 1])


@dataclass(frozen=True)
class Settings:
    """How a method is trained, with Adam on all samples at once.

    Attributes:
        penalty: weight of the invariance penalty of IRMv1 and V-REx.
        num_features: k, the width of Phi in IRMv1 and in the game with variable Phi.
        ridge: weight of ``|v|^2``, added to the risk of every domain.
        learning_rate: of Adam.
        num_iterations: steps, or rounds of all players.
        bound: largest absolute value of a player's coefficients; ``None``: no bound.
    """

    penalty: float = 0.0
    num_features: int = 1
    ridge: float = 0.0
    learning_rate: float = 0.01
    num_iterations: int = 5000
    bound: float | None = None

    def __post_init__(self) -> None:
        check_number("penalty", self.penalty, least=0)
        check_count("num_features", self.num_features)
        check_number("ridge", self.ridge, least=0)
        check_number("learning_rate", self.learning_rate, above=0)
        check_count("num_iterations", self.num_iterations, minimum=0)
        if self.bound is not None:
            check_number("bound", self.bound, above=0)


# ------------------------------------------------------------------- risk with a penalty


def erm(task: Task, settings: Settings) -> Tensor:
    """Empirical risk minimisation: the predictor that is best on all data together.

    min_v  (1 / E) sum_e R_e(v)
    """
    v = _zeros(task)
    return _minimize(lambda: _objective(task, settings, v).mean(1), v, settings)


def irmv1(task: Task, settings: Settings) -> Tensor:
    """Invariant risk minimisation, first version, for ``v = Phi w`` with w fixed at ones.

        min_Phi  (1 / E) sum_e [ R_e(Phi 1) + penalty * |d/dw R_e(Phi w) at w = 1|^2 / k ]

    The derivative is ``Phi' grad R_e(Phi 1)``. With k = 1 it is one number in each domain, as in
    the published experiment with images; k = d is the published experiment with linear data.

    Source: Arjovsky et al. (2019), equation (IRMv1).
    """
    Phi = _start(task, settings)

    def objective() -> Tensor:
        v = Phi.sum(-1)
        risks = _objective(task, settings, v)
        return (risks + settings.penalty * irm_penalties(task, Phi)).mean(1)

    _minimize(objective, Phi, settings)
    return Phi.detach().sum(-1)


def irm_penalties(task: Task, Phi: Tensor) -> Tensor:
    """Squared derivative ``[R, E]`` of each domain's risk by the classifier above Phi, over k."""
    return (task.gradients(Phi.sum(-1)) @ Phi).square().mean(-1)


def vrex(task: Task, settings: Settings) -> Tensor:
    """Risk extrapolation: the risks are to be low, and equal.

        min_v  (1 / E) sum_e R_e(v) + penalty * Var_e R_e(v)

    Source: Krueger et al. (2021), equation (V-REx).
    """
    v = _zeros(task)

    def objective() -> Tensor:
        risks = _objective(task, settings, v)
        return risks.mean(1) + settings.penalty * risks.var(1, correction=0)

    return _minimize(objective, v, settings)


# ----------------------------------------------------------------------------- the game


def irm_game_fixed_phi(task: Task, settings: Settings) -> Tensor:
    """IRM-Games with Phi = identity: a predictor for each domain, and their average acts.

        player e:  min_{v_e}  R_e((1 / E) sum_e v_e)

    Source: Ahuja et al. (2020), F-IRM; the bound is the one of Ahuja et al. (2021).
    """
    play = _Players(task, settings)
    for _ in range(settings.num_iterations):
        play.round(lambda w: w)
    return play.policy.detach()


def irm_game_variable_phi(task: Task, settings: Settings) -> Tensor:
    """The same above a shared ``Phi [R, d, k]``, which moves first, on the pooled risk.

        Phi:       min_Phi    (1 / E) sum_e R_e(Phi w_av)
        player e:  min_{w_e}  R_e(Phi w_av),    w_av = (1 / E) sum_e w_e

    Source: Ahuja et al. (2020), V-IRM.
    """
    Phi = _start(task, settings)
    play = _Players(task, settings)
    optimizer = make_optimizer("adam", [Phi], settings.learning_rate)

    def predictor(w: Tensor, Phi: Tensor) -> Tensor:
        return (Phi @ w.unsqueeze(-1)).squeeze(-1)

    for _ in range(settings.num_iterations):
        descend(
            optimizer,
            lambda: _objective(task, settings, predictor(play.policy, Phi)).mean(1),
        )
        play.round(lambda w: predictor(w, Phi.detach()))
    return predictor(play.policy, Phi).detach()


class _Players:
    """A player for each domain, all starting at zero, each with an Adam of its own."""

    def __init__(self, task: Task, settings: Settings) -> None:
        num_runs, num_domains, dim = task.shape
        check_count("number of domains", num_domains, minimum=2)
        size = dim if settings.num_features == 1 else settings.num_features
        self.settings = settings
        self.domains = [task.domain(e) for e in range(num_domains)]
        weights = new_players(num_runs, num_domains, [size], dtype=task.dtype)
        self.players, self.policy = split_players(weights), average(weights)
        self.optimizers = [
            make_optimizer("adam", [player], settings.learning_rate) for player in self.players
        ]

    def round(self, predictor: Callable[[Tensor], Tensor]) -> None:
        """Every player moves once; ``predictor`` makes coefficients of the average."""

        def respond(e: int, policy_of_e: Callable[[], Tensor]) -> None:
            descend(
                self.optimizers[e],
                lambda: _objective(
                    self.domains[e], self.settings, predictor(policy_of_e())
                ).squeeze(1),
            )
            if self.settings.bound is not None:
                self.players[e].data.clamp_(-self.settings.bound, self.settings.bound)

        best_response_round(self.players, self.policy, respond)


def _objective(task: Task, settings: Settings, v: Tensor) -> Tensor:
    return task.risks(v) + settings.ridge * v.square().sum(-1, keepdim=True)


def _zeros(task: Task) -> Tensor:
    num_runs, _, dim = task.shape
    return torch.zeros(num_runs, dim, dtype=task.dtype, requires_grad=True)


def _start(task: Task, settings: Settings) -> Tensor:
    """``Phi [R, d, k]``: the identity, or for k = 1 the predictor that ERM ends with."""
    num_runs, _, dim = task.shape
    if settings.num_features == 1:
        return erm(task, settings).unsqueeze(-1).requires_grad_()
    Phi = torch.eye(dim, settings.num_features, dtype=task.dtype)
    return Phi.repeat(num_runs, 1, 1).requires_grad_()


def _minimize(objective: Callable[[], Tensor], weights: Tensor, settings: Settings) -> Tensor:
    """Adam on ``objective() -> [R]``; its learning rate falls to zero, so that it settles.

    Dividing by the penalty's weight changes nothing but how close Adam's small constant is.
    """
    optimizer = make_optimizer("adam", [weights], settings.learning_rate)
    for iteration in range(settings.num_iterations):
        rest = 1 - iteration / settings.num_iterations
        optimizer.param_groups[0]["lr"] = settings.learning_rate * rest
        descend(optimizer, lambda: objective() / (1 + settings.penalty))
    return weights.detach()


METHODS = {
    method.__name__: method
    for method in (erm, irmv1, vrex, irm_game_fixed_phi, irm_game_variable_phi)
}


# ---------------------------------------------------------------- invariant causal prediction


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


def icp(features: Sequence[Tensor], targets: Sequence[Tensor], alpha: float = 0.05) -> ICPResult:
    """Invariant causal prediction for one run: ``[N_e, d]`` and ``[N_e]`` for every domain.

    A set S is accepted if the residuals of one pooled regression on S have the same mean and
    variance in all domains, by a t-test and an F-test of each domain against the others, with
    Bonferroni's correction for the 2 (E - 1) of them. The causes are in every accepted set, with
    probability at least 1 - alpha, so the estimate is

        S = intersection of all S that are accepted at level alpha.

    Source: Peters, Bühlmann and Meinshausen (2016), Section 3.1.2.

    Raises:
        ValueError: see :func:`check_domains`; also for a level outside (0, 1), for a single
            domain, and for a feature that is constant in all of them.
    """
    check_number("alpha", alpha, above=0)
    if alpha >= 1:
        raise ValueError(f"alpha = {alpha}: must be below 1")
    check_domains([x.unsqueeze(0) for x in features], [y.unsqueeze(0) for y in targets])
    check_count("number of domains", len(features), minimum=2)
    dim = features[0].shape[1]
    pooled = torch.cat(list(features))
    for j in range(dim):
        if bool((pooled[:, j] == pooled[0, j]).all()):
            raise ValueError(f"feature {j} = {float(pooled[0, j])}: must not be constant")

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

    def mean_and_variance(n, total, square):
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


def check_domains(features: Sequence[Tensor], targets: Sequence[Tensor]) -> None:
    """Features ``[R, N_e, d]`` and targets ``[R, N_e]`` of domains that fit together.

    Raises:
        ValueError: no domain, no samples, shapes that do not fit, numbers that are not finite.
    """
    if not features:
        raise ValueError("features = []: must hold at least 1 domain")
    if len(features) != len(targets):
        raise ValueError(f"targets: of {len(targets)} domains, must be of {len(features)}")
    for e, (x, y) in enumerate(zip(features, targets, strict=True)):
        if x.shape[-1] != features[0].shape[-1]:
            raise ValueError(
                f"features[{e}]: has {x.shape[-1]} features, must have "
                f"{features[0].shape[-1]} as in domain 0"
            )
        if x.shape[:-1] != y.shape:
            raise ValueError(
                f"targets[{e}]: has shape {tuple(y.shape)}, must have {tuple(x.shape[:-1])}"
            )
        if x.shape[-2] == 0:
            raise ValueError(f"features[{e}]: has 0 samples, must have at least 1")
        for name, values in (("features", x), ("targets", y)):
            if not bool(torch.isfinite(values).all()):
                raise ValueError(f"{name}[{e}]: holds NaN or infinite values, must be finite")
