"""The scalar control problem: its cost against simulation, and the table that the book shows."""

import numpy as np
import pytest
import torch
from small import assert_close, assert_near

from experiments.games.scalar import START, Cell, gains_of, problems, run_cell, standard
from experiments.games.scalar_control import (
    EDGE,
    costs,
    invariant_gains,
    stationary_cost,
    training_cost,
    unseen_cost,
)
from ipo.causality.small_games import GameSettings, downhill, last
from ipo.game import average


def double(values) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


@pytest.mark.parametrize(("gains", "beta"), [((0.3, 0.2), 0.8), ((0.4, -0.1), -0.5)])
def test_cost_against_a_long_simulation(gains, beta):
    rng = np.random.default_rng(0)
    k_1, k_2 = gains
    s, total = np.zeros(20_000), 0.0
    for step in range(300):
        u = -k_1 * (s + rng.standard_normal(s.size)) - k_2 * (
            beta * s + 0.1 * rng.standard_normal(s.size)
        )
        if step >= 200:
            total += np.mean(s**2 + u**2) / 100
        s = 0.99 * s + u + rng.standard_normal(s.size)
    assert float(stationary_cost(double(gains), double(beta))) == pytest.approx(total, rel=0.01)


def test_unstable_costs_infinitely_much_and_training_is_pushed_back():
    unstable = double([[0.0, 1.0]])
    assert torch.isinf(stationary_cost(unstable, double(-1.0)))
    leaf = unstable.clone().requires_grad_()
    cost = training_cost(leaf, double([-1.0]))
    (gradient,) = torch.autograd.grad(cost.sum(), leaf)
    assert bool(torch.isfinite(cost).all())
    assert float(gradient[0, 1]) > 0  # less of the second sensor


def test_training_cost_is_the_cost_where_stable_and_smooth_at_the_edge():
    gains, beta = double([[0.4, 0.1]]), double([0.5])
    assert_close(training_cost(gains, beta), stationary_cost(gains, beta))
    feedback = 0.99 - np.sqrt(1 - EDGE)  # room to instability is exactly EDGE
    near = [double([[feedback + shift, 0.0]]) for shift in (-1e-7, 1e-7)]
    slopes = []
    for gains in near:
        leaf = gains.requires_grad_()
        slopes.append(torch.autograd.grad(training_cost(leaf, double([0.0])).sum(), leaf)[0])
    assert_close(slopes[0], slopes[1], rtol=1e-3)


def test_invariant_controller():
    k = invariant_gains()
    assert k.tolist() == pytest.approx([0.404, 0.0], abs=5e-4)
    betas = double([-1.0, -0.2, 0.3, 1.0])
    assert_near(stationary_cost(k, betas), torch.full((4,), 2.224).double(), atol=5e-4)
    for move in ((0.01, 0.0), (-0.01, 0.0)):
        assert float(stationary_cost(k + double(move), double(0.0))) > 2.2239


def test_unseen_cost_is_a_mean_and_infinite_if_one_is():
    k = double([[0.3, 0.2], [0.0, 1.0]])
    betas = double([0.5, 1.0])
    expected = (stationary_cost(k[0], betas[0]) + stationary_cost(k[0], betas[1])) / 2
    assert_close(unseen_cost(k, betas)[0], expected)
    assert torch.isinf(unseen_cost(k, double([0.5, -1.0]))[1])


