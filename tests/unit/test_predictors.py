"""Invariance methods: derivatives, limits, ICP against another implementation, bad input."""

from dataclasses import replace

import causalicp
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from experiments.causality import (
    CAUSAL,
    FEATURES,
    VARIANTS,
    Cell,
    anticausal,
    chain,
    chain_run,
    digits_run,
    population,
    run_cell,
)
from ipo.causality.icp import icp
from ipo.causality.predictors import (
    PREDICTOR_METHODS,
    Classification,
    PredictorSettings,
    Regression,
    erm,
    irm_game_fixed_phi,
    irm_penalties,
    irmv1,
    vrex,
)
from ipo.causality.scm import moments, population_regression

FAST = PredictorSettings(learning_rate=0.05, num_iterations=500)


def random_samples(seed: int, num_runs: int = 2, num_domains: int = 3, n: int = 40, d: int = 3):
    g = torch.Generator().manual_seed(seed)
    x = [torch.randn(num_runs, n, d, generator=g).double() for _ in range(num_domains)]
    y = [(torch.randn(num_runs, n, generator=g) + part[..., 0] > 0).double() for part in x]
    return x, y


def population_task(slopes, scales=None) -> Regression:
    scales = scales or [1.0] * len(slopes)
    parts = [
        population(anticausal([s], scale), ["X", "Z0"])
        for s, scale in zip(slopes, scales, strict=True)
    ]
    return Regression(*(torch.stack(list(part)).unsqueeze(0) for part in zip(*parts, strict=True)))


