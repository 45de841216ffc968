"""Every parameter at its smallest, and those that depend on each other together.

A whole notebook then works, or its first cells name the parameter: nothing fails later. The other
parameters are those of the smoke profile.
"""

import re
from pathlib import Path
from typing import Any

import pytest
from by_hand import FIRST, NAMES, SMOKE, begin, code_cells, defaults, run_elsewhere, shipped

SMALLEST = {
    "lqr": {
        "num_runs": 2,
        "num_iterations": 1,
        "domain_counts": [2],
        "dim_distractor": 20,
        "distractor_dims": [20],
        "num_domains": 2,
        "more_domain_counts": [2],
        "optimizer_domain_counts": [2],
    },
    "causality": {
        "num_runs": 2,
        "num_samples": 100,
        "linear_iterations": 1,
        "digit_iterations": 1,
        "small_iterations": 1,
        "variants": ["PES"],
        "linear_penalties": [0.0],
        "digit_penalties": [0.0, 0.1],
        "domain_counts": [2],
        "shifts": [0.0],
        "markers": [0.0],
    },
    "keys": {
        "train_colors": ["blue", "purple"],  # two are fewest
        "num_runs": 2,
        "num_runs_variants": 2,
        "num_runs_regularized": 2,
        "num_runs_curves": 2,
        "num_runs_larger": 2,
        "num_runs_live": 1,
        "num_updates_live": 1,
        "num_updates": 1,
        "larger_size": 5,
        "grid_sizes": [5],
    },
    "cue": {
        "num_runs": 2,
        "num_updates": 1,
        "num_updates_first": 1,
        "cues": [0.1, 0.5],
        "more_cues": [0.6, 0.9],
    },
    "door": {
        "num_runs": 2,
        "num_control_runs": 2,
        "num_updates": 2,
        "num_steps": 512,  # an episode
        "num_doors": 2,  # as many as are watched
        "num_doors_watched": 1,
        "num_alone": 1,
        "num_doors_live": 1,
        "frictions": [1.1],
        "frictions_watched": [0.0],
        "film_every": 1,
        "authors_repository": None,
    },
    "algorithm": {
        "num_problems": 2,
        "num_rounds": 1,
        "num_updates": 1,
        "num_key_runs": 2,
        "num_games": 1,
        "num_live": 1,
    },
    "your_own_domains": {
        "num_updates": 1,
        "num_runs": 1,
        "num_episodes": 1,
        "num_distractors": 1,
    },
}
# What must go with it: live problems are some of all, and on a grid of five cells two of the larger
# arms are two of the main ones.
COMPANIONS = {
    ("algorithm", "num_problems"): {"num_live": 2},
    ("keys", "num_runs"): {"num_runs_larger": 2},
    ("keys", "num_runs_larger"): {"num_runs": 2},
}
EVERYWHERE = {"results_dir", "num_workers"}  # as in the smoke profile: of one's own, and one

# Together, larger than in the smoke profile or than what ships, in another order, twice the same.
TOGETHER: dict[str, list[dict[str, Any]]] = {
    "lqr": [
        SMALLEST["lqr"],
        {"num_runs": 11},
        {"dim_distractor": 30, "distractor_dims": [40, 20]},
        {"num_domains": 3, "domain_counts": [10, 2], "more_domain_counts": [5, 3]},
        {"domain_counts": [2], "optimizer_domain_counts": [4, 2, 3]},
        {"num_iterations": 400},
        {"num_workers": 2},
    ],
    "causality": [
        SMALLEST["causality"],
        {"num_runs": 21},
        {"variants": ["FES", "FOU"], "domain_counts": [3, 2]},
        {"linear_penalties": [1e3, 10.0], "digit_penalties": [100.0, 1.0]},
        {"linear_penalties": [10.0, 10.0]},
        {"digit_penalties": [1.0, 1.0]},
        {"shifts": [1.0, 0.1], "markers": [2.0, 0.0]},
        {"shifts": [0.1, 0.1]},
    ],
    "keys": [
        {"train_colors": ["red", "yellow"]},
        {"num_runs": 5},
        {"num_runs": 11, "num_runs_larger": 11},
        {"num_runs_variants": 5},
        {"num_runs_regularized": 4},
        {"num_runs_curves": 4, "num_runs_live": 4},
        {"num_updates": 2, "num_updates_live": 2},
    ],
    "cue": [
        {"cues": [0.9, 0.1, 0.3], "more_cues": [0.9, 0.6]},
        {"cues": [0.2]},
        {"num_runs": 31},
        {"num_updates": 26, "num_workers": 2},
    ],
    "door": [
        {"num_doors": 1, "num_doors_watched": 1, "num_doors_live": 1},
        {"num_runs": 3},
        {"num_updates": 3, "num_alone": 2},
        {"frictions": [1.3], "frictions_watched": [1.3]},
        {"frictions": [1.5, 0.0], "frictions_watched": [1.3, 0.0, 0.1]},
        {"frictions": [1.3, 1.3]},
        {"frictions_watched": [1.3, 1.3]},
        {"film_every": 1000},
    ],
    "algorithm": [
        SMALLEST["algorithm"],
        {"num_problems": 2, "num_live": 3},
        {"num_problems": 501, "num_live": 4, "num_rounds": 1},
        {"num_updates": 3, "num_key_runs": 3, "num_rounds": 1},
        {"num_games": 4, "num_rounds": 1},
    ],
    "your_own_domains": [
        SMALLEST["your_own_domains"],
        {"num_runs": 3, "num_updates": 5},
        {"num_episodes": 21, "num_distractors": 9},
    ],
}


@pytest.mark.parametrize("name", NAMES)
def test_every_parameter_is_varied(name):
    assert SMALLEST[name].keys() == defaults(name).keys() - EVERYWHERE


BELOW = [
    (name, parameter, value - 1)
    for name, values in SMALLEST.items()
    for parameter, value in values.items()
    if isinstance(value, int)
] + [
    (name, parameter, value[:-1])
    for name, values in SMALLEST.items()
    for parameter, value in values.items()
    if isinstance(value, list)
]


@pytest.mark.parametrize(("name", "parameter", "value"), BELOW)
def test_nothing_smaller_is_taken(name, parameter, value):
    with pytest.raises((TypeError, ValueError), match=rf"^{parameter}(\[.*\])? = "):
        begin(name, **SMOKE[name] | {parameter: value})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "parameter", "value"),
    [(name, key, value) for name in NAMES for key, value in SMALLEST[name].items()],
)
def test_smallest_value_works(tmp_path, name, parameter, value):
    given = {parameter: value} | COMPANIONS.get((name, parameter), {})
    assert outcome(name, tmp_path, given) == "worked"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "given"), [(name, given) for name in NAMES for given in TOGETHER[name]]
)
def test_values_together_work_or_are_refused_by_name(tmp_path, name, given):
    found = outcome(name, tmp_path, given)
    assert found == "worked" or any(f"{key} = " in found for key in given), found


def outcome(name: str, folder: Path, given: dict[str, Any]) -> str:
    """``worked``, or what the first cells say when they refuse it; a later error fails the test."""
    before = shipped()
    done = run_elsewhere(name, folder, given)
    assert shipped() == before
    if done.returncode == 0:
        return "worked"
    first = code_cells(folder / "out.ipynb")[: FIRST + 1]  # and what papermill puts among them
    errors = [o.evalue for cell in first for o in cell.outputs if o.output_type == "error"]
    named = [error for error in errors if re.match(r"\w+(\[.*\])? = .*must", error)]
    return named[0] if named else pytest.fail(done.stderr, pytrace=False)
