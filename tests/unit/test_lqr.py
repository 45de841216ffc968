"""The LQR problem: its cost and gradient, its solutions, the draws of the published runs."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import straightforward
import torch
from hypothesis import given
from hypothesis import strategies as st
from small import assert_close, general_problem, paper_problem, random_gain
from torch import Tensor

from ipo.lqr import (
    LQR,
    expected_cost,
    invariant_gain,
    minimum_norm_gain,
    oracle_cost,
    project,
    riccati_gain,
    row_space,
    sample_problem,
    simulate,
    spectral_radius,
    split_domains,
    training_costs,
)

problems = st.builds(
    general_problem,
    seed=st.integers(0, 10_000),
    n_x=st.integers(1, 5),
    n_u=st.integers(1, 3),
    n_y=st.integers(0, 5),
    num_runs=st.integers(1, 3),
    num_domains=st.integers(1, 3),
)


def kronecker_cost(K: Tensor, problem: LQR, W: Tensor, r: int) -> Tensor:
    """``tr P`` of run r, with ``vec P = (I - M' kron M')^-1 vec(Q + F'R F)``."""
    F = K[r] @ W[r]
    M = problem.A[r] - problem.B[r] @ F
    n = len(M)
    system = torch.eye(n * n, dtype=M.dtype) - torch.kron(M.T.contiguous(), M.T.contiguous())
    constant = problem.Q[r] + F.T @ problem.R[r] @ F
    return torch.linalg.solve(system, constant.reshape(-1)).reshape(n, n).trace()


def state_feedback(problem: LQR) -> LQR:
    """The same problem with the state itself as the observation."""
    identity = torch.eye(problem.A.shape[-1], dtype=problem.A.dtype).expand_as(problem.A)
    return replace(problem, seen=identity, W_test=identity)


def uncontrolled(A: list[list[float]], dtype: torch.dtype = torch.float64) -> Tensor:
    """The cost of doing nothing under the dynamics ``A``, with ``Q = I``."""
    matrix = torch.tensor([A], dtype=dtype)
    identity = torch.eye(len(A), dtype=dtype)[None]
    problem = LQR(matrix, identity, identity, identity, seen=identity, W_test=identity)
    return expected_cost(torch.zeros_like(identity), problem, identity)


# -------------------------------------------------------------------------------- cost


@given(problems)
def test_cost_solves_the_lyapunov_equation(problem):
    K, W = random_gain(problem), problem.W_test
    F = K @ W
    loops = (problem.A - problem.B @ F).numpy()
    constants = (problem.Q + F.mT @ problem.R @ F).numpy()
    expected = [
        np.trace(scipy.linalg.solve_discrete_lyapunov(M.T, C))
        for M, C in zip(loops, constants, strict=True)
    ]
    assert_close(expected_cost(K, problem, W), expected)


def roll_out(K: Tensor, problem: LQR, states: Tensor, num_steps: int) -> Tensor:
    """Summed cost ``[N]`` of run 0 in the test domain, step by step from ``states [N, n_x]``."""
    total = torch.zeros(len(states), dtype=states.dtype)
    for _ in range(num_steps):
        actions = -(states @ problem.W_test[0].T) @ K[0].T
        total += ((states @ problem.Q[0]) * states).sum(1)
        total += ((actions @ problem.R[0]) * actions).sum(1)
        states = states @ problem.A[0].T + actions @ problem.B[0].T
    return total


def test_cost_is_the_mean_over_random_starts():
    problem = general_problem(seed=3)
    K = random_gain(problem)
    cost = float(expected_cost(K, problem, problem.W_test)[0])
    generator = torch.Generator().manual_seed(0)
    starts = torch.randn(100_000, 3, generator=generator, dtype=torch.float64)
    costs = roll_out(K, problem, starts, num_steps=200)
    standard_error = float(costs.std()) / len(costs) ** 0.5
    # Four standard errors: one seed in 16,000 would fail by chance, and this one is fixed.
    assert 4 * standard_error < 0.02 * cost
    assert abs(float(costs.mean()) - cost) < 4 * standard_error


def test_cost_is_the_sum_over_unit_starts():
    """No sampling error: the mean of x'Px over N(0, I) is the sum over an orthonormal basis."""
    problem = general_problem(seed=4)
    K = random_gain(problem)
    costs = roll_out(K, problem, torch.eye(3, dtype=torch.float64), num_steps=1000)
    assert_close(expected_cost(K, problem, problem.W_test)[:1], costs.sum()[None])


@pytest.mark.parametrize("contraction", [0.1, 0.9, 0.99, 0.9999])
def test_cost_of_doing_nothing_in_the_papers_problem(contraction):
    problem = paper_problem(dim_state=4, contraction=contraction)
    cost = expected_cost(torch.zeros(2, *problem.gain_shape).double(), problem, problem.W_test)
    assert_close(cost, [4 / (1 - contraction**2)] * 2)


def test_training_costs_are_the_costs_in_each_domain():
    problem = general_problem(num_runs=3, num_domains=4)
    K = random_gain(problem)
    each = [expected_cost(K, problem, W) for W in problem.W_train.unbind(1)]
    assert_close(training_costs(K, problem), torch.stack(each, dim=1), rtol=1e-12)


# ---------------------------------------------------------------------------- gradient


@given(problems)
def test_gradient_is_that_of_automatic_differentiation(problem):
    K = random_gain(problem).requires_grad_()
    W = problem.W_test
    (gradient,) = torch.autograd.grad(expected_cost(K, problem, W).sum(), K)
    slow = sum(kronecker_cost(K, problem, W, r) for r in range(problem.num_runs))
    assert_close(gradient, *torch.autograd.grad(slow, K), rtol=1e-8)


@given(problems)
def test_gradient_is_that_of_central_differences(problem):
    K = random_gain(problem).requires_grad_()
    weights = torch.arange(1.0, 1 + problem.num_runs * problem.num_domains).double()
    assert torch.autograd.gradcheck(
        lambda gain: (training_costs(gain, problem).flatten() * weights).sum(), K, eps=1e-6
    )


# ------------------------------------------------------------------------- instability


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("radius", [1.0, 1.0001, 1.5, 1e20])
def test_unstable_loop_costs_inf(radius, dtype):
    rotation = [[0.6 * radius, -0.8 * radius], [0.8 * radius, 0.6 * radius]]
    assert uncontrolled(rotation, dtype).tolist() == [float("inf")]


def test_one_unstable_mode_is_enough():
    assert uncontrolled([[0.5, 0.0], [0.0, -1.01]]).tolist() == [float("inf")]


def test_growth_before_decay_is_not_instability():
    """``M = [[a, b], [0, a]]`` first multiplies a state by about b."""
    M = [[0.5, 1000.0], [0.0, 0.5]]
    expected = np.trace(scipy.linalg.solve_discrete_lyapunov(np.array(M).T, np.eye(2)))
    assert_close(uncontrolled(M), [expected])


def test_unstable_domain_costs_inf_alone():
    problem = paper_problem(num_domains=2)
    push = torch.linalg.pinv(problem.seen)[:, : problem.A.shape[-1]]  # seen in domain 0 alone
    costs = training_costs(-push, problem)
    assert torch.isinf(costs[:, 0]).all()
    assert_close(costs[:, 1], [4 / (1 - 0.9**2)] * 2)


def test_unstable_run_has_no_gradient_and_leaves_the_others_theirs():
    problem = general_problem(num_runs=3)
    stable = random_gain(problem).requires_grad_()
    unstable = torch.cat([stable.detach()[:2], 100 * stable.detach()[2:]]).requires_grad_()
    assert torch.isinf(training_costs(unstable, problem)[2]).all()
    (expected,) = torch.autograd.grad(training_costs(stable, problem).sum(), stable)
    (gradient,) = torch.autograd.grad(training_costs(unstable, problem).sum(), unstable)
    assert torch.isnan(gradient[2]).all()
    assert_close(gradient[:2], expected[:2], rtol=1e-12)


def test_spectral_radius_of_the_closed_loop():
    problem = paper_problem(contraction=0.7)
    F = torch.zeros(2, *problem.gain_shape).double()
    assert_close(spectral_radius(F, problem, problem.W_test), [0.7, 0.7])
    cancelling = torch.cat([problem.A @ problem.seen[:, :4, :4].mT, F[..., 4:]], dim=-1)
    assert spectral_radius(cancelling, problem, problem.W_test).max() < 1e-10


# --------------------------------------------------------------------------- solutions


def value_iteration(A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray) -> np.ndarray:
    """P of the best control over 2,000 steps."""
    P = Q
    for _ in range(2000):
        P = Q + A.T @ P @ A - A.T @ P @ B @ np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    return P


def test_oracle_is_the_limit_of_value_iteration():
    problem = general_problem(n_x=4, num_runs=3)
    gains, costs = riccati_gain(problem)
    for r in range(3):
        A, B, Q, R = (m[r].numpy() for m in (problem.A, problem.B, problem.Q, problem.R))
        P = value_iteration(A, B, Q, R)
        assert_close(costs[r], np.trace(P))
        assert_close(gains[r], np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A))


