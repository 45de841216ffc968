"""Structural causal models: samples, interventions and graphs against what can be computed."""

import itertools
import math

import matplotlib.pyplot as plt
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments import figures as plots
from ipo.causality.scm import (
    SCM,
    Linear,
    Mechanism,
    Normal,
    bernoulli,
    moments,
    population_regression,
    same_conditional,
)

CHAIN = SCM(
    {
        "X": Linear({}, Normal(1.0, 2.0)),
        "Y": Linear({"X": 0.5}, Normal(0.0, 1.0)),
        "Z": Linear({"X": -1.0, "Y": 2.0}, Normal(0.5, 0.5)),
    }
)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def random_model(seed: int, size: int = 5) -> SCM:
    draw = rng(seed)
    return SCM(
        {
            f"V{j}": Linear(
                {f"V{i}": draw.normal() for i in range(j) if draw.random() < 0.6},
                Normal(draw.normal(), draw.uniform(0.5, 2)),
            )
            for j in range(size)
        }
    )


def test_moments_of_a_chain_by_hand():
    mean, covariance = moments(CHAIN)
    # Y = .5 X + e, Z = -X + 2 Y + e' = 2 e + e'
    assert mean.tolist() == pytest.approx([1.0, 0.5, 0.5])
    expected = [[4, 2, 0], [2, 2, 2], [0, 2, 4.25]]
    np.testing.assert_allclose(covariance, expected, atol=1e-12)


@given(st.integers(0, 1000))
def test_samples_have_the_exact_moments(seed):
    model, n = random_model(seed), 20_000
    mean, covariance = moments(model)
    samples = model.sample(n, rng(seed))
    std = np.sqrt(np.diag(covariance))
    assert (np.abs(samples.mean() - mean) < 6 * std / math.sqrt(n)).all()
    spread = np.sqrt((np.outer(std, std) ** 2 + covariance**2) / n)
    assert (np.abs(samples.cov() - covariance) < 6 * spread).to_numpy().all()


BINARY = SCM(
    {
        "U": bernoulli([], lambda: 0.4),
        "T": bernoulli(["U"], lambda u: 0.2 + 0.6 * u),
        "R": bernoulli(["U", "T"], lambda u, t: 0.3 + 0.3 * t + 0.2 * u),
    }
)


def exact(model: SCM, fixed: dict[str, float]) -> dict[tuple, float]:
    """P(u, t, r | do(fixed)): the product of all factors but those of the fixed variables."""
    p_one = {
        "U": lambda u, t: 0.4,
        "T": lambda u, t: 0.2 + 0.6 * u,
        "R": lambda u, t: 0.3 + 0.3 * t + 0.2 * u,
    }
    table = {}
    for u, t, r in itertools.product((0, 1), repeat=3):
        values = {"U": u, "T": t, "R": r}
        probability = 1.0
        for name, value in values.items():
            if name in fixed:
                probability *= value == fixed[name]
            else:
                one = p_one[name](u, t)
                probability *= one if value else 1 - one
        table[u, t, r] = probability
    return table


@pytest.mark.parametrize("fixed", [{}, {"T": 1}, {"T": 0}, {"U": 1}, {"U": 0, "T": 1}, {"R": 1}])
def test_interventions_are_the_truncated_factorisation(fixed):
    n = 40_000
    samples = BINARY.do(**fixed).sample(n, rng(1)) if fixed else BINARY.sample(n, rng(1))
    counts = samples.value_counts(["U", "T", "R"])
    for cell, probability in exact(BINARY, fixed).items():
        share = counts.get(cell, 0) / n
        assert abs(share - probability) < 5 * math.sqrt(probability * (1 - probability) / n) + 1e-12


def test_seeing_is_not_doing():
    samples = BINARY.sample(40_000, rng(2))
    seen = samples[samples["T"] == 1]["R"].mean()
    done = BINARY.do(T=1).sample(40_000, rng(2))["R"].mean()
    assert done == pytest.approx(0.6 + 0.2 * 0.4, abs=0.012)
    assert seen == pytest.approx(0.6 + 0.2 * (0.4 * 0.8) / (0.4 * 0.8 + 0.6 * 0.2), abs=0.012)


@given(st.integers(0, 200), st.integers(0, 4))
def test_an_intervention_changes_descendants_only(seed, target):
    model, name = random_model(seed), f"V{target}"
    before = model.sample(50, rng(seed))
    for changed in (model.do(**{name: 7.0}), model.with_noise(**{name: Normal(3, 1)})):
        after = changed.sample(50, rng(seed))
        same = {column for column in before if np.array_equal(before[column], after[column])}
        assert same >= set(before) - model.descendants(name) - {name}
        assert name not in same


