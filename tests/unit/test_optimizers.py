"""One step down an objective: by the formula of each optimiser, and run by run."""

import math

import pytest
import torch
from small import assert_close
from torch import Tensor

from ipo.optimizers import OPTIMIZERS, descend, make_optimizer

START = [[1.0, -2.0], [0.5, 4.0]]  # two runs
SCALES = torch.tensor([[3.0, 1.0], [0.1, 2.0]], dtype=torch.float64)


def leaf(values: object = START) -> Tensor:
    return torch.tensor(values, dtype=torch.float64, requires_grad=True)


def quadratic(weights: Tensor, scales: Tensor = SCALES) -> Tensor:
    """Costs ``[runs]`` with the gradient ``scales * weights``."""
    return 0.5 * (scales * weights.square()).sum(1)


def descended(
    name: str, num_steps: int, learning_rate: float = 0.1, runs: slice = slice(None), **options
) -> Tensor:
    """The weights of some runs after steps down their quadratics."""
    weights = leaf(START[runs])
    optimizer = make_optimizer(name, [weights], learning_rate, **options)
    for _ in range(num_steps):
        descend(optimizer, lambda: quadratic(weights, SCALES[runs]))
    return weights.detach()


def test_plain_step_goes_down_the_gradient():
    """1 - 0.1 * 3, -2 + 0.1 * 2, 0.5 - 0.1 * 0.05, 4 - 0.1 * 8"""
    assert_close(descended("plain", 1), [[0.7, -1.8], [0.495, 3.2]])


def test_plain_decay_is_per_unit_of_learning_rate():
    """As above, and less 0.1 * 0.5 of each weight."""
    expected = [[0.65, -1.7], [0.47, 3.0]]
    assert_close(descended("plain", 1, weight_decay=0.5), expected)


def test_first_adam_step_has_the_size_of_the_learning_rate():
    expected = [[0.9, -1.9], [0.4, 3.9]]
    assert_close(descended("adam", 1), expected, rtol=1e-6)


def test_adam_decay_is_decoupled():
    """As above, and less 0.1 * 0.5 of each weight, which the moments do not see."""
    expected = [[0.85, -1.8], [0.375, 3.7]]
    assert_close(descended("adam", 1, weight_decay=0.5), expected, rtol=1e-6)


def test_adam_is_that_of_torch():
    weights = leaf()
    optimizer = torch.optim.Adam([weights], lr=0.1)
    for _ in range(20):
        optimizer.zero_grad()
        quadratic(weights).sum().backward()
        optimizer.step()
    assert_close(descended("adam", 20), weights.detach(), rtol=1e-12)


def test_adam_is_that_of_its_authors():
    """Kingma and Ba (2015), algorithm 1."""
    weights = torch.tensor(START, dtype=torch.float64)
    m = v = torch.zeros_like(weights)
    for t in range(1, 21):
        gradient = SCALES * weights
        m = 0.9 * m + 0.1 * gradient
        v = 0.999 * v + 0.001 * gradient**2
        weights = weights - 0.1 * (m / (1 - 0.9**t)) / ((v / (1 - 0.999**t)).sqrt() + 1e-8)
    assert_close(descended("adam", 20), weights)


def test_lbfgs_finds_the_minimum_of_a_quadratic():
    assert descended("lbfgs", 20, learning_rate=1.0).abs().max() < 1e-3


@pytest.mark.parametrize("name", ["adam", "plain"])
def test_runs_do_not_influence_each_other(name):
    together = descended(name, 10)
    alone = [descended(name, 10, runs=slice(r, r + 1)) for r in range(2)]
    assert_close(together, torch.cat(alone), rtol=1e-14)


@pytest.mark.parametrize("name", ["adam", "plain"])
@pytest.mark.parametrize("max_gradient_norm", [None, 1.0])
def test_run_without_a_gradient_spoils_only_itself(name, max_gradient_norm):
    weights, healthy = leaf([[math.nan, 1.0], START[1]]), leaf(START[1:])
    for w, scales in ((weights, SCALES), (healthy, SCALES[1:])):
        optimizer = make_optimizer(name, [w], 0.1)
        descend(optimizer, lambda w=w, s=scales: w.prod(1) + quadratic(w, s), max_gradient_norm)
    assert weights[0].isnan().all()
    assert_close(weights[1:].detach(), healthy.detach(), rtol=1e-14)


@pytest.mark.parametrize("name", ["adam", "plain"])
def test_a_run_whose_cost_is_infinite_stays_where_it_is(name):
    """1 / w is infinite at 0, and so is its slope; the other run goes on as if it were alone."""
    weights, alone = leaf([[0.0], [2.0]]), leaf([[2.0]])
    for w in (weights, alone):
        optimizer = make_optimizer(name, [w], 0.1)
        for _ in range(3):
            descend(optimizer, lambda w=w: 1 / w.sum(1))
    assert weights[0].tolist() == [0.0]
    assert torch.equal(weights[1:], alone) and float(alone.detach()) > 2


def test_gradients_are_clipped_run_by_run():
    """Gradients (3, 4), (0.3, 0.4) and 0 of norms 5, 0.5 and 0: only the first is above 1."""
    weights = leaf([[0.0, 0.0]] * 3)
    slopes = torch.tensor([[3.0, 4.0], [0.3, 0.4], [0.0, 0.0]], dtype=torch.float64)
    optimizer = make_optimizer("plain", [weights], 1.0)
    descend(optimizer, lambda: (slopes * weights).sum(1), max_gradient_norm=1.0)
    assert_close(weights.detach(), [[-0.6, -0.8], [-0.3, -0.4], [0.0, 0.0]])


def test_each_leaf_is_clipped_by_its_own_norm():
    vector, matrix = leaf([[0.0, 0.0]]), leaf([[[0.0], [0.0]]])
    optimizer = make_optimizer("plain", [vector, matrix], 1.0)
    slope = torch.tensor([0.3, 0.4], dtype=torch.float64)
    descend(optimizer, lambda: vector @ slope + 10 * (matrix[..., 0] @ slope), 1.0)
    assert_close(vector.detach(), [[-0.3, -0.4]])
    assert_close(matrix.detach(), [[[-0.6], [-0.8]]])


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_only_the_optimisers_own_leaves_move(name):
    own, other = leaf(), leaf()
    descend(make_optimizer(name, [own], 0.1), lambda: quadratic(own) + quadratic(other))
    assert not torch.equal(own, leaf())
    assert torch.equal(other, leaf())
    assert other.grad is None
