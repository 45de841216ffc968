"""Bad input: an error before any work that names the parameter, its value and the rule.

Damaged results files and folders that cannot be written are in ``test_results.py``.
"""

import math
import re

import numpy as np
import pytest
import torch
from small import paper_problem, trained_gain

from experiments.experiment import Experiment
from experiments.lqr import Cell, run_cell
from experiments.store import Store
from ipo.checks import check_notebook_parameters
from ipo.lqr import sample_problem, simulate
from ipo.lqr_learners import LQRSettings, published_lqr
from ipo.optimizers import make_optimizer
from ipo.stats import bootstrap_interval, paired_difference, probability_of_improvement

NAN, INF = math.nan, math.inf


def named(name: str, value: object, rule: str) -> str:
    """The pattern of a message that names parameter, value and rule."""
    return f"^{re.escape(f'{name} = {value!r}')}: {rule}"


# ----------------------------------------------------------------------------- problems

WHOLE = "must be a whole number, not"
LEAST_1 = "must be at least 1$"


@pytest.mark.parametrize(
    ("name", "value", "error", "rule"),
    [
        ("num_domains", 0, ValueError, LEAST_1),
        ("num_domains", -3, ValueError, LEAST_1),
        ("num_domains", [2, 5], TypeError, f"{WHOLE} list"),
        ("num_domains", 2.0, TypeError, f"{WHOLE} float"),
        ("num_domains", True, TypeError, f"{WHOLE} bool"),
        ("num_domains", "2", TypeError, f"{WHOLE} str"),
        ("num_domains", None, TypeError, f"{WHOLE} NoneType"),
        ("dim_state", 0, ValueError, LEAST_1),
        ("dim_state", -4, ValueError, LEAST_1),
        ("dim_distractor", -6, ValueError, LEAST_1),
        ("dim_distractor", 3, ValueError, r"must be at least dim_state = 4, or W_d cannot"),
        ("dim_distractor", (6,), TypeError, f"{WHOLE} tuple"),
        ("contraction", 0.0, ValueError, "must be greater than 0"),
        ("contraction", -0.9, ValueError, "must be greater than 0"),
        ("contraction", NAN, ValueError, "must not be NaN"),
        ("contraction", [0.9], TypeError, "must be a number, not list"),
        ("seeds", [], ValueError, "must not be empty"),
        ("seeds", [1, 0, 1], ValueError, "must not name a value twice"),
        ("seeds", 3, TypeError, "must be a list of whole numbers"),
        ("seeds", "01", TypeError, "must be a list of whole numbers"),
    ],
)
def test_problem_that_cannot_be_drawn(name, value, error, rule):
    sizes = {"seeds": [0], "num_domains": 2, "dim_distractor": 6, "dim_state": 4}
    with pytest.raises(error, match=named(name, value, rule)):
        sample_problem(**(sizes | {name: value}))


@pytest.mark.parametrize(
    ("seeds", "message"),
    [
        ([0, -1], r"^seeds\[1\] = -1: must be at least 0"),
        ([0.5], r"^seeds\[0\] = 0\.5: must be a whole number, not float"),
        ([[0], [1]], r"^seeds\[0\] = \[0\]: must be a whole number, not list"),
    ],
)
def test_seed_that_is_none(seeds, message):
    with pytest.raises((TypeError, ValueError), match=message):
        sample_problem(seeds, num_domains=2, dim_distractor=6, dim_state=4)


def test_whole_numbers_of_numpy_are_accepted():
    problem = sample_problem(range(2), np.int64(3), np.int32(6), dim_state=4)
    assert (problem.num_runs, problem.num_domains) == (2, 3)


def test_steps_of_a_simulation():
    problem = paper_problem()
    K, start = torch.zeros(2, *problem.gain_shape).double(), torch.ones(2, 4).double()
    with pytest.raises(ValueError, match=r"^num_steps = -1: must be at least 0"):
        simulate(K, problem, problem.W_test, start, num_steps=-1)


# ----------------------------------------------------------------------------- settings


