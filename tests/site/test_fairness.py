"""The pages on fairness and deviations: made from rows, and their sentences hold."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import yaml

import deviations
import fairness
import measured
from experiments.registry import DATA
from measured import NO_BREAK
from rules import NoData

PAGE = yaml.safe_load((DATA / "fairness.yml").read_text("utf-8"))

# ----------------------------------------------------------------------------- differences


@pytest.fixture
def by_hand(monkeypatch) -> None:
    """Ten runs of one arm and twelve of another in two domains; the second has 2 less in each."""
    lines = [
        (method, run, domain, "cost", level + run + (0.1 * run if method == "b" else 0))
        for method, runs, level in (("a", 12, 5.0), ("b", 10, 3.0))
        for run in range(runs)
        for domain in ("x", "y")
    ]
    columns = ["method", "run", "domain", "metric", "value"]
    monkeypatch.setattr(measured, "rows", lambda _: pd.DataFrame(lines, columns=columns))


PROBLEM = {"where": {"metric": "cost"}, "domains": ["x", "y"], "sign": -1, "scale": 10, "digits": 1}
ARMS = {"results": ["toy/rows"], "of": {"method": "b"}, "against": {"method": "a"}}


def test_a_difference_by_hand(by_hand):
    """b costs 2 - 0.1 run less: 1.55 on average, t of 9 degrees of freedom is 2.262."""
    half = 2.262157 * np.std(0.1 * np.arange(10), ddof=1) / np.sqrt(10)
    expected = f"+15.5{NO_BREAK}[+{10 * (1.55 - half):.1f},{NO_BREAK}+{10 * (1.55 + half):.1f}]"
    assert measured.difference(PROBLEM, ARMS) == expected
    turned = measured.difference(PROBLEM | {"sign": 1}, ARMS)
    assert turned.startswith(f"−15.5{NO_BREAK}[−")


def test_an_arm_with_few_runs_says_how_many(by_hand, monkeypatch):
    rows = measured.rows("toy/rows")
    monkeypatch.setattr(measured, "rows", lambda _: rows[rows["run"] < 3])
    with pytest.raises(NoData, match="3 of 10 runs"):
        measured.difference(PROBLEM, ARMS)
    assert measured.difference(PROBLEM, ARMS | {"num_runs": 3}).endswith("] (3 pairs)")


def test_an_arm_without_rows_has_no_difference(by_hand):
    with pytest.raises(NoData, match="method c: 0 of 10 runs"):
        measured.difference(PROBLEM, ARMS | {"of": {"method": "c"}})


# ----------------------------------------------------------------------------------- pages


def test_every_aspect_speaks_of_every_problem():
    for aspect in PAGE["aspects"]:
        assert aspect.keys() == {"aspect", *PAGE["problems"]}
        for name in PAGE["problems"]:
            assert aspect[name].keys() <= {"unequal", "measured"}


def test_pages_have_every_difference():
    page = fairness.table()
    entries = [aspect[name] for aspect in PAGE["aspects"] for name in PAGE["problems"]]
    names = [name for entry in entries for name in entry.get("measured", {})]
    assert page.count("**") == 2 * (len(names) + len(PAGE["aspects"]))
    other = yaml.safe_load((DATA / "deviations.yml").read_text("utf-8"))
    listed = [entry for own in other.values() for entry in own]
    assert all({"effect", "measured"} & entry.keys() for entry in listed)
    assert deviations.tables().count("{ref}`") == len(listed)


def interval(problem: str, aspect: str, name: str) -> tuple[float, float]:
    (entry,) = (own[problem] for own in PAGE["aspects"] if own["aspect"] == aspect)
    text = measured.difference(PAGE["problems"][problem], entry["measured"][name])
    inside = text.replace("−", "-").partition("[")[2].partition("]")[0]
    low, high = inside.split(f",{NO_BREAK}")
    return float(low), float(high)


def test_the_sentences_on_linear_control():
    for aspect in ("Learning rate", "Gradient steps", "Ensembling", "Network size"):
        (entry,) = (own["lqr"] for own in PAGE["aspects"] if own["aspect"] == aspect)
        assert all(interval("lqr", aspect, name)[0] > 0 for name in entry["measured"])
    low, high = interval("lqr", "Optimiser", "plain steps in both")
    assert -0.1 < low <= high < 0.1
    published, _ = interval("lqr", "As published", "as published")
    single = "against one controller and one Adam, on one domain at a time"
    _, high = interval("lqr", "Optimiser", single)
    assert high < 0.1 * published


def test_the_sentences_on_keys():
    low, high = interval("keys", "As published", "as published")
    assert low < 0 < high
    for aspect, name in (
        ("Learning rate", "both 0.001"),
        ("Ensembling", "against two networks on pooled data"),
        ("Normalisation of rewards", "advantages normalised in both"),
    ):
        assert interval("keys", aspect, name)[1] < 0
    for aspect, name in (
        ("Network size", "against PPO with as many"),
        (
            "Weights of the domains",
            "three quarters of the frames in red, learning rates as published",
        ),
    ):
        assert interval("keys", aspect, name)[0] > 0


def test_the_sentence_on_doors():
    found = [
        interval("door", aspect["aspect"], name)
        for aspect in PAGE["aspects"]
        for name in aspect["door"].get("measured", {})
    ]
    assert len(found) >= 4 and all(low < 0 < high for low, high in found)