def test_intervening_leaves_the_model_as_it_was():
    edges = list(CHAIN.edges)
    assert CHAIN.do(Y=0).edges == [("X", "Z"), ("Y", "Z")]
    assert CHAIN.edges == edges == [("X", "Y"), ("X", "Z"), ("Y", "Z")]
    assert CHAIN.descendants("X") == {"Y", "Z"} and CHAIN.descendants("Z") == set()


def test_order_of_declaration_does_not_matter():
    upside_down = SCM({name: CHAIN.assignments[name] for name in ("Z", "Y", "X")})
    assert upside_down.order.index("X") < upside_down.order.index("Y")
    np.testing.assert_allclose(
        moments(upside_down)[1].loc[list("XYZ"), list("XYZ")], moments(CHAIN)[1]
    )


def test_population_regression_by_hand():
    coefficients, rest = population_regression(moments(CHAIN)[1], "Y", ["X"])
    assert coefficients == pytest.approx([0.5]) and rest == pytest.approx(1.0)
    coefficients, _ = population_regression(moments(CHAIN)[1], "Z", ["X", "Y"])
    assert coefficients == pytest.approx([-1.0, 2.0])


def test_the_right_conditional_is_found_to_change():
    other = CHAIN.with_noise(Y=Normal(0, 2))
    samples = [CHAIN.sample(2000, rng(3)), other.sample(2000, rng(4))]
    assert same_conditional(samples, "Y", ["X"]) < 1e-6
    assert same_conditional(samples, "Z", ["X", "Y"]) > 0.01
    assert same_conditional(samples, "X", []) > 0.01
    assert same_conditional(samples, "X", ["Y"]) < 1e-6  # against the arrow


def test_p_values_are_uniform_where_nothing_changes():
    p = [
        same_conditional(
            [CHAIN.sample(200, rng(2 * i)), CHAIN.sample(200, rng(2 * i + 1))], "Y", ["X"]
        )
        for i in range(200)
    ]
    assert 0.02 < np.mean(np.array(p) < 0.1) < 0.18


def test_drawn_graph_has_the_nodes_and_edges_of_the_model():
    fig, ax = plt.subplots()
    plots.causal_graph(ax, CHAIN, {"X": (0, 0), "Y": (1, 0), "Z": (1, 1)}, changed={"Y"})
    nodes = [c.get_gid() for c in ax.collections]
    edges = [t.get_gid() for t in ax.texts if t.get_gid()]
    assert nodes == ["X", "Y", "Z"]
    assert edges == [f"{a}->{b}" for a, b in CHAIN.edges]
    places = {c.get_gid(): c.get_offsets()[0].tolist() for c in ax.collections}
    arrow = next(t for t in ax.texts if t.get_gid() == "X->Z")
    assert list(arrow.xy) == places["Z"] and list(arrow.xyann) == places["X"]
    plt.close(fig)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: SCM({}), "assignments = {}: must not be empty"),
        (
            lambda: SCM({"X": Linear({"Y": 1}), "Y": Linear({"X": 1})}),
            "is a cycle, must be acyclic",
        ),
        (lambda: SCM({"X": Linear({"X": 1})}), "X -> X is a cycle"),
        (
            lambda: SCM({"X1": Linear({}), "Y": Linear({"X2": 1})}),
            "parent of Y = 'X2': must be one of X1, Y",
        ),
        (lambda: CHAIN.intervene(X=Linear({"Z": 1})), "is a cycle"),
        (
            lambda: SCM({"X": Mechanism((), lambda noise: 1.0)}).sample(3, rng()),
            "X: has shape \\(\\), must have \\(3,\\)",
        ),
        (
            lambda: SCM({"X": Mechanism((), lambda noise: noise * np.nan)}).sample(3, rng()),
            "X: its assignment must return finite numbers",
        ),
        (
            lambda: SCM({"X": bernoulli((), lambda: 2.0)}).sample(3, rng()),
            "probability: returned other numbers, must be within",
        ),
        (
            lambda: plots.causal_graph(plt.figure().add_subplot(), CHAIN, {"X": (0, 0)}),
            "positions: has none for 'Y'",
        ),
    ],
)
def test_bad_input(make, message):
    with pytest.raises(ValueError, match=message):
        make()