@pytest.mark.parametrize(
    ("name", "value", "error", "rule"),
    [
        (
            "method",
            "ipo_fixed_fi",
            ValueError,
            r"must be one of gradient_descent, .*'ipo_fixed_phi'\?",
        ),
        ("method", "q", ValueError, r"must be one of gradient_descent, .*ipo_variable_phi$"),
        ("method", None, ValueError, "must be one of gradient_descent"),
        (
            "optimizer",
            "adams",
            ValueError,
            r"must be one of adam, plain, lbfgs; did you mean 'adam'\?",
        ),
        ("learning_rate", 0, ValueError, "must be greater than 0"),
        ("learning_rate", -1e-3, ValueError, "must be greater than 0"),
        ("learning_rate", NAN, ValueError, "must not be NaN"),
        ("learning_rate", [1e-3], TypeError, "must be a number, not list"),
        ("learning_rate", "1e-3", TypeError, "must be a number, not str"),
        ("num_iterations", -1, ValueError, "must be at least 0"),
        ("num_iterations", 5e3, TypeError, f"{WHOLE} float"),
        ("weight_decay", -0.1, ValueError, "must be at least 0"),
        ("weight_decay", NAN, ValueError, "must not be NaN"),
        ("max_gradient_norm", 0.0, ValueError, "must be greater than 0"),
        ("num_hidden", 0, ValueError, LEAST_1),
        ("num_hidden", True, TypeError, f"{WHOLE} bool"),
        ("phi_scale", -0.03, ValueError, "must be at least 0"),
        ("gain_scale", NAN, ValueError, "must not be NaN"),
    ],
)
def test_settings_that_make_no_sense(name, value, error, rule):
    with pytest.raises(error, match=named(name, value, rule)):
        LQRSettings(**({"method": "ipo_fixed_phi"} | {name: value}))


def test_misspelt_setting():
    with pytest.raises(TypeError, match="learning_rat"):
        LQRSettings("ipo_fixed_phi", learning_rat=1e-3)


def test_published_settings_of_an_unknown_method():
    with pytest.raises(ValueError, match=named("method", "ipo", "must be one of gradient_descent")):
        published_lqr("ipo")


@pytest.mark.parametrize(
    ("name", "value", "rule"),
    [
        ("optimizer", "sgd", "must be one of adam, plain, lbfgs"),
        ("learning_rate", 0.0, "must be greater than 0"),
        ("weight_decay", -1.0, "must be at least 0"),
    ],
)
def test_optimiser_that_does_not_exist(name, value, rule):
    options = {"optimizer": "adam", "learning_rate": 0.1, "weight_decay": 0.0} | {name: value}
    with pytest.raises(ValueError, match=named(name, value, rule)):
        make_optimizer(options.pop("optimizer"), [torch.zeros(1, 1)], **options)


# ----------------------------------------------------------------------------- training


def start_of(*shape: int, fill: float = 0.0) -> torch.Tensor:
    return torch.full(shape, fill, dtype=torch.float64)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"seeds": [0]}, r"^seeds = \[0\]: must be one for each of 2 runs"),
        ({"seeds": [0, 1, 2]}, r"^seeds = \[0, 1, 2\]: must be one for each of 2 runs"),
        ({"start": start_of(4, 10)}, r"^start: has shape \(4, 10\), must have \(2, 4, 10\)"),
        ({"start": start_of(2, 10, 4)}, r"^start: has shape \(2, 10, 4\), must have \(2, 4, 10\)"),
        ({"start": start_of(2, 4, 10, fill=NAN)}, r"^start: holds NaN or inf.*must be finite"),
        ({"start": start_of(2, 4, 10, fill=-INF)}, r"^start: holds NaN or inf.*must be finite"),
    ],
)
def test_training_that_cannot_begin(options, message):
    with pytest.raises(ValueError, match=message):
        trained_gain(paper_problem(), LQRSettings("ipo_fixed_phi"), **({"seeds": [0, 1]} | options))


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


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([], r"^values: has shape \(0,\), must be a list of at least 2 runs"),
        ([1.0], r"^values: has shape \(1,\), must be a list of at least 2 runs"),
        ([[1.0, 2.0]], r"^values: has shape \(1, 2\), must be a list"),
        ([1.0, NAN], r"^values = \[1\.0, nan\]: must be finite"),
        ([1.0, INF], r"^values = \[1\.0, inf\]: must be finite"),
    ],
)
def test_runs_without_an_interval(values, message):
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match=message):
        bootstrap_interval(values, rng)
    with pytest.raises(ValueError, match=message):
        paired_difference(values, [1.0, 2.0], rng)


def test_runs_without_a_partner():
    with pytest.raises(ValueError, match=r"^baseline has 2 runs, must have 3, one for each value"):
        paired_difference([1.0, 2.0, 3.0], [1.0, 2.0], np.random.default_rng(0))


@pytest.mark.parametrize("name", ["costs", "baseline"])
def test_runs_that_cannot_be_compared(name):
    runs = {"costs": [1.0, 2.0], "baseline": [1.0, 2.0], name: [NAN, 0.5]}
    with pytest.raises(ValueError, match=rf"^{name} = \[nan, 0\.5\]: must be finite"):
        probability_of_improvement(**runs)


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
        ([], r"^seeds = \[\]: must not be empty"),
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
