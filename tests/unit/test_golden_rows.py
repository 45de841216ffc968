"""The shipped rows of LQR: what the chapter asks for, and Tables 1 and 2 to the paper's digit."""

import json
from pathlib import Path

import pandas as pd
import pytest

from experiments import lqr, lqr_turns, lqr_worst
from experiments.experiment import filled
from experiments.paper import read_paper
from experiments.registry import CHAPTERS
from experiments.regularized import trials
from experiments.store import Store, asked

DATA = Path(__file__).resolve().parents[2] / "data"
RESULTS = DATA / "results" / "lqr"
CONFIGURATION = ["method", "num_domains", "dim_distractor"]
SIZES = [(n_d, 1000) for n_d in (2, 3, 4, 5, 10)] + [(5, n_y) for n_y in (100, 500, 1500, 2000)]
# How far a mean may be from the paper's. The paper gives one decimal; where the start of Phi,
# or of the two layers, is not published, there is more to allow for.
BOUNDS = {
    "gradient_descent": 0.15,
    "ipo_fixed_phi": 0.15,
    "overparameterized": 1.5,
    "ipo_variable_phi": 1.5,
    "oracle": 0.05,
}
ASKED = {  # cells and number of runs
    "tables": (lqr.table_cells(SIZES, 5000), 10),
    "curves": (lqr.published_cells(5, 1000, 5000), 10),
    "closed_loops": (lqr.table_cells([(2, 1000)], 5000), 2),
    "starts": (lqr.start_cells(5, 1000, 100, 5000), 10),
    "more_domains": (lqr.table_cells([(20, 1000), (50, 1000)], 5000), 10),
    "closed_form": (lqr.closed_form_cells([2, 3, 4, 5, 10, 20, 50], 1000), 10),
    "optimizers": (lqr.optimizer_cells([2, 5, 10], 1000, 5000), 10),
    "outside": (lqr.published_cells(2, 1000, 5000), 2),
    "controls": (lqr.control_cells([2, 5, 10], 1000, 5000), 10),
    "regularized": ([c for n in (2, 5, 10) for c in trials.lqr_cells(n, 1000, 5000)], 10),
    "turns": (lqr_turns.turn_cells(SIZES, 5000), 10),
    "worst": (lqr_worst.worst_cells(SIZES, 5000), 10),
}
UNREACHED = pytest.mark.xfail(strict=True, reason="no reading of the unpublished start reaches it")


@pytest.fixture(scope="module")
def costs() -> pd.DataFrame:
    rows = Store(RESULTS, "tables").rows()
    return rows[rows["metric"] == "test_cost"]


@pytest.fixture(scope="module")
def means(costs) -> pd.Series:
    return costs.groupby(CONFIGURATION)["value"].mean()


@pytest.fixture(scope="module")
def paper() -> pd.DataFrame:
    """Both tables; the configuration that stands in both has the same numbers in both."""
    table = read_paper("lqr").drop(columns="table").drop_duplicates()
    return table.set_index(CONFIGURATION)


CELLS = [
    pytest.param(
        (method, *sizes),
        marks=UNREACHED if (method, *sizes) == ("ipo_variable_phi", 5, 100) else (),
        id=f"{method}-{sizes[0]}-{sizes[1]}",
    )
    for method in BOUNDS
    for sizes in SIZES
]


@pytest.mark.parametrize("cell", CELLS)
def test_mean_is_the_papers(means, paper, cell):
    assert abs(means[cell] - paper["mean"][cell]) <= BOUNDS[cell[0]]


def test_every_cell_has_ten_runs(costs):
    counted = costs.groupby(CONFIGURATION)["run"].apply(sorted)
    expected = {(method, *sizes): list(range(10)) for method in BOUNDS for sizes in SIZES}
    assert counted.to_dict() == expected


@pytest.mark.parametrize("name", CHAPTERS["lqr"])
def test_rows_are_whole_and_what_the_chapter_asks_for(name):
    experiment, (cells, num_runs) = CHAPTERS["lqr"][name], ASKED[name]
    wanted = [asked(experiment, cell, range(num_runs)) for cell in cells]
    store = Store(RESULTS, name)
    store.rows()  # each batch is checked against its digest
    batches = store.batches()
    recorded = [
        {key: batch[key] for key in wanted[0]} | {"cell": filled(experiment.cell, batch["cell"])}
        for batch in batches
    ]
    assert sorted(map(json.dumps, recorded)) == sorted(map(json.dumps, wanted))
    assert [batch["seeds"] for batch in batches] == [list(range(num_runs))] * len(cells)