def test_oracle_costs_what_its_gain_costs_and_cannot_be_improved():
    problem = state_feedback(general_problem(n_x=4))
    gain, cost = riccati_gain(problem)
    gain.requires_grad_()
    actual = expected_cost(gain, problem, problem.W_test)
    assert_close(actual.detach(), cost)
    (gradient,) = torch.autograd.grad(actual.sum(), gain)
    assert gradient.abs().max() < 1e-8 * cost.max()


@pytest.mark.parametrize("contraction", [0.2, 0.99, 1.3])
@pytest.mark.parametrize("dim_state", [1, 5])
def test_oracle_cost_in_closed_form(dim_state, contraction):
    problem = paper_problem(dim_state=dim_state, contraction=contraction)
    assert_close(riccati_gain(problem)[1], [oracle_cost(dim_state, contraction)] * 2)


def test_oracle_cost_of_the_paper():
    assert round(oracle_cost(), 1) == 32.1


def test_invariant_gain_costs_the_oracles_in_every_domain():
    problem = paper_problem()
    K = invariant_gain(problem)
    assert_close(training_costs(K, problem), np.full((2, 3), oracle_cost(4, 0.9)))
    assert_close(expected_cost(K, problem, problem.W_test), [oracle_cost(4, 0.9)] * 2)


