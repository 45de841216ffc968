"""Bad parameters of a notebook are refused by name in its first cells, before any work."""

import re

import pytest
from by_hand import NAMES, SMOKE, begin, defaults

# By the type of the default; None stands for what may be left out.
BAD = {
    int: (0, -1, 2.5, "three", [3], True),
    list: (3, "x", [], [None], [-1.0]),
    str: (5, "", [3]),
    type(None): (0, 2.5, "three"),
}


CASES = [
    (name, parameter, value)
    for name in NAMES
    for parameter, default in defaults(name).items()
    for value in BAD[type(default)]
]


@pytest.mark.parametrize(("name", "parameter", "value"), CASES)
def test_bad_parameter_is_refused_by_name(name, parameter, value):
    with pytest.raises((TypeError, ValueError, OSError), match=rf"^{parameter}(\[.*\])? = "):
        begin(name, **{parameter: value})


@pytest.mark.parametrize(
    ("colors", "rule"),
    [
        (["red"], "two colours"),
        (["red", "green", "blue"], "two colours"),
        (["red", "red"], "not name a value twice"),
        (["red", "gren"], "one of red, green, blue, purple, yellow; did you mean 'green'"),
        (["red", "grey"], "one of red, green, blue, purple, yellow"),  # the test domain
        ("red", "a list of some of"),
    ],
)
def test_training_colours_that_cannot_be(colors, rule):
    with pytest.raises(
        (TypeError, ValueError), match=rf"^train_colors.* = .*must .*{re.escape(rule)}"
    ):
        begin("keys", train_colors=colors)


@pytest.mark.parametrize(
    ("more", "fewer"),
    [
        ("num_runs_variants", "num_runs"),
        ("num_runs_regularized", "num_runs"),
        ("num_runs_live", "num_runs_curves"),
    ],
)
def test_runs_of_keys_that_nothing_stands_beside_are_refused(more, fewer):
    with pytest.raises(ValueError, match=rf"^{more} = 7: must be at most {fewer} = 6$"):
        begin("keys", **SMOKE["keys"] | {fewer: 6, more: 7})


@pytest.mark.parametrize("name", sorted({name for name, *_ in CASES}))
def test_defaults_are_taken(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    begin(name)
