"""Statistics over runs: by hand, by brute force, and against independent versions."""

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from ipo.stats import bootstrap_interval, paired_difference, probability_of_improvement

RUNS = np.array([78.1, 80.4, 69.9, 85.2, 77.7, 81.3, 74.6, 79.0, 90.5, 72.2])
whole_costs = st.lists(st.integers(0, 5).map(float), min_size=2, max_size=12)  # with many ties


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_interval_of_two_runs():
    """The resampled mean of 0 and 1 is 0, 1/2 and 1 with probabilities 1/4, 1/2 and 1/4."""
    assert bootstrap_interval([0, 1], rng()) == (0, 1)


def test_interval_holds_the_middle_of_resampled_means():
    resamples = np.random.default_rng(1).choice(RUNS, size=(100_000, len(RUNS)))
    expected = np.quantile(resamples.mean(1), [0.025, 0.975])
    # Two estimates of the same quantiles, the coarser one from 10,000 resamples.
    np.testing.assert_allclose(bootstrap_interval(RUNS, rng()), expected, atol=0.05 * RUNS.std())


def test_interval_depends_on_its_generator_alone():
    assert bootstrap_interval(RUNS, rng()) == bootstrap_interval(RUNS, rng())
    assert bootstrap_interval(RUNS, rng()) != bootstrap_interval(RUNS, np.random.default_rng(1))


def test_interval_of_equal_runs_has_no_width():
    assert bootstrap_interval([3.5] * 4, rng()) == (3.5, 3.5)


def test_difference_is_taken_run_by_run():
    assert paired_difference(RUNS + 2, RUNS, rng()) == pytest.approx((2, 2, 2))


def test_difference_is_below_zero_where_the_first_costs_less():
    mean, low, high = paired_difference([1.0, 2.0, 3.0], [2.0, 5.0, 3.5], rng())
    assert mean == pytest.approx(-1.5)
    assert low == pytest.approx(-3) and high == pytest.approx(-0.5)


def test_difference_has_the_interval_of_the_differences():
    baseline = np.random.default_rng(2).normal(size=len(RUNS))
    low, high = bootstrap_interval(RUNS - baseline, rng())
    assert paired_difference(RUNS, baseline, rng())[1:] == (low, high)


@given(whole_costs, whole_costs)
def test_probability_of_improvement_counts_pairs(costs, baseline):
    scores = [1 if x < y else 0.5 if x == y else 0 for x in costs for y in baseline]
    assert probability_of_improvement(costs, baseline) == pytest.approx(sum(scores) / len(scores))


@given(whole_costs, whole_costs)
def test_probability_of_improvement_is_mann_whitneys(costs, baseline):
    u = scipy.stats.mannwhitneyu(baseline, costs).statistic
    expected = u / (len(costs) * len(baseline))
    assert probability_of_improvement(costs, baseline) == pytest.approx(expected)


def test_lower_costs_are_an_improvement():
    assert probability_of_improvement([1, 2], [3, 4]) == 1
    assert probability_of_improvement([3, 4], [1, 2]) == 0
