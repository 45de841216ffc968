"""The game between short vectors: rounds by hand, the vote against the theorem, its symmetries."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from small import assert_close, assert_near

from ipo.causality.predictors import PredictorSettings, Regression, irm_objective
from ipo.causality.regressions import correlated_noise, effect_of_target
from ipo.causality.small_games import (
    GameSettings,
    downhill,
    gap,
    last,
    play,
    residual,
    vote,
)
from ipo.game import average

coefficients = st.lists(st.integers(-10, 10), min_size=2, max_size=5).map(
    lambda values: [value / 10 for value in values]
)
bounds = st.sampled_from([0.3, 1.0, 4.0])


def separable(optima: torch.Tensor, curvature: torch.Tensor) -> Regression:
    """``J_d(w) = sum_i c_di (w_i - b_di)^2``, both ``[R, E, P]``."""
    gram = torch.diag_embed(curvature)
    return Regression(gram, curvature * optima, (curvature * optima.square()).sum(-1))


def double(values) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


# ------------------------------------------------------------------------------- rounds, by hand


@pytest.mark.parametrize(
    ("order", "expected"), [("in_turn", [0.5, 1.375]), ("together", [0.5, 1.5])]
)
def test_one_round_by_hand(order, expected):
    """J_d = (p - t_d)^2 / 2 with t = 1, 3; player 2 sees p = 1/4 in turn, and 0 together."""
    targets = [lambda w, t=t: 0.5 * (w[:, 0] - t) ** 2 for t in (1.0, 3.0)]
    rule = GameSettings("ipo", learning_rate=1.0, num_rounds=1, order=order)
    players = last(targets, double([[0.0]]), rule)
    assert players.flatten().tolist() == expected


def test_bounded_players_are_put_back():
    targets = [lambda w, t=t: 0.5 * (w[:, 0] - t) ** 2 for t in (10.0, -10.0)]
    rule = GameSettings("ipo", learning_rate=10.0, num_rounds=3, bound=0.5)
    assert last(targets, double([[0.0]]), rule).flatten().tolist() == [0.5, -0.5]


def test_players_may_start_apart_and_start_is_kept():
    problem = correlated_noise(double([[0.5, -0.5]]))
    start = double([[[1.0, 2.0], [3.0, 4.0]]])
    (number, players), *_ = play(problem.costs, start, GameSettings("ipo", num_rounds=2), [0])
    assert number == 0
    assert torch.equal(players, start)


@pytest.mark.parametrize("method", ["pooled", "ensemble"])
def test_players_that_own_all_domains_find_pooled_least_squares(method):
    problem = effect_of_target(double([[1.0, -0.4, 0.3]]))
    rule = GameSettings(method, learning_rate=0.3, num_rounds=2000)
    assert_close(average(last(problem.costs, double([[0.0, 0.0]]), rule)), problem.pooled())


def test_one_player_in_turn_steps_down_one_domain_after_the_other():
    problem = effect_of_target(double([[1.0, -0.4]]))
    by_hand = double([[0.2, 0.1]])
    for cost in problem.costs * 2:
        leaf = by_hand.clone().requires_grad_()
        by_hand = by_hand - 0.1 * torch.autograd.grad(cost(leaf).sum(), leaf)[0]
    rule = GameSettings("in_turn", learning_rate=0.1, num_rounds=2)
    assert_close(last(problem.costs, double([[0.2, 0.1]]), rule), by_hand.unsqueeze(1))


def test_separate_players_find_their_own_optima():
    problem = effect_of_target(double([[1.0, -0.4, 0.3]]))
    players = last(problem.costs, double([[0.0, 0.0]]), GameSettings("separate", num_rounds=3000))
    assert_close(players, problem.optima)


@pytest.mark.parametrize("order", ["in_turn", "together"])
def test_problems_do_not_interact(order):
    rho = double([[0.8, -0.4], [0.9, 0.5], [-0.3, 0.1]])
    rule = GameSettings("ipo", "adam", learning_rate=0.01, num_rounds=50, order=order)
    together = last(correlated_noise(rho).costs, torch.zeros(3, 2).double(), rule)
    for r in range(3):
        alone = last(correlated_noise(rho[r : r + 1]).costs, torch.zeros(1, 2).double(), rule)
        assert_close(together[r : r + 1], alone, rtol=1e-12)


# --------------------------------------------------- plain steps are pooled gradient descent


@pytest.mark.parametrize("num_domains", [2, 3, 4])
def test_together_plain_steps_are_pooled_gradient_descent(num_domains):
    problem = effect_of_target(double([np.linspace(-0.5, 1, num_domains).tolist()]))
    start = double([[0.2, 0.1]])
    pooled = GameSettings("pooled", learning_rate=0.05, num_rounds=40)
    game = GameSettings("ipo", learning_rate=0.05 * num_domains, num_rounds=40, order="together")
    assert_close(
        average(last(problem.costs, start, game)), average(last(problem.costs, start, pooled))
    )


def test_in_turn_the_difference_is_of_first_order():
    problem = effect_of_target(double([[1.0, -0.4]]))
    start = double([[0.2, 0.1]])
    errors = []
    for eta in (0.02, 0.01, 0.005):
        num_rounds = round(1 / eta)
        pooled = last(problem.costs, start, GameSettings("pooled", "plain", eta, num_rounds))
        game = last(problem.costs, start, GameSettings("ipo", "plain", 2 * eta, num_rounds))
        errors.append(float((average(game) - average(pooled)).norm()))
    ratios = [a / b for a, b in itertools.pairwise(errors)]
    assert all(1.8 < ratio < 2.2 for ratio in ratios), ratios


def test_without_bounds_players_drift_at_constant_speed_and_cancel():
    """At the pooled optimum 0.2 player d moves by eta (rho_d - 0.2) in every round, for ever."""
    problem = correlated_noise(double([[0.8, -0.4]]))
    rule = GameSettings("ipo", learning_rate=0.1, num_rounds=1500)
    (_, early), (_, late) = play(problem.costs, double([[1.0, 0.0]]), rule, [500])
    drift = (late - early)[0, :, 1]
    # 1000 rounds of 0.1 * 0.6, up to the first order of moving in turn
    assert_near(drift.sum(), double(0.0), atol=1e-9)
    assert float(drift[0]) == pytest.approx(60, rel=0.06)
    assert float(gap(problem.costs, late, GameSettings("pooled", learning_rate=1.0))) > 0.3


# --------------------------------------------------------------------------------- the vote


@pytest.mark.parametrize(
    ("optima", "bound", "expected"),
    [
        ((0.8, -0.4), 2.0, 0.0),  # opposite signs
        ((0.8, 0.4), 2.0, 0.4),  # the same sign: the one nearer to zero
        ((-0.8, -0.4), 2.0, -0.4),
        ((0.8, 0.4), 0.3, 0.3),  # a bound nearer than that
        ((0.9, 0.5, -0.6), 5.0, 0.5),  # the median domain
        ((0.9, 0.5, -0.6), 0.6, 0.2),  # both of a majority at the bound: 0.6 / 3
        ((0.9, 0.5, 0.3, -0.6), 5.0, 0.3),  # the middle wish nearer to zero
        ((0.9, 0.5, -0.3, -0.6), 5.0, 0.0),
    ],
)
def test_vote_by_hand(optima, bound, expected):
    assert float(vote(double(optima).unsqueeze(1), bound)) == pytest.approx(expected)


@given(coefficients, bounds, st.integers(0, 2**31))
def test_bounded_players_end_at_the_vote(optima, bound, seed):
    """Whatever the curvatures: how much a domain cares has no influence."""
    curvature = double(np.random.default_rng(seed).uniform(0.5, 2.0, len(optima)))
    problem = separable(double(optima)[None, :, None], curvature[None, :, None])
    rule = GameSettings("ipo", learning_rate=0.5 * len(optima), num_rounds=400, bound=bound)
    players = last(problem.costs, double([[0.0]]), rule)
    if float(residual(problem.costs, players, bound)) < 1e-9:  # else still on their way
        assert_near(average(players), vote(problem.optima, bound), atol=1e-7)
    # Where they are on their way, the theorem's players are an equilibrium all the same.
    p = vote(problem.optima, bound)
    assert float(residual(problem.costs, equilibrium(problem, bound), bound)) < 1e-9
    assert_close(average(equilibrium(problem, bound)), p)


def equilibrium(problem: Regression, bound: float) -> torch.Tensor:
    """Players whose average is the vote: at their bounds, and who wants just that makes it so."""
    p = vote(problem.optima, bound)
    optima = problem.optima
    undecided = (optima - p.unsqueeze(1)).abs() < 1e-12
    players = bound * torch.sign(optima - p.unsqueeze(1)).masked_fill(undecided, 0.0)
    lacking = optima.shape[1] * p - players.sum(1)
    return players + undecided * (lacking / undecided.sum(1).clamp(min=1)).unsqueeze(1)


@given(st.floats(-1, 1), st.floats(-1, 1), st.sampled_from([2.0, 5.0]))
def test_vote_of_two_is_the_published_theorem(one, other, bound):
    """Opposite signs: zero. The same sign: the smaller coefficient (Ahuja et al., 2021)."""
    expected = 0.0 if one * other <= 0 else min(one, other, key=abs)
    assert float(vote(double([[one], [other]]), bound)) == pytest.approx(expected)


@given(coefficients, st.integers(0, 2**31))
def test_the_vote_does_not_depend_on_the_order_of_the_domains(optima, seed):
    shuffled = np.random.default_rng(seed).permutation(optima)
    assert_close(vote(double(optima)[:, None], 2.0), vote(double(shuffled)[:, None], 2.0))


@pytest.mark.parametrize("optimizer", ["plain", "adam"])
@pytest.mark.parametrize("order", list(itertools.permutations(range(3))))
def test_together_the_order_of_players_does_not_matter(optimizer, order):
    spurious = double([[0.9, -0.2, 0.4]])
    rule = GameSettings("ipo", optimizer, 0.02, num_rounds=200, bound=1.0, order="together")
    start = double([[0.0, 0.0]])
    players = last(effect_of_target(spurious).costs, start, rule)
    permuted = last(effect_of_target(spurious[:, list(order)]).costs, start, rule)
    assert_close(permuted, players[:, list(order)])


@pytest.mark.parametrize("order", list(itertools.permutations(range(3))))
def test_in_turn_bounded_players_end_at_the_same_average_in_any_order(order):
    spurious = double([[0.9, -0.2, 0.4]])
    rule = GameSettings("ipo", learning_rate=1.0, num_rounds=2000, bound=2.0)
    players = last(correlated_noise(spurious[:, list(order)]).costs, double([[0.0, 0.0]]), rule)
    assert_near(average(players), double([[1.0, 0.4]]), atol=1e-9)


@pytest.mark.parametrize("spurious", [(1.0, -0.4), (0.3, -2.0), (1.0, 0.5, -0.3, -0.7)])
def test_an_effect_is_ignored_where_signs_draw_even_though_features_are_correlated(spurious):
    problem = effect_of_target(double([spurious]), causal=0.7)
    rule = GameSettings("ipo", learning_rate=1.0, num_rounds=1500, bound=1.5)
    players = last(problem.costs, double([[0.1, 0.2]]), rule)
    assert_near(average(players), double([[0.7, 0.0]]), atol=1e-7)
    assert float(gap(problem.costs, players, replace(rule, method="pooled"))) < 1e-9


def test_the_weight_of_a_domain_does_not_matter_to_bounded_players():
    costs = correlated_noise(double([[0.8, -0.4]])).costs
    heavy = [costs[0], lambda w: 50 * costs[1](w)]
    rule = GameSettings("ipo", learning_rate=0.05, num_rounds=4000, bound=0.5)
    start = double([[1.0, 0.0]])
    start[:, 0] = 0.5
    for objectives in (costs, heavy):
        assert float(average(last(objectives, start, rule))[0, 1]) == pytest.approx(0, abs=1e-9)


def test_adam_stays_where_the_votes_are_even_and_bounds_do_not():
    """The book's correction of a tempting conclusion: Adam does not choose zero by itself."""
    costs = correlated_noise(double([[0.8, -0.8]])).costs
    start = double([[1.0, 0.3]])
    adam = GameSettings("ipo", "adam", learning_rate=1e-3, num_rounds=3000)
    bounded = GameSettings("ipo", learning_rate=0.5, num_rounds=3000, bound=2.0)
    assert float(average(last(costs, start, adam))[0, 1]) == pytest.approx(0.3, abs=0.02)
    assert float(average(last(costs, start, bounded))[0, 1]) == pytest.approx(0.0, abs=1e-9)


