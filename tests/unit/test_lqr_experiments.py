"""The chapter on LQR: what its experiments measure, which cells they have, what its tables say."""

from dataclasses import fields

import numpy as np
import pandas as pd
import pytest
import torch

from experiments import lqr
from experiments.tables import beside_shipped
from ipo.lqr import expected_cost, oracle_cost, project, row_space, sample_problem
from ipo.lqr_learners import LQR_METHODS, published_lqr

SEEDS = [0, 1]


def metric(rows: pd.DataFrame, name: str) -> np.ndarray:
    return rows.loc[rows["metric"] == name, "value"].to_numpy()


# ------------------------------------------------------------------- rows


def test_oracles_closed_loop_shrinks_by_a_known_factor():
    """With B = Q = R = I and A = 0.99 times orthogonal, M = A / (1 + p), where tr P = 20 p."""
    oracle = lqr.table_cells([(2, 100)], 1)[-1]
    rows = lqr.run_closed_loops(oracle, SEEDS, num_starts=5, num_steps=6)
    factor = (0.99 / (1 + oracle_cost() / 20)) ** 2
    for _, energy in rows.groupby(["run", "metric"]):
        by_step = energy.sort_values("step")["value"].to_numpy()
        assert by_step[1:] / by_step[:-1] == pytest.approx(np.full(6, factor), rel=1e-3)


def test_closed_loops_begin_at_the_same_states():
    cells = lqr.table_cells([(2, 20)], 3)
    rows = pd.concat([lqr.run_closed_loops(cell, SEEDS, 50, 2) for cell in cells])
    first = rows[rows["step"] == 0].pivot(index="metric", columns=["method", "run"], values="value")
    assert np.ptp(first.to_numpy(), axis=1).max() == 0
    assert (np.diff(first.to_numpy(), axis=0) > 0).all()  # quantiles in their order


def test_outside_part_is_that_of_the_trained_gain():
    cell = lqr.published_cell("ipo_fixed_phi", 2, 100, num_iterations=5)
    rows = lqr.run_outside(cell, SEEDS)
    usual = lqr.run_cell(cell, SEEDS)
    for name in ("gain_norm_outside", "test_cost"):
        assert metric(rows, name) == pytest.approx(metric(usual, name), rel=1e-5)
    problem = sample_problem(SEEDS, 2, 100)
    gain = lqr.final_gain(cell, problem, SEEDS)
    outside = gain - project(gain, row_space(problem))
    felt = torch.linalg.matrix_norm(outside @ problem.W_test)
    assert metric(rows, "gain_norm_outside_felt") == pytest.approx(felt.numpy(), rel=1e-5)
    assert (metric(rows, "gain_norm_outside_state") < metric(rows, "gain_norm_outside")).all()


def test_random_outside_part_has_the_same_norm_and_is_as_invisible():
    cell = lqr.published_cell("gradient_descent", 2, 100, num_iterations=5)
    problem = sample_problem(SEEDS, 2, 100)
    gain = lqr.final_gain(cell, problem, SEEDS)
    random = torch.randn(gain.shape, generator=torch.Generator().manual_seed(0))
    swapped = []
    for K, seen, other in zip(gain.numpy(), problem.seen.numpy(), random.numpy(), strict=True):
        invisible = np.eye(len(seen)) - seen @ np.linalg.pinv(seen)
        part = other @ invisible
        part *= np.linalg.norm(K @ invisible) / np.linalg.norm(part)
        swapped.append(torch.tensor(K - K @ invisible + part, dtype=torch.float32))
    costs = expected_cost(torch.stack(swapped), problem, problem.W_test)
    rows = lqr.run_outside(cell, SEEDS)
    assert metric(rows, "test_cost_random_outside") == pytest.approx(costs.numpy(), rel=1e-4)
    assert metric(rows, "test_cost_random_outside") != pytest.approx(metric(rows, "test_cost"))


# ------------------------------------------------------------------- cells


@pytest.mark.parametrize("cell", lqr.control_cells([5], 1000, 5000), ids=lambda cell: cell.label)
def test_a_control_changes_one_thing(cell):
    usual = published_lqr(cell.settings.method)
    changed = [f.name for f in fields(usual) if vars(usual)[f.name] != vars(cell.settings)[f.name]]
    assert len(changed) + cell.early_stopping == 1


def test_controls_have_names_in_the_table():
    labels = {cell.label for cell in lqr.control_cells([2], 1000, 5000)}
    assert labels | {"gradient_descent", "ipo_fixed_phi"} == lqr.CONTROLS.keys()
    assert {name for pair in lqr.PAIRS for name in pair} <= lqr.CONTROLS.keys()


def test_plain_ipo_moves_its_average_as_far_as_plain_gradient_descent():
    descent, ipo, _ = (cell.settings for cell in lqr.optimizer_cells([10], 1000, 5000))
    assert ipo.learning_rate / 10 == pytest.approx(descent.learning_rate)
    assert ipo.max_gradient_norm * 10 == pytest.approx(descent.max_gradient_norm)


# ------------------------------------------------------------------- tables

