"""Statistics over runs: intervals, paired differences, probability of improvement.

All methods see the same seeds, so comparisons are paired. Intervals are bootstrap intervals
over runs; with few runs they are a little too narrow.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import numpy as np
import scipy.stats

from ipo.checks import checked

NUM_RESAMPLES = 10_000


def _check_runs(name: str, values: object) -> None:
    array = np.asarray(values)
    if array.ndim != 1 or len(array) < 2:
        raise ValueError(f"{name}: has shape {array.shape}, must be a list of at least 2 runs")
    if array.dtype.kind not in "fiu":
        raise TypeError(f"{name} = {values!r}: must be numbers")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} = {array.tolist()}: must be finite")


Runs = Annotated[Sequence[float], _check_runs]  # [num_runs]


@checked
def bootstrap_interval(values: Runs, rng: np.random.Generator) -> tuple[float, float]:
    """95 % percentile bootstrap interval of the mean of runs ``[num_runs]``.

    Raises:
        ValueError: fewer than two runs, values that are not finite.
    """
    runs = np.asarray(values, dtype=float)
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


@checked
def paired_difference(
    values: Runs, baseline: Runs, rng: np.random.Generator
) -> tuple[float, float, float]:
    """Mean of ``values - baseline`` run by run, with its 95 % bootstrap interval."""
    if len(values) != len(baseline):
        raise ValueError(
            f"baseline: has {len(baseline)} runs, must have {len(values)}, one for each value"
        )
    difference = np.subtract(values, baseline, dtype=float).tolist()
    return float(np.mean(difference)), *bootstrap_interval(difference, rng)


@checked
def probability_of_improvement(costs: Runs, baseline: Runs) -> float:
    """Probability that a run of the method costs less than a run of the baseline.

    P(X < Y) + P(X = Y) / 2    over all pairs of runs (Mann-Whitney U / (n m))
    """
    runs, others = np.array(costs, dtype=float)[:, None], np.asarray(baseline)
    return float(np.mean((runs < others) + 0.5 * (runs == others)))