# ----------------------------------------------------------------------- regression problems


def test_costs_and_optima_against_samples():
    rng = np.random.default_rng(0)
    x_1, noise, other = rng.standard_normal((3, 400_000))
    w = (0.7, -0.2)
    y = 0.8 * x_1 + noise
    effect = -0.6 * y + other
    related = 0.6 * noise + 0.8 * other
    for problem, x_2, d in (
        (effect_of_target(double([[1.0, -0.6]]), 0.8), effect, 1),
        (correlated_noise(double([[0.6, 0.0]]), 0.8), related, 0),
    ):
        sampled = np.mean((y - w[0] * x_1 - w[1] * x_2) ** 2)
        assert float(problem.costs[d](double([w]))) == pytest.approx(sampled, rel=0.01)
        fitted = np.linalg.lstsq(np.stack([x_1, x_2], 1), y)[0]
        assert_near(problem.optima[0, d], double(fitted), atol=0.01)


def test_invariant_predictor_has_the_same_slope_everywhere():
    problem = effect_of_target(double([[1.0, -0.6]]), causal=0.8)
    for cost in problem.costs:
        assert float(cost(double([[0.8, 0.0]]))) == pytest.approx(1.0)  # the noise of y
    # and the gradient of the causal weight vanishes there in every domain
    assert_close(downhill(problem.costs, double([[0.8, 0.0]]))[..., 0], double([[0.0, 0.0]]))