ROWS = pd.DataFrame(
    [
        (method, n_d, 1000, run, "test_cost", 40.0 + place + n_d + 2 * run)
        for place, method in enumerate((*LQR_METHODS, "oracle"))
        for n_d in (2, 3)
        for run in SEEDS
    ],
    columns=["method", "num_domains", "dim_distractor", "run", "metric", "value"],
)
PAPER = pd.DataFrame(
    [("gradient_descent", 2, 1000, 41.0, 3.5), ("oracle", 2, 1000, 32.1, np.nan)],
    columns=["method", "num_domains", "dim_distractor", "mean", "std"],
)


def test_table_holds_ours_and_the_papers():
    table = lqr.beside_paper(ROWS, PAPER, "num_domains", dim_distractor=1000)
    assert list(table.columns) == ["2 domains", "3 domains"]
    cell = table.loc["gradient descent"]
    assert list(cell["2 domains"]) == ["43.0 ± 1.0", "41.0 ± 3.5", "+2.00"]
    assert list(cell["3 domains"]) == ["44.0 ± 1.0", "", ""]
    assert table.loc[("oracle", "paper"), "2 domains"] == "32.1"


def test_cells_far_from_the_papers_are_named():
    difference = lqr.difference_to_paper(ROWS, PAPER)
    assert lqr.in_words(difference[difference < 5]) == (
        "gradient descent with 2 domains and 1000 distractors, by +2.0"
    )
    assert lqr.in_words(difference[difference > 100]) == "none"


def test_cells_in_which_ipo_costs_less_are_counted():
    costs = lqr.mean_costs(ROWS)  # more by method, in the order of LQR_METHODS
    assert lqr.num_lower(costs, "gradient_descent") == "0 of 2"
    costs["gradient_descent", 3, 1000] = costs["ipo_fixed_phi", 3, 1000] + 0.1
    assert lqr.num_lower(costs, "gradient_descent") == "1 of 2"


def test_start_table_marks_the_start_of_the_tables():
    cells = lqr.start_cells(5, 1000, 100, 5000)
    rows = pd.DataFrame(
        [{**cell.columns, "run": run, "metric": "test_cost", "value": 50.0 + run}
         for cell in cells for run in SEEDS]
    )  # fmt: skip
    table = lqr.start_table(rows, cells, PAPER)
    marked = table[table["in the tables"] != ""]
    shown = ["method", "distractors", "scale of Φ or K₁", "scale of Kᵈ or K₂"]
    assert marked[shown].to_numpy().tolist() == [
        ["overparameterised", 1000, "0.001", "0.001"],
        ["IPO, variable Φ", 1000, "0.03", "0"],
        ["IPO, variable Φ", 100, "0.03", "0"],
    ]
    assert set(table["cost in a new domain"]) == {"50.5 ± 0.5"}


def test_numbers_say_how_far_converged_runs_are_from_the_closed_form():
    def rows(method: str, optimizer: str, values: list[float]) -> list[tuple]:
        names = ("test_cost", "test_cost_projected", "gain_norm_outside")
        return [
            (method, optimizer, 2, run, name, value + place)
            for place, name in enumerate(names)
            for run, value in zip(SEEDS, values, strict=True)
        ]

    table = pd.DataFrame(
        rows("minimum_norm", "none", [40, 50])
        + rows("gradient_descent", "plain", [40, 55])
        + rows("ipo_fixed_phi", "plain", [40, 50])
        + rows("gradient_descent", "lbfgs", [44, 50])
        + rows("gradient_descent", "adam", [80, 90])
        + rows("ipo_fixed_phi", "adam", [70, 80]),
        columns=["method", "optimizer", "num_domains", "run", "metric", "value"],
    )
    numbers = lqr.optimizer_numbers(table, 2)
    assert numbers["plain_vs_closed"] == "1e-01"
    assert numbers["adam_gradient_descent"] == 85
    assert numbers["projected_ipo_fixed_phi"] == 76
    assert numbers["outside_ipo_fixed_phi"] == 77
    assert (numbers["lbfgs"], numbers["closed"]) == (47, 45)


def test_live_rows_stand_beside_the_shipped_ones():
    live = ROWS[ROWS["num_domains"] == 2].assign(value=lambda rows: rows["value"] * 1.01)
    both = beside_shipped(live, ROWS)
    assert len(both) == len(live)
    assert both["relative difference"].to_numpy() == pytest.approx(
        np.full(len(live), 0.01), rel=1e-2
    )
    with pytest.raises(ValueError, match=r"shipped: has no row for \{.*'num_domains': 2"):
        beside_shipped(live, ROWS[ROWS["num_domains"] == 3])


def test_an_unstable_run_differs_infinitely_from_all_but_an_unstable_one():
    shipped = ROWS.head(3).assign(value=[np.inf, np.inf, 1.0])
    both = beside_shipped(shipped.assign(value=[np.inf, 1.0, np.inf]), shipped)
    for column in ("difference", "relative difference"):
        assert both[column].tolist() == [0, np.inf, np.inf]