# With 3 domains of 4 states, training shows 12 directions of 14 observations, or all of 10.
@pytest.mark.parametrize("dim_distractor", [10, 6])
def test_minimum_norm_gain_is_optimal_in_every_training_domain(dim_distractor):
    problem = paper_problem(dim_distractor=dim_distractor)
    costs = training_costs(minimum_norm_gain(problem), problem)
    assert_close(costs, np.full((2, 3), oracle_cost(4, 0.9)))


def test_minimum_norm_gain_is_smaller_than_other_optimal_gains():
    problem = paper_problem(num_domains=2, dim_distractor=10)
    smallest = minimum_norm_gain(problem)
    for other in (invariant_gain(problem), smallest + outside(random_gain(problem), problem)):
        assert_close(training_costs(other, problem), training_costs(smallest, problem))
        assert (other.square().sum((1, 2)) > smallest.square().sum((1, 2))).all()


def test_minimum_norm_gain_lies_in_the_row_space():
    problem = paper_problem(num_domains=2, dim_distractor=10)
    K = minimum_norm_gain(problem)
    assert_close(project(K, row_space(problem)), K)


def outside(K: Tensor, problem: LQR) -> Tensor:
    return K - project(K, row_space(problem))


@pytest.mark.parametrize(("num_domains", "rank"), [(1, 4), (2, 8), (3, 10)])
def test_row_space_is_spanned_by_what_training_shows(num_domains, rank):
    problem = paper_problem(num_domains=num_domains, dim_distractor=6)
    basis = row_space(problem)
    assert basis.shape == (2, 10, rank)
    assert_close(basis.mT @ basis, [np.eye(rank)] * 2)
    assert_close(project(problem.seen.mT, basis), problem.seen.mT)


def test_projecting_twice_is_projecting_once():
    problem = paper_problem(num_domains=2)
    basis, K = row_space(problem), random_gain(problem)
    once = project(K, basis)
    assert not torch.allclose(once, K)
    assert_close(project(once, basis), once)


