"""Structural causal models: named variables, assignments, noise, interventions and the graph.

A structural causal model (SCM) is a list of assignments, one for each variable,

    x_j <- f_j(Pa(x_j), eta_j),        eta_1, ..., eta_m independent.

An intervention replaces some of them and leaves the others as they are.

Source: Definitions 1 and 2 of Sonar, Pacelli and Majumdar (2021), after Peters et al. (2017).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from graphlib import CycleError, TopologicalSorter

import numpy as np
import pandas as pd
import scipy.stats

from ipo.checks import Count, NonNegative, check_array, check_choice, checked

Noise = Callable[[np.random.Generator, int], np.ndarray]


@checked
@dataclass(frozen=True)
class Normal:
    """Noise ``N(mean, std^2)``; ``std = 0`` is a constant."""

    mean: float = 0.0
    std: NonNegative = 1.0

    @checked
    def __call__(self, rng: np.random.Generator, size: Count) -> np.ndarray:
        return self.mean + self.std * rng.standard_normal(size)


@checked
def uniform(rng: np.random.Generator, size: Count) -> np.ndarray:
    """Noise that is uniform on [0, 1); a threshold makes any binary variable of it."""
    return rng.random(size)


@checked
@dataclass(frozen=True)
class Linear:
    """``x <- sum_p coefficients[p] p + noise``."""

    coefficients: Mapping[str, float]
    noise: Normal = Normal()

    @property
    def parents(self) -> tuple[str, ...]:
        return tuple(self.coefficients)

    def __call__(self, values: Mapping[str, np.ndarray], noise: np.ndarray) -> np.ndarray:
        return sum((c * values[p] for p, c in self.coefficients.items()), start=noise)


@checked
@dataclass(frozen=True)
class Mechanism:
    """``x <- function(*parents, noise)``, any function of arrays ``[num_samples]``."""

    parents: tuple[str, ...]
    function: Callable[..., np.ndarray]
    noise: Noise = Normal()

    def __call__(self, values: Mapping[str, np.ndarray], noise: np.ndarray) -> np.ndarray:
        return self.function(*(values[parent] for parent in self.parents), noise)


@checked
def bernoulli(parents: Sequence[str], probability: Callable[..., np.ndarray]) -> Mechanism:
    """A binary variable that is 1 with ``probability(*parents)``."""

    def draw(*parents_and_noise: np.ndarray) -> np.ndarray:
        *given, noise = parents_and_noise
        chance = np.asarray(probability(*given))
        if not bool(((chance >= 0) & (chance <= 1)).all()):
            raise ValueError("probability: returned other numbers, must be within [0, 1]")
        return (noise < chance) * 1.0

    return Mechanism(tuple(parents), draw, uniform)


Assignment = Linear | Mechanism  # how a variable comes about: of its parents and a noise of its own


class SCM:
    """A structural causal model.

    Args:
        assignments: ``{variable: assignment}``.

    Raises:
        ValueError: no variable, a parent that is no variable, a cycle.
    """

    @checked
    def __init__(self, assignments: Mapping[str, Assignment]) -> None:
        if not assignments:
            raise ValueError("assignments = {}: must not be empty")
        self.assignments = dict(assignments)
        for name in self.assignments:
            for parent in self.parents(name):
                check_choice(f"parent of {name}", parent, self.assignments)
        try:
            graph = {name: self.parents(name) for name in self.assignments}
            self.order = tuple(TopologicalSorter(graph).static_order())  # causes come first
        except CycleError as error:
            raise ValueError(
                f"assignments: {' -> '.join(error.args[1])} is a cycle, must be acyclic"
            ) from None

    def parents(self, name: str) -> tuple[str, ...]:
        """The direct causes of a variable."""
        check_choice("variable", name, self.assignments)
        return tuple(self.assignments[name].parents)

    @property
    def edges(self) -> list[tuple[str, str]]:
        """Pairs ``(cause, effect)`` of all direct causes, which make the graph."""
        return [(parent, name) for name in self.assignments for parent in self.parents(name)]

    def descendants(self, name: str) -> set[str]:
        """All variables that an intervention on ``name`` can change, itself aside."""
        check_choice("variable", name, self.assignments)
        affected = {name}
        for other in self.order:
            if affected & set(self.parents(other)):
                affected.add(other)
        return affected - {name}

    @checked
    def sample(self, num_samples: Count, rng: np.random.Generator) -> pd.DataFrame:
        """Independent samples, a column for each variable.

        Every variable draws from a stream of its own. So two models with the same ``rng`` differ
        only in what follows from the assignments that differ.

        Raises:
            ValueError: an assignment that returns another shape than ``[num_samples]``, or numbers
                that are not finite.
        """
        streams = dict(zip(self.assignments, rng.spawn(len(self.assignments)), strict=True))
        values: dict[str, np.ndarray] = {}
        for name in self.order:
            assignment = self.assignments[name]
            value = assignment(values, assignment.noise(streams[name], num_samples))
            if np.shape(value) != (num_samples,):
                raise ValueError(f"{name}: has shape {np.shape(value)}, must have {(num_samples,)}")
            if not np.isfinite(value).all():
                raise ValueError(f"{name}: its assignment must return finite numbers")
            values[name] = value
        return pd.DataFrame({name: values[name] for name in self.assignments})

    @checked
    def intervene(self, **assignments: Assignment) -> SCM:
        """The model with other assignments (a soft intervention); parents may change, too."""
        for name in assignments:
            check_choice("intervention on", name, self.assignments)
        return SCM(self.assignments | assignments)

    @checked
    def do(self, **values: float) -> SCM:
        """The model in which variables are set to values, whatever their causes say."""
        return self.intervene(**{name: Linear({}, Normal(v, 0.0)) for name, v in values.items()})

    @checked
    def with_noise(self, **noises: Normal) -> SCM:
        """The model in which variables keep their function and get other noise."""
        for name in noises:
            check_choice("intervention on", name, self.assignments)
        return self.intervene(
            **{name: replace(self.assignments[name], noise=n) for name, n in noises.items()}
        )


@checked
def moments(model: SCM) -> tuple[pd.Series, pd.DataFrame]:
    """Exact mean and covariance of a linear model ``x = B x + eta``.

        mean = (I - B)^-1 E[eta],    covariance = (I - B)^-1 Cov[eta] (I - B)^-T

    Raises:
        TypeError: an assignment that is not linear.
    """
    names = list(model.assignments)
    B = pd.DataFrame(0.0, names, names)
    noises = []
    for name, assignment in model.assignments.items():
        if not isinstance(assignment, Linear):
            raise TypeError(
                f"model: {name} is a {type(assignment).__name__}, must be Linear for exact moments"
            )
        for parent, coefficient in assignment.coefficients.items():
            B.loc[name, parent] = coefficient
        noises.append(assignment.noise)
    mixing = np.linalg.inv(np.eye(len(names)) - B.to_numpy())
    mean = mixing @ [noise.mean for noise in noises]
    covariance = mixing @ np.diag([noise.std**2 for noise in noises]) @ mixing.T
    return pd.Series(mean, names), pd.DataFrame(covariance, names, names)


def _check_variables(columns: pd.Index, target: str, given: Sequence[str]) -> None:
    for name in (target, *given):
        check_choice("variable", name, columns)
    if target in given:
        raise ValueError(f"target = {target!r}: must not be among {list(given)}")


@checked
def population_regression(
    covariance: pd.DataFrame, target: str, predictors: Sequence[str]
) -> tuple[np.ndarray, float]:
    """Coefficients of the best linear prediction of ``target``, and the variance that it leaves."""
    _check_variables(covariance.columns, target, predictors)
    S = list(predictors)
    cross = covariance.loc[S, target].to_numpy()
    coefficients = np.linalg.lstsq(covariance.loc[S, S].to_numpy(), cross, rcond=None)[0]
    return coefficients, float(covariance.loc[target, target] - cross @ coefficients)


@checked
def same_conditional(samples: Sequence[pd.DataFrame], target: str, given: Sequence[str]) -> float:
    """p-value of the hypothesis that ``P(target | given)`` is the same in all domains.

    Likelihood-ratio test between one linear-Gaussian regression for all domains together and one
    for each, where N_e are the samples of a domain and N those of all:

        N log s^2 - sum_e N_e log s_e^2  ~  chi^2 with (E - 1) (|given| + 2) degrees of freedom.

    Raises:
        ValueError: one domain only, a variable that is not there or on both sides, fewer samples
            than coefficients, values that are not finite.
    """
    if len(samples) < 2:
        raise ValueError(f"samples: has {len(samples)} domains, must have at least 2")
    for e, sample in enumerate(samples):
        _check_variables(sample.columns, target, given)
        if len(sample) < len(given) + 3:
            raise ValueError(f"samples[{e}]: has {len(sample)}, must have {len(given) + 3} or more")
        check_array(f"samples[{e}]", sample[[target, *given]].to_numpy(), "N variables", {})

    def deviance(part: pd.DataFrame) -> float:
        design = np.column_stack([np.ones(len(part)), part[list(given)]])
        y = part[target].to_numpy()
        residual = y - design @ np.linalg.lstsq(design, y, rcond=None)[0]
        # A variable that was set to a constant leaves no variance; its logarithm stays finite.
        return len(part) * np.log(max(np.mean(residual**2), 1e-12))

    statistic = deviance(pd.concat(samples)) - sum(map(deviance, samples))
    degrees = (len(samples) - 1) * (len(given) + 2)
    return float(scipy.stats.chi2.sf(statistic, degrees))