@pytest.mark.parametrize("kind", [Regression.from_samples, Classification])
@given(seed=st.integers(0, 500))
def test_gradients_are_derivatives_of_the_risks(kind, seed):
    task = kind(*random_samples(seed))
    v = torch.randn(2, 3, generator=torch.Generator().manual_seed(seed)).double()
    step = 1e-6
    for j in range(3):
        e = torch.eye(3).double()[j] * step
        numerical = (task.risks(v + e) - task.risks(v - e)) / (2 * step)
        torch.testing.assert_close(task.gradients(v)[..., j], numerical, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("kind", [Regression.from_samples, Classification])
@pytest.mark.parametrize("k", [1, 3])
def test_penalty_is_the_derivative_by_the_classifier_above(kind, k):
    task = kind(*random_samples(7))
    Phi = torch.randn(2, 3, k, generator=torch.Generator().manual_seed(1)).double()
    step, slopes = 1e-6, []
    for j in range(k):
        w = torch.ones(k).double()
        up, down = w.clone(), w.clone()
        up[j] += step
        down[j] -= step
        slopes.append((task.risks(Phi @ up) - task.risks(Phi @ down)) / (2 * step))
    numerical = torch.stack(slopes, -1).square().mean(-1)
    torch.testing.assert_close(irm_penalties(task, Phi), numerical, rtol=1e-5, atol=1e-7)


def test_risks_are_what_samples_say():
    x, y = random_samples(3)
    v = torch.randn(2, 3, generator=torch.Generator().manual_seed(3)).double()
    f = torch.stack([part @ v[r] for r in range(2) for part in [x[1][r]]])
    squared = (f - y[1]).square().mean(1)
    torch.testing.assert_close(Regression.from_samples(x, y).risks(v)[:, 1], squared)
    logistic = torch.nn.functional.binary_cross_entropy_with_logits(f, y[1], reduction="none")
    torch.testing.assert_close(Classification(x, y).risks(v)[:, 1], logistic.mean(1))
    wrong = ((f > 0) != y[1].bool()).double().mean(1)
    torch.testing.assert_close(Classification(x, y).errors(v)[:, 1], wrong)


def test_erm_is_least_squares():
    x, y = random_samples(0)
    v = erm(Regression.from_samples(x, y), replace(FAST, num_iterations=2000))
    for r in range(2):
        expected = torch.linalg.lstsq(
            torch.cat([p[r] for p in x]), torch.cat([p[r] for p in y]).unsqueeze(1)
        ).solution.squeeze(1)
        torch.testing.assert_close(v[r], expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("method", [irmv1, vrex])
def test_without_a_penalty_it_is_erm(method):
    task = Regression.from_samples(*random_samples(4))
    settings = replace(FAST, num_iterations=2000)
    torch.testing.assert_close(method(task, settings), erm(task, settings), atol=1e-5, rtol=0)


@pytest.mark.parametrize("method", [irmv1, vrex])
def test_penalties_find_the_cause_where_domains_differ_much(method):
    task = population_task([-0.8, 0.5, 1.5, 2.8], [0.3, 0.7, 1.5, 3.5])
    settings = PredictorSettings(penalty=100.0, learning_rate=0.1, num_iterations=4000)
    v = method(task, settings)
    assert v[0].tolist() == pytest.approx([1.0, 0.0], abs=0.06)
    assert erm(task, settings)[0, 1].abs() > 0.05


def test_the_cause_has_no_penalty_and_equal_risks():
    task, v = population_task([-0.8, 1.5, 2.8]), torch.tensor([[1.0, 0.0]]).double()
    assert irm_penalties(task, v.unsqueeze(-1)).abs().max() < 1e-20
    torch.testing.assert_close(task.risks(v), torch.ones(1, 3).double())


def test_game_of_two_opposed_domains_drops_the_effect():
    """Bounded players whose wishes for the effect's weight differ in sign end at zero."""
    task = population_task([1.0, -1.0])
    settings = PredictorSettings(learning_rate=0.01, num_iterations=3000, bound=2.0)
    v = irm_game_fixed_phi(task, settings)
    assert v[0].tolist() == pytest.approx([1.0, 0.0], abs=0.02)


@pytest.mark.parametrize("method", PREDICTOR_METHODS.values(), ids=PREDICTOR_METHODS.keys())
def test_runs_do_not_influence_each_other(method):
    x, y = random_samples(9, num_runs=3)
    settings = replace(FAST, num_iterations=50, penalty=10.0, num_features=3)
    together = method(Regression.from_samples(x, y), settings)
    alone = method(Regression.from_samples([p[1:2] for p in x], [p[1:2] for p in y]), settings)
    torch.testing.assert_close(together[1:2], alone, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("method", [erm, irmv1, vrex])
def test_order_of_domains_does_not_matter(method):
    x, y = random_samples(11)
    settings = replace(FAST, num_iterations=100, penalty=10.0)
    forward = method(Regression.from_samples(x, y), settings)
    backward = method(Regression.from_samples(x[::-1], y[::-1]), settings)
    torch.testing.assert_close(forward, backward, rtol=1e-7, atol=1e-9)


# --------------------------------------------------------------------------------- ICP


def icp_data(seed: int, shift: float):
    rng = np.random.default_rng(seed)
    features, targets = [], []
    for scale in (1.0, 2.0, 0.5):
        x = scale * rng.normal(size=(150, 2))
        y = x[:, 0] + shift * scale + rng.normal(size=150)
        z = y + scale * rng.normal(size=150)
        features.append(np.column_stack([x, z]))
        targets.append(y)
    return features, targets


@pytest.mark.parametrize("shift", [0.0, 0.3])
@pytest.mark.parametrize("seed", range(8))
def test_icp_agrees_with_causalicp(seed, shift):
    features, targets = icp_data(seed, shift)
    ours = icp([torch.tensor(x) for x in features], [torch.tensor(y) for y in targets])
    data = [np.column_stack([x, y]) for x, y in zip(features, targets, strict=True)]
    # Their result sorts sets, which have no order, so only what does not depend on it counts.
    theirs = causalicp.fit(data, 3, alpha=0.05)
    assert {frozenset(s) for s in ours.accepted} == {frozenset(s) for s in theirs.accepted_sets}
    estimate = None if ours.estimate is None else set(ours.estimate)
    assert estimate == theirs.estimate
    if ours.accepted:  # where every set is rejected they report p-values of one
        for j in range(3):
            p = max(p for s, p in ours.p_values.items() if j not in s)
            assert p == pytest.approx(theirs.pvalues[j], rel=1e-6, abs=1e-12)


def test_icp_finds_the_cause_and_its_coefficient():
    features, targets = icp_data(1, 0.0)
    result = icp([torch.tensor(x) for x in features], [torch.tensor(y) for y in targets])
    assert result.estimate == (0,)
    assert result.coefficients == pytest.approx([1, 0, 0], abs=0.1)


# ------------------------------------------------------------------------------ problems


@pytest.mark.parametrize("variant", VARIANTS)
def test_linear_example_has_the_causal_predictor_as_its_invariant_one(variant):
    """Of the regressions on X1 in two domains, coefficients agree; on everything they do not."""
    rng = np.random.default_rng(0)
    hidden = variant[0] == "P"
    weights = (
        [rng.normal(size=(5, 5)) / 10 for _ in range(3)]
        if hidden
        else [np.eye(5), *np.zeros((2, 5, 5))]
    )
    covariances = [moments(chain(variant, e, weights))[1] for e in (0.2, 2.0)]
    on_causes = [population_regression(c, "Y", FEATURES[:5])[0] for c in covariances]
    on_all = [population_regression(c, "Y", FEATURES)[0] for c in covariances]
    np.testing.assert_allclose(*on_causes, atol=1e-9)
    assert np.abs(on_all[0] - on_all[1]).max() > 0.1
    if not hidden:
        np.testing.assert_allclose(on_causes[0], CAUSAL[:5], atol=1e-9)


def test_scrambling_is_a_rotation_of_the_same_data():
    (plain, *_), test, _ = chain_run("FOU", 3)
    (mixed, *_), _, rotation = chain_run("FOS", 3)
    np.testing.assert_allclose(mixed[0] @ rotation.T, plain[0], atol=1e-12)
    np.testing.assert_array_equal(mixed[1], plain[1])
    assert [tuple(part.shape) for part in test] == [(10, 10), (10,), ()]


def test_coloured_digits_have_the_stated_correlations():
    runs = [digits_run(seed) for seed in range(10)]

    def agreement(name: str, e: int) -> float:
        pairs = [run[name][e] for run in runs]
        return float(np.mean([((x[:, :64].sum(1) > 0) == y).mean() for x, y in pairs]))

    assert agreement("train", 0) == pytest.approx(0.9, abs=0.015)
    assert agreement("train", 1) == pytest.approx(0.8, abs=0.02)
    assert agreement("test", 0) == pytest.approx(0.1, abs=0.015)
    run, gray = runs[0], digits_run(0, gray=True)
    x, y = run["test"][0]
    np.testing.assert_array_equal(x[:, :64] + x[:, 64:128], gray["test"][0][0][:, :64])
    np.testing.assert_array_equal(y, gray["test"][0][1])
    assert not (x[:, :64].any(1) & x[:, 64:128].any(1)).any()


def test_a_cell_gives_a_row_for_every_run_domain_and_metric():
    rows = run_cell(Cell("erm", "small_shift", replace(FAST, num_iterations=20), 0.5), [0, 1])
    assert list(rows.columns) == [
        *("problem", "level", "method", "penalty", "run", "domain", "metric", "value")
    ]
    assert len(rows) == 4 and rows["value"].gt(0).all()


def test_penalties_change_nothing_for_who_knows_the_causes():
    rows = run_cell(Cell("oracle", "FOU", None), [0])
    values = rows.set_index("metric")["value"]
    assert values["error_causal"] == values["error_effects"] == 0
    assert values["test_risk"] == pytest.approx(5.0)  # five unit noises


# ----------------------------------------------------------------------------- bad input

X, Y = torch.randn(1, 5, 2).double(), torch.zeros(1, 5).double()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: icp([X[0, :1]] * 2, [Y[0, :1]] * 2),
            "samples of a domain = 1: must be",
        ),
        (lambda: icp([torch.ones(5, 1).double()] * 2, [Y[0]] * 2), "features: .* independent"),
        (lambda: Cell("ermm", "FOU", FAST), "method = 'ermm'.*did you mean 'erm'"),
        (lambda: Cell("erm", "FOX", FAST), "problem = 'FOX'.*must be one of"),
        (lambda: Cell("erm", "FOU", None), "settings = None: must be given"),
        (lambda: Cell("icp", "FOU", FAST), "settings = .*: must be given, but not for icp"),
        (lambda: chain("FOU", -1.0, []), "scale = -1.0: must be greater than 0"),
    ],
)
def test_bad_input(make, message):
    with pytest.raises(ValueError, match=message):
        make()
