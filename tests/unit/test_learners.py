"""The four methods: against slow versions, known limits, and changes that must not matter."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
import straightforward
import torch
from small import assert_close, paper_problem, random_gain, trained_gain
from torch import Tensor

from ipo.game import slope
from ipo.lqr import LQR, invariant_gain, minimum_norm_gain, project, row_space, training_costs
from ipo.lqr_learners import (
    LQR_CONTROLS,
    LQR_METHODS,
    DomainCost,
    LQRSettings,
    PooledCost,
    published_lqr,
    train,
)
from ipo.optimizers import descend, make_optimizer

SEEDS = [0, 1]
UNLAYERED = ("gradient_descent", "ipo_fixed_phi")
LAYERED = ("overparameterized", "ipo_variable_phi")


def settings(method: str, optimizer: str = "adam", **options) -> LQRSettings:
    """LQRSettings in which little training does much."""
    defaults = {"learning_rate": 0.01, "num_iterations": 20, "num_hidden": 5}
    if method in LAYERED:
        defaults |= {"phi_scale": 0.1, "gain_scale": 0.1}
    return LQRSettings(method, optimizer, **(defaults | options))


def permuted_domains(problem: LQR, order: Sequence[int]) -> LQR:
    return replace(problem, seen=problem.W_train[:, order].transpose(1, 2).flatten(2))


def permuted_runs(problem: LQR, order: Sequence[int]) -> LQR:
    return LQR(**{name: matrix[order] for name, matrix in vars(problem).items()})


def outside(K: Tensor, problem: LQR) -> Tensor:
    """Norms ``[R]`` of what no training domain can show."""
    return torch.linalg.matrix_norm(K - project(K, row_space(problem)))


# ---------------------------------------------------------------------- slow versions


def slow_layers(problem: LQR, chosen: LQRSettings, seed: int) -> tuple[Tensor, Tensor]:
    """The documented start: a stream spawned from the seed gives ``Phi``, then the controller."""
    random = np.random.default_rng(np.random.SeedSequence(seed).spawn(1)[0])
    n_u, n_o = problem.gain_shape
    Phi = chosen.phi_scale * random.standard_normal((chosen.num_hidden, n_o))
    K = chosen.gain_scale * random.standard_normal((n_u, chosen.num_hidden))
    return torch.tensor(Phi, requires_grad=True), torch.tensor(K, requires_grad=True)


def slow_step(optimizer: torch.optim.Optimizer, cost: Tensor) -> None:
    optimizer.zero_grad()
    cost.backward()
    optimizer.step()


def pooled(K: Tensor, A: Tensor, Ws: list[Tensor]) -> Tensor:
    return sum(straightforward.cost(K, A, W) for W in Ws) / len(Ws)


def slow_overparameterized(problem: LQR, chosen: LQRSettings, r: int) -> Tensor:
    A, Ws = problem.A[r], list(problem.W_train[r])
    Phi, K = slow_layers(problem, chosen, SEEDS[r])
    optimizer = torch.optim.Adam([Phi, K], lr=chosen.learning_rate)
    for _ in range(chosen.num_iterations):
        slow_step(optimizer, pooled(K @ Phi, A, Ws))
    return (K @ Phi).detach()


def slow_ipo_variable_phi(problem: LQR, chosen: LQRSettings, r: int) -> Tensor:
    A, Ws = problem.A[r], list(problem.W_train[r])
    Phi, K = slow_layers(problem, chosen, SEEDS[r])
    players = [K.detach().clone().requires_grad_() for _ in Ws]
    Phi_optimizer, *optimizers = (
        torch.optim.Adam([w], lr=chosen.learning_rate) for w in (Phi, *players)
    )
    for _ in range(chosen.num_iterations):
        slow_step(Phi_optimizer, pooled(sum(players) / len(Ws) @ Phi, A, Ws))
        for optimizer, W in zip(optimizers, Ws, strict=True):
            slow_step(optimizer, straightforward.cost(sum(players) / len(Ws) @ Phi, A, W))
    return (sum(players) / len(Ws) @ Phi).detach()


def slow_gradient_descent(problem: LQR, chosen: LQRSettings, r: int) -> Tensor:
    return straightforward.gradient_descent(
        problem.A[r], list(problem.W_train[r]), chosen.num_iterations, chosen.learning_rate
    )


def slow_ipo_fixed_phi(problem: LQR, chosen: LQRSettings, r: int) -> Tensor:
    return straightforward.ipo_fixed_phi(
        problem.A[r], list(problem.W_train[r]), chosen.num_iterations, chosen.learning_rate
    )


def slow_in_turn(problem: LQR, chosen: LQRSettings, r: int) -> Tensor:
    A, Ws = problem.A[r], list(problem.W_train[r])
    K = torch.zeros(*problem.gain_shape, dtype=A.dtype, requires_grad=True)
    optimizer = torch.optim.Adam([K], lr=chosen.learning_rate)
    for _ in range(chosen.num_iterations):
        for W in Ws:
            slow_step(optimizer, straightforward.cost(K, A, W))
    return K.detach()


def slow_ensemble(problem: LQR, chosen: LQRSettings, r: int) -> Tensor:
    A, Ws = problem.A[r], list(problem.W_train[r])
    players = [torch.zeros(*problem.gain_shape, dtype=A.dtype, requires_grad=True) for _ in Ws]
    optimizers = [torch.optim.Adam([w], lr=chosen.learning_rate) for w in players]
    for _ in range(chosen.num_iterations):
        for optimizer in optimizers:
            slow_step(optimizer, pooled(sum(players) / len(Ws), A, Ws))
    return (sum(players) / len(Ws)).detach()


SLOW = (slow_gradient_descent, slow_overparameterized, slow_ipo_fixed_phi, slow_ipo_variable_phi)
SLOW += (slow_in_turn, slow_ensemble)


@pytest.mark.parametrize("slow", SLOW, ids=(*LQR_METHODS, *LQR_CONTROLS))
def test_learns_what_the_slow_version_learns(slow: Callable):
    problem = paper_problem(SEEDS)
    chosen = settings(slow.__name__.removeprefix("slow_"), num_iterations=40)
    fast = trained_gain(problem, chosen, SEEDS)
    for r in range(len(SEEDS)):
        assert_close(fast[r], slow(problem, chosen, r), rtol=1e-7)


# ------------------------------------------------------------------------ known limits


@pytest.mark.parametrize("optimizer", ["adam", "plain"])
def test_gradient_descent_is_the_game_of_one_player_that_owns_all_domains(optimizer):
    problem = paper_problem()
    chosen = settings("gradient_descent", optimizer)
    K = torch.zeros(2, *problem.gain_shape).double().requires_grad_()
    own = make_optimizer(optimizer, [K], chosen.learning_rate)
    for _ in range(chosen.num_iterations):
        descend(own, lambda: training_costs(K, problem).mean(1))
    assert_close(trained_gain(problem, chosen, SEEDS), K.detach())


def test_ipo_in_one_domain_is_gradient_descent():
    problem = paper_problem(num_domains=1)
    gains = [trained_gain(problem, settings(method), SEEDS) for method in UNLAYERED]
    assert torch.equal(*gains)


@pytest.mark.parametrize(
    ("method", "learning_rate"), [("gradient_descent", 0.1), ("ipo_fixed_phi", 0.3)]
)
def test_plain_training_converges_to_the_minimum_norm_gain(method, learning_rate):
    problem = paper_problem(num_domains=2, dim_distractor=12, contraction=0.7)
    chosen = settings(method, "plain", learning_rate=learning_rate, num_iterations=1000)
    assert_close(trained_gain(problem, chosen, SEEDS), minimum_norm_gain(problem), rtol=1e-3)


@pytest.mark.parametrize("method", UNLAYERED)
@pytest.mark.parametrize("optimizer", ["plain", "lbfgs"])
def test_gradients_never_leave_the_row_space(method, optimizer):
    problem = paper_problem(num_domains=2)
    K = trained_gain(problem, settings(method, optimizer), SEEDS)
    assert (outside(K, problem) < 1e-12).all()
    assert (torch.linalg.matrix_norm(K) > 0.1).all()


@pytest.mark.parametrize("method", UNLAYERED)
def test_adam_leaves_the_row_space(method):
    problem = paper_problem(num_domains=2)
    K = trained_gain(problem, settings(method), SEEDS)
    assert (outside(K, problem) > 0.1 * torch.linalg.matrix_norm(K)).all()


@pytest.mark.parametrize("method", LQR_METHODS)
@pytest.mark.parametrize("optimizer", ["adam", "plain", "lbfgs"])
def test_training_lowers_the_cost_in_every_run(method, optimizer):
    problem = paper_problem()
    reports = train(problem, settings(method, optimizer), SEEDS, checkpoints=[0])
    (_, first), (_, last) = reports
    before, after = (training_costs(K, problem).mean(1) for K in (first, last))
    assert (after < 0.95 * before).all()


# ------------------------------------------------------------- what must not matter


@pytest.mark.parametrize("method", ["gradient_descent", "overparameterized"])
def test_order_of_domains_does_not_matter_to_pooled_training(method):
    problem = paper_problem()
    gains = [
        trained_gain(permuted_domains(problem, order), settings(method), SEEDS)
        for order in ([0, 1, 2], [2, 0, 1])
    ]
    assert_close(*gains)


def test_order_of_players_matters_to_second_order_in_the_step_only():
    problem = paper_problem()
    turned = permuted_domains(problem, [2, 1, 0])

    def moves(learning_rate: float) -> tuple[Tensor, Tensor]:
        """Of the average in one round, in both orders."""
        chosen = settings("ipo_fixed_phi", "plain", learning_rate=learning_rate, num_iterations=1)
        return trained_gain(problem, chosen, SEEDS), trained_gain(turned, chosen, SEEDS)

    large, small = moves(1e-4), moves(1e-5)
    norm = torch.linalg.matrix_norm
    assert_close(norm(large[0]) / norm(small[0]), [10, 10], rtol=0.1)
    assert_close(norm(large[0] - large[1]) / norm(small[0] - small[1]), [100, 100], rtol=0.1)


@pytest.mark.parametrize("method", LQR_METHODS)
@pytest.mark.parametrize("optimizer", ["adam", "plain", "lbfgs"])
def test_runs_together_are_the_runs_alone(method, optimizer):
    problem, chosen = paper_problem(SEEDS), settings(method, optimizer)
    together = trained_gain(problem, chosen, SEEDS)
    alone = [trained_gain(paper_problem([seed]), chosen, [seed]) for seed in SEEDS]
    assert_close(together, torch.cat(alone))


@pytest.mark.parametrize("method", LQR_METHODS)
def test_permuting_the_runs_permutes_what_they_learn(method):
    problem, order = paper_problem([0, 1, 2]), [2, 0, 1]
    gain = trained_gain(problem, settings(method), [0, 1, 2])
    assert_close(trained_gain(permuted_runs(problem, order), settings(method), order), gain[order])


@pytest.mark.parametrize("method", UNLAYERED)
def test_run_that_diverges_spoils_only_itself(method):
    """Close to instability the gradient is huge, and one plain step leads far away."""
    problem = paper_problem(SEEDS)
    start = torch.zeros(2, *problem.gain_shape).double()
    # The invariant gain of a problem is c A; this one leaves A - F = 0.999 / 0.9 A.
    F = (1 - 0.999 / 0.9) * problem.A[0]
    start[0, :, :4] = F @ torch.linalg.inv(problem.seen[0, :4, :4])
    chosen = settings(method, "plain")
    gain = trained_gain(problem, chosen, SEEDS, start=start)
    assert gain[0].isnan().all()
    assert_close(gain[1:], trained_gain(paper_problem(SEEDS[1:]), chosen, SEEDS[1:]))


# ----------------------------------------------------------------------------- reports


@pytest.mark.parametrize("method", LQR_METHODS)
def test_reports_come_at_the_checkpoints_and_at_the_end(method):
    problem = paper_problem()
    chosen = settings(method, num_iterations=5)
    reports = list(train(problem, chosen, SEEDS, checkpoints=[3, 0]))
    assert [iteration for iteration, _ in reports] == [0, 3, 5]
    for iteration, gain in reports:  # not changed by what came after
        shorter = replace(chosen, num_iterations=iteration)
        assert torch.equal(gain, trained_gain(problem, shorter, SEEDS))


@pytest.mark.parametrize("method", UNLAYERED)
def test_training_begins_at_the_start_and_does_not_change_it(method):
    problem = paper_problem()
    start = random_gain(problem)
    given = start.clone()
    (_, first), (_, last) = train(problem, settings(method), SEEDS, start=start, checkpoints=[0])
    assert_close(first, given, rtol=1e-15)
    assert torch.equal(start, given)
    assert not torch.allclose(last, given)


@pytest.mark.parametrize("method", UNLAYERED)
def test_optimum_is_a_fixed_point(method):
    problem = paper_problem()
    start = invariant_gain(problem)
    gain = trained_gain(problem, settings(method, "plain"), SEEDS, start=start)
    assert_close(gain, start)


@pytest.mark.parametrize("method", LAYERED)
def test_the_seed_decides_the_random_start(method):
    problem = paper_problem(SEEDS)
    gains = [
        trained_gain(problem, settings(method, num_iterations=0), seeds)
        for seeds in ([0, 1], [0, 2])
    ]
    assert torch.equal(gains[0][0], gains[1][0])
    assert not torch.allclose(gains[0][1], gains[1][1])


@pytest.mark.parametrize("method", LQR_METHODS)
def test_published_settings_are_the_papers(method):
    chosen = published_lqr(method)
    rate = 5e-4 if method.startswith("ipo") else 1e-3
    assert (chosen.method, chosen.optimizer) == (method, "adam")
    assert (chosen.learning_rate, chosen.num_iterations, chosen.num_hidden) == (rate, 5000, 200)
    assert (chosen.weight_decay, chosen.max_gradient_norm) == (0, None)


def test_slope_of_a_cost_is_that_of_autograd():
    problem = paper_problem()
    K = random_gain(problem)
    for cost in (PooledCost(problem, problem.seen), DomainCost(problem, problem.W_test)):
        costs, (gradient,) = cost.slope(K, share=0.25)
        expected, (by_torch,) = slope(lambda K, cost=cost: cost(K), K, share=0.25)
        assert_close(costs, expected)
        assert_close(gradient, by_torch)
