"""What the causality chapter decides on its way from rows to tables, numbers and interventions."""

import numpy as np
import pandas as pd
import pytest
import torch

from experiments import causality
from experiments.causality import EXPERIMENTS, VARIANTS, Cell
from experiments.chapter import Chapter
from experiments.experiment import rebuilt
from experiments.origin import ROOT
from experiments.store import Store
from experiments.tables import by_method, chosen_by, largest_differences
from ipo.causality.predictors import Regression
from ipo.causality.scm import SCM, Linear, moments

SHIPPED = {
    "linear": causality.linear_cells(VARIANTS, 30_000, [10.0, 1e5]),
    "digits": causality.digit_cells(4000, [1.0, 10.0, 100.0, 1e3, 1e4]),
    "failures": causality.failure_cells(
        {
            "few_domains": [2, 3, 4, 6, 10, 20],
            "small_shift": [0.03, 0.06, 0.12, 0.3, 0.6, 1.0, 1.8],
            "marked_domains": [0, 1, 2, 3, 4, 6, 8],
        },
        20_000,
    ),
}
TRUTH = SCM(
    {
        "X1": Linear({}),
        "X2": Linear({"X1": 0.7}),
        "Y": Linear({"X1": 1.0, "X2": 0.5}),
        "E": Linear({"Y": 1.0}),
    }
)


def rows_of(columns, *values):
    return pd.DataFrame(values, columns=[*columns.split(), "value"])


@pytest.mark.parametrize("name", SHIPPED)
def test_cells_are_those_whose_rows_are_shipped(name):
    batches = Store(ROOT / "data" / "results" / "causality", name).batches()
    recorded = [rebuilt(Cell, batch["cell"]) for batch in batches]
    assert sorted(map(repr, SHIPPED[name])) == sorted(map(repr, recorded))


def test_each_run_chooses_its_penalty_by_itself():
    rows = rows_of(
        "problem method run penalty metric",
        ("FOU", "vrex", 0, 1.0, "score", 3.0), ("FOU", "vrex", 0, 10.0, "score", 2.0),
        ("FOU", "vrex", 1, 1.0, "score", 2.0), ("FOU", "vrex", 1, 10.0, "score", 3.0),
        ("FOU", "vrex", 0, 1.0, "error", 5.0), ("FOU", "vrex", 0, 10.0, "error", 6.0),
        ("FOU", "vrex", 1, 1.0, "error", 7.0), ("FOU", "vrex", 1, 10.0, "error", 8.0),
        ("FOU", "erm", 0, 0.0, "score", 9.0), ("FOU", "erm", 0, 0.0, "error", 9.0),
    )  # fmt: skip
    chosen = chosen_by(rows, "score")
    errors = chosen[chosen["metric"] == "error"].set_index(["method", "run"])["value"]
    assert errors.to_dict() == {("vrex", 0): 6.0, ("vrex", 1): 7.0, ("erm", 0): 9.0}


def test_a_tie_goes_to_the_first_penalty():
    rows = rows_of(
        "problem method run penalty metric",
        ("FOU", "vrex", 0, 1.0, "score", 2.0),
        ("FOU", "vrex", 0, 10.0, "score", 2.0),
    )
    assert list(chosen_by(rows, "score")["penalty"]) == [1.0]


def test_not_chosen_is_one_penalty_of_the_penalised_methods_only():
    rows = rows_of("method penalty", ("irmv1", 1.0, 1), ("irmv1", 2.0, 2), ("erm", 2.0, 3))
    assert causality.not_chosen(rows, 2.0)["method"].to_dict() == {1: "irmv1_strong"}


def test_errors_are_relative_to_the_causes_in_the_same_run_of_the_same_problem():
    rows = rows_of(
        "problem method run metric",
        ("FOU", "oracle", 0, "test_risk", 2.0), ("FOU", "oracle", 1, "test_risk", 4.0),
        ("FEU", "oracle", 0, "test_risk", 8.0), ("FOU", "erm", 0, "test_risk", 6.0),
        ("FOU", "erm", 1, "test_risk", 6.0), ("FEU", "erm", 0, "test_risk", 6.0),
        ("FOU", "erm", 0, "train_risk", 1.0),
    )  # fmt: skip
    relative = causality.relative_to_causes(rows)
    assert list(relative["value"]) == [1, 1, 1, 3, 1.5, 0.75]


def test_beside_the_authors_are_variants_that_both_have():
    ours = rows_of(
        "problem method run metric",
        ("FOU", "erm", 0, "error_causal", 1.0), ("FOU", "erm", 1, "error_causal", 3.0),
        ("FOU", "erm", 0, "error_effects", 5.0), ("FEU", "erm", 0, "error_causal", 9.0),
    )  # fmt: skip
    columns = ["variant", "method", "error_causal", "error_effects"]
    theirs = pd.DataFrame([("FOU", "erm", 4.0, 6.0), ("POU", "erm", 7.0, 7.0)], columns=columns)
    (line,) = causality.beside_the_authors(ours, theirs, {"erm": "ERM"}).to_dict("records")
    assert line == {
        "variant": "FOU", "method": "ERM",
        "causes, ours": 2, "causes, theirs": 4, "effects, ours": 5, "effects, theirs": 6,
    }  # fmt: skip


def test_numbers_of_linear_data():
    rows = rows_of(
        "problem method",
        *[("FOU", "icp", value) for value in (1.0, 1.25, 3.0, 4.0, 1.5)],
        *[("FOU", "erm", value) for value in (1.0, 2.0)],
        ("FEU", "erm", 7.0),
    )
    numbers = causality.linear_numbers(rows, first="FOU", hetero="FEU")
    assert (numbers["first"], numbers["hetero"]) == ("FOU", "FEU")
    assert (numbers["icp_missed"], numbers["icp_median"]) == (2, 1.5)
    assert (numbers["first_erm"], numbers["hetero_erm"]) == (1.5, 7.0)