def test_pooled_least_squares_weighs_by_shares():
    problem = correlated_noise(double([[0.8, -0.4]]))
    assert_close(problem.pooled(), double([[1.0, 0.2]]))
    assert_close(problem.pooled([3, 1]), double([[1.0, 0.5]]))


def test_irm_penalty_against_a_numerical_derivative():
    problem = effect_of_target(double([[1.0, -0.6]]))
    w, step = double([[0.4, 0.3]]), 1e-5
    slopes = [(cost(w * (1 + step)) - cost(w * (1 - step))) / (2 * step) for cost in problem.costs]
    risks = [cost(w) for cost in problem.costs]
    expected = sum(r + 7.0 * s**2 for r, s in zip(risks, slopes, strict=True)) / 2
    objective = irm_objective(problem, PredictorSettings(penalty=7.0), w.unsqueeze(-1))
    assert_close(objective, expected, rtol=1e-7)


# --------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: last([lambda w: w.sum(1) / 0], double([[1.0]]), GameSettings("ipo")),
            "infinitely much in domain 0",
        ),
        (lambda: correlated_noise(double([[0.5, 1.2]])), "holds 1.2, must be within"),
        (
            lambda: last([torch.sum] * 2, double([[[0.0]] * 3]), GameSettings("ipo")),
            "start: is of 3 players, must be of 2",
        ),
    ],
)
def test_bad_input_names_the_thing_and_the_rule(make, message):
    with pytest.raises(ValueError, match=message):
        make()
