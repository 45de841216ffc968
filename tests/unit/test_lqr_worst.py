"""LQR in the worst of many new domains, and in one that is chosen against the controller."""

import numpy as np
import pandas as pd
import pytest
import torch

from experiments import lqr, lqr_worst
from experiments.lqr import Cell, published_cell
from experiments.rows import tidy
from ipo.lqr import expected_cost, oracle_cost, sample_problem, training_costs

SEEDS = [0, 1]
CELL = published_cell("gradient_descent", 2, 100, num_iterations=30)


def values(rows: pd.DataFrame) -> dict[str, np.ndarray]:
    return {name: own["value"].to_numpy() for name, own in rows.groupby("metric")}


def test_the_oracle_is_efficient_everywhere_and_nothing_can_be_chosen_against_it():
    """Its loop is A / (1 + p), tr P = 20 p, with A 0.99 times orthogonal, whatever distracts."""
    found = values(lqr_worst.run_worst(Cell("oracle", 2, 100, settings=None), SEEDS, num_new=5))
    assert found["efficiency_mean"] == pytest.approx(1, rel=1e-4)
    assert found["efficiency_worst"] == pytest.approx(1, rel=1e-4)
    assert found["share_unstable"] == pytest.approx(0, abs=0)
    assert found["opposed_radius"] == pytest.approx(0.99 / (1 + oracle_cost() / 20), rel=1e-3)


def test_new_domains_are_none_of_those_in_training_and_begin_with_that_of_the_tables():
    problem = lqr.problem_of(CELL, SEEDS)
    new = lqr_worst.new_domains(CELL, SEEDS, num_new=3)
    assert new.num_domains == 3
    assert torch.equal(new.W_train[:, 0], problem.W_test)
    assert torch.equal(new.A, problem.A)
    trained = problem.W_train
    assert not any(
        torch.equal(new.W_train[:, i], trained[:, j]) for i in range(3) for j in range(2)
    )


def test_the_worst_and_the_mean_are_those_of_the_costs():
    found = values(lqr_worst.run_worst(CELL, SEEDS, num_new=4))
    gain = lqr.final_gain(CELL, lqr.problem_of(CELL, SEEDS), SEEDS)
    problem = sample_problem(SEEDS, 2 + 4, 100)
    costs = [expected_cost(gain, problem, problem.W_train[:, 2 + i]) for i in range(4)]
    efficiency = oracle_cost() / torch.stack(costs)
    assert found["efficiency_worst"] == pytest.approx(efficiency.amin(0).numpy(), rel=1e-4)
    assert found["efficiency_mean"] == pytest.approx(efficiency.mean(0).numpy(), rel=1e-4)


def test_a_gain_that_makes_the_loop_unstable_has_no_efficiency(monkeypatch):
    """M = A - B K W = A + A in every domain, of spectral radius 2 · 0.99."""

    def doubling(cell, problem, seeds):
        state = -problem.A @ problem.W_test[:, :20].mT
        return torch.cat([state, torch.zeros(len(seeds), 20, cell.dim_distractor)], dim=-1)

    monkeypatch.setattr(lqr_worst, "final_gain", doubling)
    found = values(lqr_worst.run_worst(CELL, SEEDS, num_new=3))
    assert found["efficiency_mean"].tolist() == found["efficiency_worst"].tolist() == [0, 0]
    assert found["share_unstable"].tolist() == [1, 1]
    assert found["opposed_radius"] == pytest.approx(1.98, rel=1e-4)


def test_the_opposed_domain_is_of_the_same_kind_and_adds_most_to_the_loop():
    problem = lqr.problem_of(CELL, SEEDS)
    gain = lqr.final_gain(CELL, problem, SEEDS)
    opposed = lqr_worst.opposed_domain(gain, problem)
    assert torch.equal(opposed[:, :20], problem.W_test[:, :20])
    orthonormal = opposed[:, 20:].mT @ opposed[:, 20:]
    assert torch.allclose(orthonormal, torch.eye(20).expand(2, -1, -1), atol=1e-4)

    remaining = problem.A - problem.B @ gain[..., :20] @ problem.W_test[:, :20]

    def added(W):
        """<M, -B K_y D>."""
        return (remaining * -(problem.B @ gain[..., 20:] @ W[:, 20:])).sum((1, 2))

    new = lqr_worst.new_domains(CELL, SEEDS, num_new=20)
    assert (added(opposed) > max(added(new.W_train[:, i]).max() for i in range(20))).all()
    assert (expected_cost(gain, problem, opposed) > training_costs(gain, new).amax(1)).all()


def test_the_table_has_means_over_runs_by_arm():
    cells = lqr_worst.worst_cells([(2, 20), (3, 20)], num_iterations=3)
    metrics = {("new", name): torch.tensor([0.25, 0.5]) for name in lqr_worst.WANTED}
    rows = pd.concat([tidy(cell, SEEDS, metrics) for cell in cells])
    table = lqr_worst.worst_table(rows, dim_distractor=20)
    assert list(table["arm"].unique()) == [
        "gradient descent",
        "one controller, one domain at a time",
        "IPO",
    ]
    for column in ("2 domains", "3 domains"):
        assert list(table[column]) == 3 * ["38%", "38%", "37.5%", "0.38"]


def test_numbers_for_the_prose():
    cells = lqr_worst.worst_cells([(2, 20), (3, 20)], num_iterations=3)
    shares = dict.fromkeys(("efficiency_worst", "share_unstable"), torch.tensor([0.25, 0.5]))
    metrics = shares | {"opposed_radius": torch.tensor([0.5, 1.5])}
    rows = pd.concat(
        tidy(cell, SEEDS, {("new", name): own for name, own in metrics.items()}) for cell in cells
    )
    found = lqr_worst.worst_numbers(rows, dim_distractor=20)
    assert found["few_ipo_fixed_phi"] == found["most_in_turn"] == 0.375
    assert found["unstable_gradient_descent"] == 0.375
    assert found["opposed_in_turn"] == "2 of 4"