def test_numbers_of_digits():
    rows = rows_of(
        "method penalty metric",
        *[("irmv1", weight, "test_error", weight / 10) for weight in (1.0, 1.0, 2.0)],
        *[("vrex", weight, "test_error", weight / 5) for weight in (1.0, 2.0)],
        ("irmv1", 1.0, "train_error", 0.0),
    )
    numbers = causality.digit_numbers(rows[rows["penalty"] == 2.0], rows, weak=1.0)
    assert numbers == {
        "digits_irmv1": 0.2, "digits_vrex": 0.4, "weak": 1.0, "weak_irmv1": 0.1, "weak_vrex": 0.2,
    }  # fmt: skip


def test_numbers_of_failures_name_the_level_where_a_method_is_worst():
    errors = {0.1: 3.0, 0.3: 5.0, 1.0: 2.0}
    rows = rows_of(
        "problem level method metric",
        *[
            (problem, level, method, "test_risk", error * (2 if method == "erm" else 1))
            for problem in ("few_domains", "small_shift", "marked_domains")
            for level, error in errors.items()
            for method in causality.FAILURE_METHODS
        ],
        ("small_shift", 1.0, "irmv1", "train_risk", 99.0),
    )
    numbers = causality.failure_numbers(rows)
    assert (numbers["shift_first_irmv1"], numbers["shift_last_irmv1"]) == (3.0, 2.0)
    assert (numbers["shift_worst"], numbers["shift_worst_erm"]) == (0.3, 10.0)
    assert (numbers["marked_worst"], numbers["marked_worst_icp"]) == (0.3, 5.0)
    assert "few_worst" not in numbers


@pytest.mark.parametrize("change", [causality.same_graph, causality.any_graph])
def test_interventions_at_random_leave_the_target_alone(change):
    rng = np.random.default_rng(0)
    for _ in range(20):
        changed = change(TRUTH, "Y", rng)
        assert changed.assignments["Y"] is TRUTH.assignments["Y"]
        assert all(changed.assignments[n] is not TRUTH.assignments[n] for n in ("X1", "X2", "E"))


def test_only_one_kind_of_intervention_changes_arrows():
    rng = np.random.default_rng(1)
    kept = [causality.same_graph(TRUTH, "Y", rng).edges for _ in range(10)]
    drawn = [causality.any_graph(TRUTH, "Y", rng).edges for _ in range(10)]
    assert all(set(edges) == set(TRUTH.edges) for edges in kept)
    assert len({frozenset(edges) for edges in drawn}) > 5


def test_regression_on_the_causes_does_not_change_and_on_an_effect_it_does():
    rng = np.random.default_rng(2)
    models = [TRUTH, *(causality.any_graph(TRUTH, "Y", rng) for _ in range(10))]
    covariances = [moments(model)[1] for model in models]
    assert causality.largest_change(covariances, "Y", ("X1", "X2")) < 1e-9
    assert causality.largest_change(covariances, "Y", ("X1", "X2", "E")) > 0.1
    assert causality.largest_change(covariances, "Y", ("X1",)) > 0.1


def test_erm_in_closed_form_is_what_the_shipped_training_arrived_at():
    runs = [causality.chain_run("FOS", seed) for seed in (0, 1)]
    task = Regression.from_samples(*causality.stack([domains for domains, _, _ in runs]))
    v = torch.linalg.solve(task.gram.mean(1), task.moment.mean(1))
    rows = Store(ROOT / "data" / "results" / "causality", "linear").rows()
    shipped = rows[(rows["problem"] == "FOS") & (rows["method"] == "erm")]
    for (_, metric), values in causality.chain_metrics(runs, v).items():
        trained = shipped[shipped["metric"] == metric].set_index("run").loc[[0, 1], "value"]
        np.testing.assert_allclose(values.numpy(), trained, rtol=1e-6)


def test_tables_have_the_methods_in_the_order_of_their_names():
    runs = [(method, "x", run, 3.0) for run in (0, 1) for method in "bca"]
    rows = rows_of("method metric run", *runs[:-1], ("a", "x", 1, 4.0))
    table = by_method(rows, "metric", {"c": "see", "missing": "none", "a": "ay"}, digits=1)
    assert table["x"].to_dict() == {"see": "3.0 [3.0, 3.0]", "ay": "3.5 [-2.9, 9.9]"}


def test_largest_differences_are_those_of_the_shipped_rows():
    shipped = rows_of("method run", ("a", 0, 1.0), ("a", 1, 2.0), ("b", 0, 0.0), ("c", 0, 1.0))
    live = rows_of("method run", ("a", 0, 1.0), ("a", 1, 2.2), ("b", 0, 0.0))
    first, second = largest_differences(live, shipped, ["method"]).to_dict("records")
    assert first["largest relative difference"] == pytest.approx(0.1, rel=1e-2)
    assert second == {"method": "b", "largest relative difference": 0.0}


def test_slices_run_again_are_the_recorded_ones():
    chapter = Chapter("causality", EXPERIMENTS, None)
    now, recorded = chapter.slices("linear", problem="PES", method="irmv1")
    assert sorted(now["penalty"].unique()) == [10.0, 1e5]
    differences = largest_differences(now, recorded, ["penalty"])
    assert (differences["largest relative difference"] < 1e-4).all()