def test_what_a_gain_does_outside_the_row_space_costs_nothing_in_training():
    problem = paper_problem(num_domains=2, dim_distractor=10)
    K = random_gain(problem)
    changed = K + 10 * outside(random_gain(problem, seed=1), problem)
    assert_close(training_costs(changed, problem), training_costs(K, problem))
    test_costs = [expected_cost(gain, problem, problem.W_test) for gain in (K, changed)]
    assert not torch.allclose(*test_costs)


# ------------------------------------------------------------------------------- draws


@pytest.mark.parametrize(("num_domains", "dim_distractor", "dim_state"), [(2, 9, 5), (3, 30, 20)])
def test_draws_are_those_of_the_published_runs(num_domains, dim_distractor, dim_state):
    seeds = [0, 7]
    problem = sample_problem(seeds, num_domains, dim_distractor, dim_state, dtype=torch.float64)
    for r, seed in enumerate(seeds):
        A, W_train, W_test = straightforward.problem(
            seed, num_domains, dim_distractor, dim_state, dtype=torch.float64
        )
        assert_close(problem.A[r], A)
        assert_close(problem.W_train[r], torch.stack(W_train))
        assert_close(problem.W_test[r], W_test)


def test_drawn_matrices_are_semi_orthogonal():
    problem = paper_problem(dim_distractor=9, dim_state=5)
    identity = np.stack([np.eye(5)] * 2)
    assert_close(problem.A.mT @ problem.A, 0.9**2 * identity)
    for W in (*problem.W_train.unbind(1), problem.W_test):
        W_c, W_d = W.split([5, 9], dim=1)
        assert_close(W_c.mT @ W_c, identity)
        assert_close(W_d.mT @ W_d, identity)
        assert_close(W_c, problem.W_test[:, :5], rtol=0)  # the same in every domain


def test_inputs_and_weights_are_identities():
    problem = paper_problem()
    for matrix in (problem.B, problem.Q, problem.R):
        assert_close(matrix, [np.eye(4)] * 2, rtol=0)


def test_more_domains_keep_the_draws_of_the_first():
    few, many = paper_problem(num_domains=2), paper_problem(num_domains=4)
    assert torch.equal(few.A, many.A)
    assert torch.equal(few.W_train, many.W_train[:, :2])
    assert torch.equal(few.W_test, many.W_train[:, 2])


def test_each_run_is_drawn_from_its_own_seed():
    together, alone = paper_problem([5, 3]), paper_problem([3])
    for name, matrix in vars(together.run(1)).items():
        assert torch.equal(matrix, getattr(alone, name)), name


def test_sizes_of_a_problem():
    problem = general_problem(n_x=3, n_u=2, n_y=4, num_runs=5, num_domains=6)
    assert (problem.num_runs, problem.num_domains, problem.gain_shape) == (5, 6, (2, 7))
    assert problem.W_train.shape == (5, 6, 7, 3)


def test_change_of_precision_reaches_every_matrix():
    assert {m.dtype for m in vars(paper_problem().to(torch.float32)).values()} == {torch.float32}


def test_domains_stand_side_by_side():
    matrix = torch.tensor([[[1, 2, 3, 4], [5, 6, 7, 8]]])
    assert split_domains(matrix, 2).tolist() == [[[[1, 2], [5, 6]], [[3, 4], [7, 8]]]]


def test_one_product_gives_the_feedback_in_all_domains():
    problem = general_problem(num_domains=3)
    K = random_gain(problem)
    assert_close(split_domains(K @ problem.seen, 3), K.unsqueeze(1) @ problem.W_train)


# -------------------------------------------------------------------------- trajectories


def test_simulated_states_are_powers_of_the_closed_loop():
    problem = general_problem()
    K, start = random_gain(problem), torch.tensor([[1.0, 2.0, 3.0], [-1.0, 0.0, 1.0]]).double()
    states = simulate(K, problem, problem.W_test, start, num_steps=4)
    M = problem.A - problem.B @ K @ problem.W_test
    assert states.shape == (2, 5, 3)
    for t in range(5):
        expected = torch.linalg.matrix_power(M, t) @ start.unsqueeze(-1)
        assert_close(states[:, t], expected.squeeze(-1))