# The table of the chapter, derived and measured before it by other code; digits as it gave them.
TABLE = [
    ((1.0, -0.2), "pooled", (0.375, 0.146), 2.16, (2.32, 2.58, 2.99)),
    ((1.0, -0.2), "ipo_bound0.5", (0.404, 0.000), 2.22, (2.22, 2.22, 2.22)),
    ((1.0, -0.2), "ipo_bound5", (0.404, 0.000), 2.22, (2.22, 2.22, 2.22)),
    ((1.0, 0.5), "pooled", (0.086, 0.670), 1.73, (np.inf,) * 3),
    ((1.0, 0.5), "ipo_bound1", (0.006, 0.599), 1.84, (np.inf,) * 3),
    ((1.0, -0.2, 0.9), "pooled", (0.345, 0.207), 2.10, (2.43, 2.99, 4.26)),
    ((1.0, -0.2, 0.9), "ipo_bound2", (0.074, 0.531), np.inf, (np.inf,) * 3),
    ((1.0, -0.2, 0.9), "ipo_bound0.5", (0.277, 0.167), 2.17, (2.65, 3.35, 4.90)),
    ((1.0, 0.2, -0.5), "pooled", (0.395, 0.079), 2.20, (2.27, 2.36, 2.49)),
    ((1.0, 0.2, -0.5), "ipo_bound2", (0.366, 0.242), 2.30, (2.41, 3.05, 4.73)),
]


@pytest.mark.parametrize(("betas", "label", "expected", "training", "elsewhere"), TABLE)
def test_table_of_the_book(betas, label, expected, training, elsewhere):
    rule = standard(len(betas))[label]
    rule = GameSettings(**(vars(rule) | {"num_rounds": 4000 if label == "ipo_bound5" else 2000}))
    gains = average(last(costs(double([betas])), double([START]), rule))[0]
    assert gains.tolist() == pytest.approx(expected, abs=6e-4)
    own = stationary_cost(gains, double(betas)).mean()
    assert float(own) == pytest.approx(training, abs=6e-3)
    costs_elsewhere = stationary_cost(gains, double([-0.2, -0.6, -1.0]))
    assert costs_elsewhere.tolist() == pytest.approx(elsewhere, abs=6e-3)


@pytest.mark.parametrize("start", [(0.3, 0.1), (0.1, -0.2), (0.5, 0.3)])
def test_bounded_players_find_the_invariant_controller_from_everywhere(start):
    rule = GameSettings("ipo", learning_rate=0.2, num_rounds=2000, bound=2.0, max_gradient_norm=1.0)
    players = last(costs(double([[1.0, -0.2]])), double([start]), rule)
    assert_near(average(players)[0], invariant_gains(), atol=1e-6)


def test_with_three_domains_each_gain_is_decided_by_another_one():
    """The vote, gain by gain: nobody's own optimum comes out, the median domain's neither."""
    betas = (1.0, 0.2, -0.5)
    rule = GameSettings("ipo", learning_rate=0.3, num_rounds=2500, bound=2.0, max_gradient_norm=1.0)
    players = last(costs(double([betas])), double([START]), rule)
    contents = downhill(costs(double([betas])), average(players))[0].abs() < 1e-6
    assert contents.tolist() == [[False, True], [True, False], [False, False]]
    alone = last(costs(double([[0.2]])), double([START]), GameSettings("pooled", num_rounds=2000))
    assert float((average(players) - average(alone)).norm()) > 1


# --------------------------------------------------------------------------------- families


def test_families_of_problems():
    rule = standard(3)["pooled"]
    grid = Cell("pooled", rule, (None, None, 0.5), "grid")
    assert_close(
        problems(grid, [0, 22, 440]), double([[-1, -1, 0.5], [-0.9, -0.9, 0.5], [1, 1, 0.5]])
    )
    random = Cell("pooled", rule, (None,) * 3, "random")
    assert torch.equal(problems(random, [4, 7])[1:], problems(random, [7]))
    assert bool((problems(random, range(50)).abs() <= 1).all())
    assert grid.columns["betas"] == "* * 0.5"


def test_rows_hold_the_gains_of_every_problem_in_order():
    rule = GameSettings("pooled", num_rounds=20)
    cell = Cell("pooled", rule, (None, None), "random")
    rows = run_cell(cell, [5, 3])
    assert_close(
        gains_of(rows),
        average(last(costs(problems(cell, [3, 5])), double([START, START]), rule)),
        rtol=1e-7,
    )


def test_unknown_start():
    with pytest.raises(ValueError, match="did you mean 'grid'"):
        Cell("pooled", standard(2)["pooled"], (1.0,), "grids")
