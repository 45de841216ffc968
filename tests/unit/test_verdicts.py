"""The decision table of the verdicts, on rows made by hand."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import scipy.stats

from rules import (
    CONTRADICTED,
    EXPLAINED,
    IN_PART,
    NO_DATA,
    REPRODUCED,
    RULES,
    UNDECIDED,
    Cells,
    NoData,
)
from rules.cells import paper_effect, paper_tests
from rules.door import power_beyond_half
from rules.lqr import lower_in_tables
from rules.verdicts import compare, decided, detectable, holm, power, together, verdict, within

NOISE = np.array([-2.0, -1, 0, 1, 2])


@pytest.mark.parametrize(
    ("low", "high", "effect", "expected"),
    [
        (1, 3, 2, REPRODUCED),
        (1, 3, None, REPRODUCED),
        (3, 4, 2, REPRODUCED),  # larger than in the paper
        (1, 3, 4, IN_PART),  # there, but smaller
        (-1, 3, 2, UNDECIDED),
        (-1, 3, None, UNDECIDED),
        (-1, 1, 2, CONTRADICTED),  # excludes the paper's effect
        (-3, -1, 2, CONTRADICTED),
        (-3, -1, None, CONTRADICTED),
        (-3, 3, -1, UNDECIDED),  # the paper itself has the other sign
    ],
)
def test_the_decision_table(low, high, effect, expected):
    assert verdict(low, high, effect) == expected


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [(-1, 1, REPRODUCED), (-3, 1, UNDECIDED), (3, 4, CONTRADICTED), (-4, -3, CONTRADICTED)],
)
def test_an_interval_between_bounds(low, high, expected):
    assert within(low, high, -2, 2) == expected


@pytest.mark.parametrize(
    ("verdicts", "expected"),
    [
        ([EXPLAINED, EXPLAINED], EXPLAINED),
        ([REPRODUCED, CONTRADICTED], IN_PART),
        ([IN_PART, UNDECIDED], IN_PART),
        ([CONTRADICTED, UNDECIDED], UNDECIDED),
        ([CONTRADICTED, CONTRADICTED], CONTRADICTED),
    ],
)
def test_parts_of_a_claim(verdicts, expected):
    assert together(verdicts) == expected


def test_holm_beside_a_table_by_hand():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.6, 0.7]) == [1, 1]


def test_many_tests_take_a_stronger_difference_each():
    base = pd.Series(np.zeros(5))
    sure, weak = (compare(pd.Series(NOISE + shift), base) for shift in (5.0, 2.2))
    assert weak.difference.p < 0.05 < 2 * weak.difference.p
    assert decided([sure, weak, weak]) == [REPRODUCED, UNDECIDED, UNDECIDED]
    assert decided([sure, weak, weak], corrected=False) == [REPRODUCED] * 3
    assert decided([compare(base, pd.Series(NOISE + 5))]) == [CONTRADICTED]


def test_pairs_are_compared_by_their_differences():
    runs = pd.Series(10 * NOISE)
    shifted = runs + 1 + 0.1 * pd.Series(NOISE[::-1])
    assert compare(shifted, runs).verdict == REPRODUCED
    unpaired = compare(shifted, runs, paired=False)
    assert unpaired.verdict == UNDECIDED
    expected = scipy.stats.ttest_ind(shifted, runs, equal_var=False).pvalue
    assert unpaired.difference.p == pytest.approx(expected)


def test_the_text_names_the_power_to_find_the_papers_effect():
    found = compare(pd.Series(NOISE), pd.Series(np.zeros(5)), effect=0.5)
    assert "the paper's difference is +0.5; the power to tell that from zero is 9%" in found.text()


PAPER = pd.DataFrame(
    {
        "method": ["ppo", "ppo", "ipo", "ipo"],
        "domain": ["red", "grey", "red", "grey"],
        "mean": [0.94, 0.80, 0.94, 0.85],
        "std": [0.004, 0.12, 0.003, 0.03],
    }
)


def test_the_papers_effect_needs_both_arms_and_all_domains():
    assert paper_effect(PAPER, "ipo", "ppo", ["grey"]) == pytest.approx(0.05)
    assert paper_effect(PAPER, "ipo", "ppo", ["red", "grey"], "min") == pytest.approx(0.05)
    assert paper_effect(PAPER, "ppo", "ipo", ["grey"], of="std") == pytest.approx(0.09)
    assert paper_effect(PAPER, "ipo", "ppo", ["grey", "blue"]) is None
    assert paper_effect(PAPER, "ipo", "ensemble", ["grey"]) is None


def test_the_papers_own_table_as_a_test():
    text = paper_tests(PAPER[PAPER["domain"] == "grey"], "ipo", "ppo", num_runs=10)
    assert "p = 0.25 where its ± has ddof 0, 0.23 where it has 1" in text


def test_what_the_papers_tables_say_of_columns():
    columns = [(2, 78.8, 3.5, 71.3, 2.1), (4, 57.7, 1.0, 57.8, 1.0)]
    lines = [
        (method, number, 1000, *own)
        for number, *both in columns
        for method, own in (("fixed", both[:2]), ("variable", both[2:]))
    ]
    names = ["method", "num_domains", "dim_distractor", "mean", "std"]
    paper = pd.DataFrame(lines, columns=names)
    text = lower_in_tables(paper, "variable", "fixed", 10)
    assert "in 1 of its 2 columns where its ± has ddof 0, in 1 where it has 1" in text
    assert "in 0 of its 2" in lower_in_tables(paper, "fixed", "variable", 10)
    assert lower_in_tables(paper, "variable", "another", 10) == ""


def test_the_smallest_effect_that_is_found_has_a_power_of_80_percent():
    assert power(detectable(2.0, 10), 2.0, 10) == pytest.approx(0.8)
    assert detectable(2.0, 10) == pytest.approx(2 * detectable(1.0, 10))


def test_power_to_tell_a_share_from_a_half_by_hand():
    least = 9 / 10  # of ten, nine is the first whose exact interval lies above a half
    expected = 10 * 0.6**9 * 0.4 + 0.6**10
    assert scipy.stats.binomtest(int(10 * least), 10).proportion_ci().low > 0.5
    assert scipy.stats.binomtest(8, 10).proportion_ci().low < 0.5
    assert power_beyond_half(0.6, 10) == pytest.approx(expected)


# ------------------------------------------------------------------------------- single rules


def cells_of(values: dict[tuple[str, ...], np.ndarray], columns: list[str]) -> Cells:
    """A cell for each tuple of ``columns``, with these runs."""
    rows = [
        dict(zip(columns, key, strict=True)) | {"run": run, "value": float(value)}
        for key, runs in values.items()
        for run, value in enumerate(runs)
    ]
    return Cells(pd.DataFrame(rows), num_runs=len(next(iter(values.values()))))


SETTINGS = {
    "common": {},
    "places": [{"domain": "blue"}],  # which the paper does not have
    "each": False,
    "method": {"method": "ipo"},
    "baseline": {"method": "ppo"},
    "control": [{"method": "ipo"}, {"method": "ensemble"}],
    "lower_is_better": False,
    "share": 0.25,
}


@pytest.mark.parametrize(
    ("ipo", "control", "expected"),
    [
        (10, 10, EXPLAINED),
        (10, 12, EXPLAINED),
        (10, 5, IN_PART),
        (10, 0, REPRODUCED),
        (0, 0, UNDECIDED),
        (-10, 0, CONTRADICTED),
    ],
)
def test_a_control_removes_the_advantage_or_not(ipo, control, expected):
    means = {("ipo", "blue"): ipo, ("ppo", "blue"): 0, ("ensemble", "blue"): control}
    noise = dict(zip(means, (0.1 * NOISE, 0.1 * NOISE[::-1], 0.02 * NOISE), strict=True))
    cells = cells_of({key: mean + noise[key] for key, mean in means.items()}, ["method", "domain"])
    assert RULES["because_of_the_game"](cells, PAPER, **SETTINGS).verdict == expected


def test_noise_leaves_it_open_what_a_control_removes():
    values = {("ipo", "blue"): 10 + NOISE, ("ppo", "blue"): NOISE, ("ensemble", "blue"): 6 * NOISE}
    cells = cells_of(values | {("ensemble", "blue"): 5 + 6 * NOISE[::-1]}, ["method", "domain"])
    assert RULES["because_of_the_game"](cells, PAPER, **SETTINGS).verdict == UNDECIDED


@pytest.mark.parametrize(
    ("scale", "expected"), [(1.0, REPRODUCED), (0.01, CONTRADICTED), (100.0, CONTRADICTED)]
)
def test_standard_deviations_come_back_or_not(scale, expected):
    values = {
        (row.method, row.domain, "return"): row.std * scale * np.tile(NOISE, 6)
        for row in PAPER.itertuples()
    }
    cells = cells_of(values, ["method", "domain", "metric"])
    settings = {"metric": "return", "num_paper_runs": 10, "ddof": 0, "common": {}, "where": {}}
    assert RULES["spreads_come_back"](cells, PAPER, **settings).verdict == expected


@pytest.mark.parametrize(
    ("left", "expected"),
    [(0.05, REPRODUCED), (0.1, UNDECIDED), (0.9, CONTRADICTED), (1.1, CONTRADICTED)],
)
def test_distractors_are_ignored_or_not(left, expected):
    paper = pd.DataFrame({"num_domains": [2, 5], "dim_distractor": [100, 100]})
    columns = ["method", "num_domains", "dim_distractor", "optimizer", "metric"]
    values = {
        (method, number, 100, "adam", "gain_norm_distractor"): 4 * share + 0.01 * NOISE
        for number in (2, 5)
        for method, share in (("ipo", left), ("pooled", 1.0))
    }
    wiggle = {key: runs[::-1] for key, runs in values.items() if key[0] == "pooled"}
    settings = {"method": "ipo", "baseline": "pooled", "remaining_share": 0.1}
    found = RULES["ignores"](cells_of(values | wiggle, columns), paper, **settings)
    assert found.verdict == expected
    assert f"{left:.0%} [" in found.evidence


@pytest.mark.parametrize(
    ("ahead", "radius", "expected"),
    [
        ((0.2, 0.1), 0.9, REPRODUCED),
        ((0.2, 0.1), 1.5, IN_PART),
        ((0.2, 0.0), 0.9, IN_PART),
        ((0.0, 0.0), 1.5, UNDECIDED),
        ((-0.2, -0.1), 1.5, CONTRADICTED),
    ],
)
def test_ahead_in_the_worst_domain_or_not(ahead, radius, expected):
    paper = pd.DataFrame({"num_domains": [2, 5], "dim_distractor": [100, 100]})
    metrics = {"efficiency_worst": 0.4, "share_unstable": 0.125, "opposed_radius": radius}
    values = {
        (method, number, 100, "adam", metric): value + 0.01 * noise
        for metric, value in metrics.items()
        for number in (2, 5)
        for method, noise in (("ipo", NOISE), ("pooled", NOISE[::-1]))
    }
    for number, by in zip((2, 5), ahead, strict=True):
        values["ipo", number, 100, "adam", "efficiency_worst"] += by
    values["pooled", 2, 100, "adam", "opposed_radius"] = 0 * NOISE
    columns = ["method", "num_domains", "dim_distractor", "optimizer", "metric"]
    settings = {"method": "ipo", "baseline": "pooled", "metric": "efficiency_worst"}
    settings |= {"corrected": True, "opposed": True}
    rule, cells = RULES["ahead_in_the_worst"], cells_of(values, columns)
    found = rule(cells, paper, **settings)
    assert found.verdict == expected
    unstable = [len(NOISE) * n if radius > 1 else 0 for n in (2, 1)]
    for runs in unstable:
        assert f"chosen against it in {runs} of {2 * len(NOISE)} runs" in found.evidence
    assert "an unstable loop in up to 12.5% of the new domains" in found.evidence
    of_chance = rule(cells, paper, **settings | {"opposed": False}).verdict
    assert (of_chance == REPRODUCED) == (ahead == (0.2, 0.1))


@pytest.mark.parametrize(
    ("shift", "expected"), [(0, REPRODUCED), (8, UNDECIDED), (30, CONTRADICTED), (-30, REPRODUCED)]
)
def test_a_game_is_as_good_as_the_penalty_or_not(shift, expected):
    keys = ["problem", "method", "penalty", "domain", "metric"]
    chosen, other = ("irmv1", 1.0, "test", "error"), ("irmv1", 9.0, "test", "error")
    values = {
        ("digits", "game", 0.0, "test", "error"): 100 + shift + 2 * NOISE,
        ("digits", *chosen): 100 + 0 * NOISE,
        ("digits", *other): 1 + 0 * NOISE,  # better, but not by the criterion
        ("digits", "irmv1", 1.0, "train", "criterion"): 0 * NOISE,
        ("digits", "irmv1", 9.0, "train", "criterion"): 1 + 0 * NOISE,
        ("digits", "game", 0.0, "train", "criterion"): 0 * NOISE,
    }
    settings = {
        "game": "game",
        "baseline": "irmv1",
        "metrics": {"error": ["digits"]},
        "criterion": "criterion",
        "margin": 0.1,
        "guessing": {"digits": 50.0},
    }
    found = RULES["game_beside"](cells_of(values, keys), pd.DataFrame(), **settings)
    assert found.verdict == expected
    assert "though guessing has 50" in found.evidence
    settings |= {"criterion": None, "guessing": {}}  # beside the largest penalty, which has 1
    strong = RULES["game_beside"](cells_of(values, keys), pd.DataFrame(), **settings)
    assert strong.verdict == CONTRADICTED and "guessing" not in strong.evidence


@pytest.mark.parametrize(
    ("scale", "expected"), [(0.1, REPRODUCED), (1.0, UNDECIDED), (10.0, CONTRADICTED)]
)
def test_a_game_varies_less_or_not(scale, expected):
    noise = np.tile(NOISE, 6)
    values = {
        (method, "test", "error"): runs
        for method, runs in (("game", scale * noise), ("irmv1", noise[::-1]))
    } | {(method, "train", "criterion"): 0 * noise for method in ("game", "irmv1")}
    cells = cells_of(values, ["method", "domain", "metric"])
    cells.rows[["problem", "penalty"]] = "digits", 0.0
    settings = {
        "game": "game",
        "baseline": "irmv1",
        "metrics": {"error": ["digits"]},
        "criterion": "criterion",
    }
    found = RULES["game_varies_less"](cells, pd.DataFrame(), **settings)
    assert found.verdict == expected


@pytest.mark.parametrize(
    ("gain", "residual", "expected"),
    [(1.0, 0.0, REPRODUCED), (0.0, 0.0, CONTRADICTED), (1.0, 1.0, NO_DATA)],
)
def test_an_equilibrium_is_optimal_everywhere_or_not(gain, residual, expected):
    values = {
        ("bounded", "1 2", "k_1"): [gain],
        ("bounded", "1 2", "k_2"): [gain],
        ("bounded", "1 2", "residual"): [residual],
    } | {("pooled", beta, k): [1.0] for beta in "12" for k in ("k_1", "k_2")}
    cells = cells_of(values, ["method", "betas", "metric"])
    settings = {"methods": ["bounded"], "settled": 1e-6, "tolerance": 0.01}

    def rule() -> str:
        return RULES["equilibria_are_invariant"](cells, pd.DataFrame(), **settings).verdict

    if expected == NO_DATA:
        with pytest.raises(NoData, match="equilibria of bounded: 0"):
            rule()
    else:
        assert rule() == expected
