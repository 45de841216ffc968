"""Statistics over runs: by hand, by brute force, and against independent versions."""

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from ipo.stats import (
    mean_interval,
    paired_difference,
    power,
    probability_of_improvement,
    runs_needed,
)

RUNS = np.array([78.1, 80.4, 69.9, 85.2, 77.7, 81.3, 74.6, 79.0, 90.5, 72.2])
whole_costs = st.lists(st.integers(0, 5).map(float), min_size=2, max_size=12)  # with many ties


def test_interval_of_two_runs():
    """t with one degree of freedom has its 97.5 % quantile at tan(0.475 pi); the error is 1/2."""
    half = np.tan(0.475 * np.pi) / 2
    assert mean_interval([0, 1]) == pytest.approx((0.5 - half, 0.5 + half))


def test_interval_is_scipys():
    expected = scipy.stats.ttest_1samp(RUNS, 0).confidence_interval(0.95)
    assert mean_interval(RUNS) == pytest.approx((expected.low, expected.high))


@pytest.mark.slow
def test_interval_of_ten_runs_covers_the_mean_as_often_as_it_says():
    """Of costs with a long tail, too, nearly so; a percentile bootstrap would cover 90 %."""
    random = np.random.default_rng(0)
    for draw, least in ((random.standard_normal, 0.94), (random.standard_exponential, 0.88)):
        samples = draw((4000, 10))
        truth = 0 if draw == random.standard_normal else 1
        intervals = [mean_interval(sample.tolist()) for sample in samples]
        assert np.mean([low < truth < high for low, high in intervals]) > least


def test_interval_of_equal_runs_has_no_width():
    assert mean_interval([3.5] * 4) == (3.5, 3.5)


def test_difference_is_taken_run_by_run():
    assert paired_difference(RUNS + 2, RUNS)[:3] == pytest.approx((2, 2, 2))


def test_difference_is_the_paired_t_test():
    baseline = np.random.default_rng(2).normal(size=len(RUNS))
    found, test = paired_difference(RUNS, baseline), scipy.stats.ttest_rel(RUNS, baseline)
    interval = test.confidence_interval(0.95)
    expected = (np.mean(RUNS - baseline), interval.low, interval.high, test.pvalue)
    assert found == pytest.approx(expected)


@pytest.mark.parametrize(("gained", "p"), [(0.0, 1.0), (1.0, 0.0)])
def test_p_where_all_runs_differ_by_the_same(gained, p):
    assert paired_difference([gained + 1.0, gained + 2.0], [1.0, 2.0]).p == p


def test_power_without_an_effect_is_the_level():
    assert power(0.0, 2.0, 10) == pytest.approx(0.05)


def test_a_large_effect_is_found_for_certain():
    assert power(1.9, 1.0, 100) == pytest.approx(1)


@pytest.mark.parametrize(("effect", "num_runs"), [(1.0, 5), (-0.7, 10), (0.3, 40)])
def test_power_is_how_often_the_interval_leaves_zero_out(effect, num_runs):
    samples = np.random.default_rng(1).normal(effect, 1, size=(20_000, num_runs))
    found = (scipy.stats.ttest_1samp(samples, 0, axis=1).pvalue < 0.05).mean()
    assert power(effect, 1.0, num_runs) == pytest.approx(found, abs=0.012)


@pytest.mark.parametrize(("effect", "spread"), [(5.0, 1.0), (2.0, 1.0), (3.0, 9.0), (3.0, 14.0)])
def test_runs_needed_are_the_fewest_with_a_power_of_80_percent(effect, spread):
    enough = [n for n in range(2, 250) if power(effect, spread, n) >= 0.8]
    assert runs_needed(effect, spread) == enough[0]


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
