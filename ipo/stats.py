"""Statistics over runs: intervals, paired differences, probability of improvement.

All methods see the same seeds, so comparisons are paired. Intervals are bootstrap intervals
over runs; with few runs they are a little too narrow.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.stats

NUM_RESAMPLES = 10_000


def bootstrap_interval(values: Sequence[float], rng: np.random.Generator) -> tuple[float, float]:
    """95 % percentile bootstrap interval of the mean of runs ``[num_runs]``.

    Raises:
        ValueError: fewer than two runs, values that are not finite.
    """
    runs = _checked("values", values)
    if np.ptp(runs) == 0:  # every resample is the same; scipy would warn and return NaN
        return float(runs[0]), float(runs[0])
    interval = scipy.stats.bootstrap(
        (runs,),
        np.mean,
        confidence_level=0.95,
        n_resamples=NUM_RESAMPLES,
        axis=-1,
        method="percentile",
        rng=rng,
    ).confidence_interval
    return float(interval.low), float(interval.high)


def paired_difference(
    values: Sequence[float], baseline: Sequence[float], rng: np.random.Generator
) -> tuple[float, float, float]:
    """Mean of ``values - baseline`` run by run, with its 95 % bootstrap interval."""
    runs, others = _checked("values", values), _checked("baseline", baseline)
    if len(runs) != len(others):
        raise ValueError(
            f"baseline has {len(others)} runs, must have {len(runs)}, one for each value"
        )
    difference = runs - others
    return float(difference.mean()), *bootstrap_interval(difference, rng)


def probability_of_improvement(costs: Sequence[float], baseline: Sequence[float]) -> float:
    """Probability that a run of the method costs less than a run of the baseline.

    P(X < Y) + P(X = Y) / 2    over all pairs of runs (Mann-Whitney U / (n m))
    """
    runs, others = _checked("costs", costs)[:, None], _checked("baseline", baseline)
    return float(np.mean((runs < others) + 0.5 * (runs == others)))


def _checked(name: str, values: Sequence[float]) -> np.ndarray:
    array = np.asarray(values, dtype=float)
    if array.ndim != 1 or len(array) < 2:
        raise ValueError(f"{name}: has shape {array.shape}, must be a list of at least 2 runs")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} = {array.tolist()}: must be finite")
    return array
