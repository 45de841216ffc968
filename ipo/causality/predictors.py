"""Prediction that is to hold in domains not trained on: ERM, IRMv1, V-REx and IRM-Games.

A predictor is linear, ``f(x) = v . x``, with coefficients ``v [R, d]``: R runs are trained at
once. What a domain makes of it comes from a *task*, which gives

    risks(v) [R, E],        R_e(v) = E_e[loss(v . x, y)],
    gradients(v) [R, E, d], their derivatives by v,

for E domains. The methods need nothing else, so they are the same for regression and for
classification.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from ipo.checks import Count, Natural, NonNegative, Positive, check_array, check_count, checked
from ipo.game import Cost, LinearPlayers
from ipo.optimizers import descend, make_optimizer


@runtime_checkable
class Task(Protocol):
    """Domains in which a linear predictor is judged."""

    @property
    def shape(self) -> tuple[int, int, int]: ...  # runs R, domains E, features d

    @property
    def dtype(self) -> torch.dtype: ...

    def risks(self, v: Tensor) -> Tensor: ...

    def gradients(self, v: Tensor) -> Tensor: ...

    def domain(self, e: int) -> Task: ...


@checked
@dataclass(frozen=True)
class Regression:
    """Squared error, of which second moments tell everything.

        R_e(v) = v' E[x x'] v - 2 v' E[x y] + E[y^2]

    Attributes:
        gram: ``E[x x'] [R, E, d, d]``.
        moment: ``E[x y] [R, E, d]``.
        power: ``E[y^2] [R, E]``.
    """

    gram: Annotated[Tensor, "R E d d"]
    moment: Annotated[Tensor, "R E d"]
    power: Annotated[Tensor, "R E"]

    @classmethod
    def from_samples(cls, features: Sequence[Tensor], targets: Sequence[Tensor]) -> Regression:
        """From ``[R, N_e, d]`` and ``[R, N_e]`` for every domain; see :func:`check_domains`."""
        check_domains(features, targets)
        pairs = list(zip(features, targets, strict=True))
        return cls(
            gram=torch.stack([x.mT @ x / x.shape[1] for x, _ in pairs], 1),
            moment=torch.stack([(x * y.unsqueeze(-1)).mean(1) for x, y in pairs], 1),
            power=torch.stack([y.square().mean(1) for _, y in pairs], 1),
        )

    @property
    def shape(self) -> tuple[int, int, int]:
        num_runs, num_domains, dim = self.moment.shape
        return num_runs, num_domains, dim

    @property
    def dtype(self) -> torch.dtype:
        return self.moment.dtype

    @property
    def sizes(self) -> dict[str, Any]:
        return dict(zip(("R", "E", "d"), self.shape, strict=True))

    def risks(self, v: Tensor) -> Tensor:
        v = v.unsqueeze(1)
        image = (self.gram @ v.unsqueeze(-1)).squeeze(-1)
        return (image * v - 2 * self.moment * v).sum(-1) + self.power

    def gradients(self, v: Tensor) -> Tensor:
        return 2 * ((self.gram @ v[:, None, :, None]).squeeze(-1) - self.moment)

    @checked
    def domain(self, e: Natural) -> Regression:
        check_count("e", e, 0, self.shape[1] - 1)
        return Regression(*(part[:, e : e + 1] for part in (self.gram, self.moment, self.power)))

    @property
    def costs(self) -> list[Cost]:
        """The risk ``[R]`` of every domain as a function of its own."""
        return [_cost_in(self.domain(e)) for e in range(self.shape[1])]

    @property
    def optima(self) -> Tensor:
        """Each domain's own least squares ``[R, E, d]``."""
        return torch.linalg.solve(self.gram, self.moment)

    @checked
    def pooled(self, shares: Annotated[Sequence[Positive], "E"] | None = None) -> Tensor:
        """Least squares on the data of all domains ``[R, d]``, with each one's share of the data.

        Shares are equal if none are given.

        Raises:
            ValueError: not one share for each domain, a share that is not positive.
        """
        weights = torch.tensor(shares or [1.0] * self.shape[1], dtype=self.dtype)
        gram = torch.einsum("e,repq->rpq", weights, self.gram)
        return torch.linalg.solve(gram, torch.einsum("e,rep->rp", weights, self.moment))


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
        for e, y in enumerate(self.targets):
            if bool(((y != 0) & (y != 1)).any()):
                raise ValueError(f"targets[{e}]: holds other labels, must hold 0 and 1")

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

    @checked
    def domain(self, e: Natural) -> Classification:
        check_count("e", e, 0, self.shape[1] - 1)
        return Classification(self.features[e : e + 1], self.targets[e : e + 1])


@checked
@dataclass(frozen=True)
class PredictorSettings:
    """How a method is trained, with Adam on all samples at once.

    Attributes:
        penalty: weight of the invariance penalty of IRMv1 and V-REx.
        num_features: k, the width of Phi in IRMv1 and in the game with variable Phi.
        ridge: weight of ``|v|^2``, added to the risk of every domain.
        learning_rate: of Adam.
        num_iterations: steps, or rounds of all players.
        bound: largest absolute value of a player's coefficients; ``None``: no bound.
    """

    penalty: NonNegative = 0.0
    num_features: Count = 1
    ridge: NonNegative = 0.0
    learning_rate: Positive = 0.01
    num_iterations: Natural = 5000
    bound: Positive | None = None


# ------------------------------------------------------------------- risk with a penalty


@checked
def erm(task: Task, settings: PredictorSettings) -> Tensor:
    """Empirical risk minimisation: the predictor that is best on all data together.

    min_v  (1 / E) sum_e R_e(v)
    """
    v = _zeros(task)
    return _minimize(lambda: _objective(task, settings.ridge, v).mean(1), v, settings)


@checked
def irmv1(task: Task, settings: PredictorSettings) -> Tensor:
    """Invariant risk minimisation, first version, for ``v = Phi w`` with w fixed at ones::

        min_Phi  (1 / E) sum_e [ R_e(Phi 1) + penalty * |d/dw R_e(Phi w) at w = 1|^2 / k ]

    The derivative is ``Phi' grad R_e(Phi 1)``. With k = 1 it is one number in each domain, as in
    the published experiment with images; k = d is the published experiment with linear data.

    Source: Arjovsky et al. (2019), equation (IRMv1).
    """
    Phi = _start(task, settings)
    _minimize(lambda: irm_objective(task, settings, Phi), Phi, settings)
    return Phi.detach().sum(-1)


def irm_objective(task: Task, settings: PredictorSettings, Phi: Tensor) -> Tensor:
    """What :func:`irmv1` minimises, ``[R]``, for ``Phi [R, d, k]``."""
    risks = _objective(task, settings.ridge, Phi.sum(-1))
    return (risks + settings.penalty * irm_penalties(task, Phi)).mean(1)


def irm_penalties(task: Task, Phi: Tensor) -> Tensor:
    """Squared derivative ``[R, E]`` of each domain's risk by the classifier above Phi, over k."""
    return (task.gradients(Phi.sum(-1)) @ Phi).square().mean(-1)


@checked
def vrex(task: Task, settings: PredictorSettings) -> Tensor:
    """Risk extrapolation: the risks are to be low, and equal.

        min_v  (1 / E) sum_e R_e(v) + penalty * Var_e R_e(v)

    Source: Krueger et al. (2021), equation (V-REx).
    """
    v = _zeros(task)

    def objective() -> Tensor:
        risks = _objective(task, settings.ridge, v)
        return risks.mean(1) + settings.penalty * risks.var(1, correction=0)

    return _minimize(objective, v, settings)


# ----------------------------------------------------------------------------- the game


@checked
def irm_game_fixed_phi(task: Task, settings: PredictorSettings) -> Tensor:
    """IRM-Games with Phi = identity: a predictor for each domain, and their average acts.

        player e:  min_{v_e}  R_e((1 / E) sum_e v_e)

    Source: Ahuja et al. (2020), F-IRM; the bound is the one of Ahuja et al. (2021).
    """
    players = _players(task, settings, dim=task.shape[2])
    costs = _domain_costs(task, settings)
    for _ in range(settings.num_iterations):
        players.round(costs)
    return players.policy


@checked
def irm_game_variable_phi(task: Task, settings: PredictorSettings) -> Tensor:
    """The same above a shared ``Phi [R, d, k]``, which moves first, on the pooled risk.

        Phi:       min_Phi    (1 / E) sum_e R_e(Phi w_av)
        player e:  min_{w_e}  R_e(Phi w_av),    w_av = (1 / E) sum_e w_e

    Source: Ahuja et al. (2020), V-IRM.
    """
    Phi = _start(task, settings)
    players = _players(task, settings, dim=settings.num_features)
    optimizer = make_optimizer("adam", [Phi], settings.learning_rate)

    def predictor(w: Tensor, Phi: Tensor) -> Tensor:
        return (Phi @ w.unsqueeze(-1)).squeeze(-1)

    def move_phi() -> None:
        descend(
            optimizer,
            lambda: _objective(task, settings.ridge, predictor(players.policy, Phi)).mean(1),
        )

    def above_phi(cost: Cost) -> Cost:
        return lambda w: cost(predictor(w, Phi.detach()))

    costs = [above_phi(cost) for cost in _domain_costs(task, settings)]
    for _ in range(settings.num_iterations):
        players.round(costs, move_phi=move_phi)
    return predictor(players.policy, Phi).detach()


def _players(task: Task, settings: PredictorSettings, dim: int) -> LinearPlayers:
    """A player for each domain, all starting at zero, each with an Adam of its own."""
    num_runs, num_domains, _ = task.shape
    check_count("task: number of domains", num_domains, minimum=2)
    return LinearPlayers(
        torch.zeros(num_runs, num_domains, dim, dtype=task.dtype),
        lambda weights: make_optimizer("adam", weights, settings.learning_rate),
        settings.bound,
    )


def _domain_costs(task: Task, settings: PredictorSettings) -> list[Cost]:
    """What each domain's player wants low."""
    return [_cost_in(task.domain(e), settings.ridge) for e in range(task.shape[1])]


def _cost_in(domain: Task, ridge: float = 0.0) -> Cost:
    """``cost(v) [R]`` of one domain."""
    return lambda v: _objective(domain, ridge, v).squeeze(1)


def _objective(task: Task, ridge: float, v: Tensor) -> Tensor:
    risks = task.risks(v)
    return risks + ridge * v.square().sum(-1, keepdim=True) if ridge else risks


def _zeros(task: Task) -> Tensor:
    num_runs, _, dim = task.shape
    return torch.zeros(num_runs, dim, dtype=task.dtype, requires_grad=True)


def _start(task: Task, settings: PredictorSettings) -> Tensor:
    """``Phi [R, d, k]``: the identity, or for k = 1 the predictor that ERM ends with."""
    num_runs, _, dim = task.shape
    if settings.num_features == 1:
        return erm(task, settings).unsqueeze(-1).requires_grad_()
    Phi = torch.eye(dim, settings.num_features, dtype=task.dtype)
    return Phi.repeat(num_runs, 1, 1).requires_grad_()


def _minimize(
    objective: Callable[[], Tensor], weights: Tensor, settings: PredictorSettings
) -> Tensor:
    """Adam on ``objective() -> [R]``; its learning rate falls to zero, so that it settles.

    Dividing by the penalty's weight changes nothing but how close Adam's small constant is.
    """
    optimizer = make_optimizer("adam", [weights], settings.learning_rate)
    for iteration in range(settings.num_iterations):
        rest = 1 - iteration / settings.num_iterations
        optimizer.param_groups[0]["lr"] = settings.learning_rate * rest
        descend(optimizer, lambda: objective() / (1 + settings.penalty))
    return weights.detach()


PREDICTOR_METHODS = {
    method.__name__: method
    for method in (erm, irmv1, vrex, irm_game_fixed_phi, irm_game_variable_phi)
}


@checked
def check_domains(
    features: Annotated[Sequence[Tensor], "E"], targets: Annotated[Sequence[Tensor], "E"]
) -> None:
    """Features ``[R, N_e, d]`` and targets ``[R, N_e]`` of domains that fit together.

    Raises:
        ValueError: no domain, no samples, shapes that do not fit, numbers that are not finite.
    """
    sizes: dict[str, Any] = {}
    for e, (x, y) in enumerate(zip(features, targets, strict=True)):
        sizes.pop("N_e", None)  # the only size in which domains may differ
        check_array(f"features[{e}]", x, "R N_e d", sizes)
        check_array(f"targets[{e}]", y, "R N_e", sizes)
