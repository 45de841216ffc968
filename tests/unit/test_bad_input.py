"""Bad input that depends on more than one parameter, and what is accepted all the same.

The values that each parameter refuses are in ``test_bad_input_table.py``, damaged results files
in ``test_store.py``.
"""

import math

import numpy as np
import pytest
import torch
from small import paper_problem, trained_gain

from experiments.experiment import Experiment
from experiments.lqr import Cell, run_cell
from experiments.store import Store
from ipo.lqr import sample_problem
from ipo.lqr_learners import LQRSettings
from ipo.notebooks import check_notebook_parameters

NAN, INF = math.nan, math.inf


# ----------------------------------------------------------------------------- problems


def test_whole_numbers_of_numpy_are_accepted():
    problem = sample_problem(range(2), np.int64(3), np.int32(6), dim_state=4)
    assert (problem.num_runs, problem.num_domains) == (2, 3)


# ----------------------------------------------------------------------------- settings


def test_misspelt_setting():
    with pytest.raises(TypeError, match="learning_rat"):
        LQRSettings("ipo_fixed_phi", learning_rat=1e-3)


# ----------------------------------------------------------------------------- training


def start_of(*shape: int, fill: float = 0.0) -> torch.Tensor:
    return torch.full(shape, fill, dtype=torch.float64)


@pytest.mark.parametrize("method", ["gradient_descent", "ipo_fixed_phi"])
def test_unstable_start(method):
    """Undoes the contraction of run 1: ``A - F = 1.25 A / 0.8``."""
    problem = paper_problem(contraction=0.8)
    start = start_of(2, 4, 10)
    start[1, :, :4] = (1 - 1.25 / 0.8) * problem.A[1] @ torch.linalg.inv(problem.seen[1, :4, :4])
    message = r"^start: .* run 1 in training domain 0 has spectral radius 1\.2500, must be below 1"
    with pytest.raises(ValueError, match=message):
        trained_gain(problem, LQRSettings(method), [0, 1], start=start)


def test_marginal_start():
    """The paper's text, with an orthogonal A, taken literally."""
    with pytest.raises(ValueError, match=r"spectral radius 1\.0000, must be below 1"):
        trained_gain(paper_problem(contraction=1.0), LQRSettings("gradient_descent"), [0, 1])


def test_unstable_random_layers():
    chosen = LQRSettings("overparameterized", phi_scale=10.0, gain_scale=10.0)
    with pytest.raises(ValueError, match=r"spectral radius \d+\.\d{4}, must be below 1"):
        trained_gain(paper_problem(), chosen, [0, 1])


@pytest.mark.parametrize("method", ["overparameterized", "ipo_variable_phi"])
def test_start_for_a_method_with_layers(method):
    with pytest.raises(ValueError, match=f"^start: {method} starts from random layers"):
        trained_gain(paper_problem(), LQRSettings(method), [0, 1], start=start_of(2, 4, 10))


def test_early_stopping_without_a_domain_to_hold_out():
    cell = Cell("gradient_descent", 1, 20, LQRSettings("gradient_descent"), early_stopping=True)
    with pytest.raises(ValueError, match=r"^num_domains = 1: must be at least 2"):
        run_cell(cell, [0])


# --------------------------------------------------------------------------- statistics


# ------------------------------------------------------------------- notebooks and results


DEFAULTS = "num_runs = 10  # seeds\nprofile = 'class'\n"


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            "num_rums = 3",
            r"^num_rums = 3: .* no such parameter; it has num_runs, profile; .*'num_runs'",
        ),
        ("x = [1, 2]", r"^x = \[1, 2\]: this notebook has no such parameter; .* profile$"),
        ("num_runs = 3\nprofil = 'paper'", r"^profil = 'paper': .*did you mean 'profile'\?"),
    ],
)
def test_misspelt_parameter_of_a_notebook(given, message):
    cells = ["", "import ipo", DEFAULTS, f"# Parameters\n{given}\n", "check()"]
    with pytest.raises(ValueError, match=message):
        check_notebook_parameters(cells)


@pytest.mark.parametrize("injected", [[], ["# Parameters\nnum_runs = 3\n"]])
def test_parameters_that_a_notebook_has(injected):
    check_notebook_parameters(["", DEFAULTS, *injected, "sizes = [num_runs]"])


@pytest.mark.parametrize(
    ("seeds", "message"),
    [
        ([], r"^seeds = \[\]: must be at least 1 long"),
        ([2, 2], r"^seeds = \[2, 2\]: must not name a value twice"),
        ([-1], r"^seeds\[0\] = -1: must be at least 0"),
    ],
)
def test_results_without_proper_seeds(tmp_path, seeds, message):
    def run(cell, seeds):
        raise AssertionError("nothing must be computed")

    cell = Cell("oracle", 2, 20, None)
    with pytest.raises(ValueError, match=message):
        Store(tmp_path / "new", "rows").fill(Experiment(run, Cell), [cell], seeds)
    assert list(tmp_path.iterdir()) == []
