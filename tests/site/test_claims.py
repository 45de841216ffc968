"""The verdicts follow the rows: each flips when the numbers do, and none stands without data."""

from __future__ import annotations

import inspect
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.stats
from stored_rows import store_rows

import claims
from experiments.sealed import DamagedError
from experiments.store import ResultsError, Store
from rules import RULES

COLUMNS = [
    "method",
    "num_domains",
    "dim_distractor",
    "optimizer",
    "run",
    "domain",
    "metric",
    "value",
]
PLAIN = {2: (35.3, 35.3), 5: (32.7, 32.8), 10: (32.2, 32.2)}  # gradient descent, IPO


def rows(method, num_domains, dim_distractor, mean, optimizer="adam", spread=0.3) -> list[tuple]:
    """Ten runs of a cell around a mean."""
    cell = (method, num_domains, dim_distractor, optimizer)
    values = mean + np.linspace(-spread, spread, 10)
    return [(*cell, run, "test", "test_cost", value) for run, value in enumerate(values)]


def write(data: Path, name: str, lines: list[tuple]) -> None:
    store_rows(data, name, pd.DataFrame(lines, columns=COLUMNS))


def edit(data: Path, name: str, change) -> None:
    """Pass the rows of a result through a function."""
    chapter, _, file = name.partition("/")
    store_rows(data, name, change(Store(data / "results" / chapter, file).rows()))


def verdict(data: Path, name: str) -> str:
    return claims.decide_all(data)[name].verdict


@pytest.fixture
def empty(tmp_path) -> Path:
    """The claims and the paper's numbers, but no results."""
    shutil.copytree(claims.DATA / "paper", tmp_path / "paper")
    shutil.copy(claims.DATA / "claims.yml", tmp_path)
    return tmp_path


@pytest.fixture
def data(empty) -> Path:
    """Results with exactly the paper's means, a gap that closes, and no gap under plain steps."""
    tables = []
    for cell in claims.load_paper("lqr", empty).itertuples(index=False, name="PaperCell"):
        optimizer = "none" if cell.method == "oracle" else "adam"
        tables += rows(cell.method, cell.num_domains, cell.dim_distractor, cell.mean, optimizer)
    write(empty, "lqr/tables", tables)
    more = rows("ipo_fixed_phi", 20, 1000, 36.0) + rows("ipo_fixed_phi", 50, 1000, 33.0)
    write(empty, "lqr/more_domains", more)
    write_plain(empty, PLAIN)
    return empty


def write_plain(data: Path, costs: dict[int, tuple[float, float]]) -> None:
    lines = []
    for number, (baseline, ipo) in costs.items():
        lines += rows("gradient_descent", number, 1000, baseline, "plain")
        lines += rows("ipo_fixed_phi", number, 1000, ipo, "plain")
    write(data, "lqr/optimizers", lines)


def test_without_results_there_is_no_verdict(empty):
    assert {finding.verdict for finding in claims.decide_all(empty).values()} == {claims.NO_DATA}
    claims.write_fragments(empty, empty)  # and the pages still come


def test_a_cell_with_a_missing_run_does_not_count(data):
    edit(data, "lqr/tables", lambda table: table.drop(index=0))
    finding = claims.decide_all(data)["lqr-numbers"]
    assert finding.verdict == claims.NO_DATA
    assert "9 of 10 runs" in finding.evidence


def test_a_verdict_is_not_flipped_by_hand(data):
    path = data / "results" / "lqr" / "tables.csv"
    path.write_text(path.read_text().replace("97.", "57.", 1))
    with pytest.raises(ResultsError, match=r"tables\.csv: the rows .* are cut short or changed"):
        claims.decide_all(data)


def test_a_number_of_the_paper_is_not_changed_by_hand(data):
    path = data / "paper" / "lqr.csv"
    path.write_text(path.read_text().replace("97.7", "57.7", 1))
    with pytest.raises(DamagedError, match=r"lqr\.csv: is not as SHA256SUMS beside it has it"):
        claims.decide_all(data)


def test_a_digest_that_is_no_text_is_refused_by_its_name(data):
    path = data / "paper" / "SHA256SUMS"
    path.write_bytes(bytes(byte | 128 for byte in path.read_bytes()))
    with pytest.raises(DamagedError, match=r"is not as SHA256SUMS beside it has it"):
        claims.decide_all(data)


def test_a_missing_column_is_an_error_that_names_it(data):
    edit(data, "lqr/tables", lambda table: table.drop(columns="optimizer"))
    with pytest.raises(ValueError, match=r"lqr/tables: no column.*optimizer"):
        claims.decide_all(data)


@pytest.mark.parametrize(
    ("shift", "of", "expected"),
    [
        (0.0, "every cell", claims.REPRODUCED),
        (0.1, "every cell", claims.REPRODUCED),
        (0.5, "one cell", claims.IN_PART),
        (2.0, "every cell", claims.NOT_SUPPORTED),
    ],
)
def test_numbers_come_back_or_not(data, shift, of, expected):
    def change(table):
        table.loc[table.index < (10 if of == "one cell" else len(table)), "value"] += shift
        return table

    edit(data, "lqr/tables", change)
    assert verdict(data, "lqr-numbers") == expected


@pytest.mark.parametrize(
    ("added", "expected"),
    [(0.0, claims.REPRODUCED), (10.0, claims.IN_PART), (100.0, claims.NOT_SUPPORTED)],
)
def test_better_than_gradient_descent(data, added, expected):
    def change(table):
        table.loc[table.method == "ipo_fixed_phi", "value"] += added
        return table

    edit(data, "lqr/tables", change)
    assert verdict(data, "lqr-better-than-gradient-descent") == expected


def test_overparameterised_wins_one_configuration_in_the_paper_itself(data):
    finding = claims.decide_all(data)["lqr-better-than-both-baselines"]
    assert finding.verdict == claims.IN_PART
    assert "34 of 36" in finding.evidence
    assert "6.2 higher than overparameterised at 5 domains, 100 distractors" in finding.evidence


def test_a_difference_within_the_noise_is_not_significant(data):
    def change(table):
        chosen = table.method.str.startswith("ipo") & (table.run % 2 == 0)
        table.loc[chosen, "value"] += 1000.0
        table.loc[table.method.str.startswith("ipo") & (table.run % 2 == 1), "value"] -= 1000.0
        return table

    edit(data, "lqr/tables", change)  # the means are as before
    assert verdict(data, "lqr-better-than-gradient-descent") == claims.REPRODUCED
    assert verdict(data, "lqr-better-than-both-baselines") == claims.NOT_SUPPORTED


@pytest.mark.parametrize(
    ("at_20", "at_50", "expected"),
    [
        (36.0, 33.0, claims.REPRODUCED),
        (42.0, 41.0, claims.IN_PART),
        (44.0, 33.0, claims.NOT_SUPPORTED),
    ],
)
def test_towards_the_oracle(data, at_20, at_50, expected):
    more = rows("ipo_fixed_phi", 20, 1000, at_20) + rows("ipo_fixed_phi", 50, 1000, at_50)
    write(data, "lqr/more_domains", more)
    assert verdict(data, "lqr-more-domains") == expected


@pytest.mark.parametrize(
    ("costs", "expected"),
    [
        (PLAIN, claims.NOT_SUPPORTED),
        ({2: (60, 40), 5: (60, 40), 10: (60, 40)}, claims.REPRODUCED),
        ({2: (60, 40), 5: (32.7, 32.8), 10: (32.2, 32.2)}, claims.IN_PART),
    ],
)
def test_the_gap_survives_plain_steps_or_not(data, costs, expected):
    write_plain(data, costs)
    assert verdict(data, "lqr-because-of-the-game") == expected


def test_the_first_page_shows_the_numbers_of_the_rows(data, tmp_path):
    def change(table):
        chosen = (table.num_domains == 5) & (table.dim_distractor == 1000)
        table.loc[chosen & (table.method == "ipo_fixed_phi"), "value"] += 1.0
        return table

    edit(data, "lqr/tables", change)
    claims.write_fragments(tmp_path, data)
    found = (tmp_path / "_generated" / "found.md").read_text(encoding="utf-8")
    assert "52.3<br>" in found  # the paper's
    assert "53.3<br>" in found  # ours, one higher
    assert "1 not supported" in found


def test_the_page_of_claims_has_every_claim(data, tmp_path):
    claims.write_fragments(tmp_path, data)
    page = (tmp_path / "_generated" / "claims.md").read_text(encoding="utf-8")
    for claim in claims.read_claims(data)["claims"]:
        assert f"({claim['id']})=" in page
        assert claim["where"] in page


@pytest.mark.parametrize("claim", claims.read_claims()["claims"], ids=lambda claim: claim["id"])
def test_every_claim_names_a_rule_and_its_settings(claim):
    parameters = list(inspect.signature(RULES[claim["rule"]]).parameters)
    assert parameters[2:] == list(claim["settings"])
    texts = {"id", "chapter", "title", "claim", "where", "test"}
    assert claim.keys() == texts | {"results", "rule", "settings"}


# ------------------------------------------------------------------------------ coloured keys

KEYS = ["method", "train_colors", "color_encoding", "size", "run", "domain", "metric", "value"]
AS_IN_THE_PAPER = {("ppo", "grey"): (0.80, 0.12), ("ipo", "grey"): (0.85, 0.03)}


def write_keys(data: Path, cells: dict[tuple[str, str], tuple[float, float]]) -> None:
    """A hundred runs of every cell, with this mean and spread, for both metrics."""
    lines = []
    for (method, domain), (mean, spread) in cells.items():
        for metric in ("return_exact", "return_published_protocol"):
            for run in range(100):
                value = mean + spread * scipy.stats.norm.ppf((run + 0.5) / 100)
                lines.append((method, "red+green", "integer", 5, run, domain, metric, value))
    store_rows(data, "keys/main", pd.DataFrame(lines, columns=KEYS))


def training_colors(mean: float) -> dict:
    return {(m, color): (mean, 0.004) for m in ("ppo", "ipo") for color in ("red", "green")}


@pytest.mark.parametrize(
    ("cells", "expected"),
    [
        (training_colors(0.94) | AS_IN_THE_PAPER, claims.REPRODUCED),
        (training_colors(0.90) | AS_IN_THE_PAPER, claims.IN_PART),
        (
            training_colors(0.90) | {("ppo", "grey"): (0.3, 0.1), ("ipo", "grey"): (0.3, 0.1)},
            claims.NOT_SUPPORTED,
        ),
        (AS_IN_THE_PAPER, claims.NO_DATA),
    ],
)
def test_returns_come_back_or_not(empty, cells, expected):
    write_keys(empty, cells)
    assert verdict(empty, "keys-numbers") == expected


@pytest.mark.parametrize(
    ("ipo", "ensemble", "better", "game"),
    [
        (0.85, 0.80, claims.REPRODUCED, claims.REPRODUCED),
        (0.85, 0.85, claims.REPRODUCED, claims.NOT_SUPPORTED),
        (0.81, 0.85, claims.NOT_SUPPORTED, claims.NOT_SUPPORTED),
    ],
)
def test_higher_return_or_not(empty, ipo, ensemble, better, game):
    write_keys(
        empty,
        {
            ("ppo", "grey"): (0.80, 0.10),
            ("ipo", "grey"): (ipo, 0.10),
            ("ensemble", "grey"): (ensemble, 0.10),
        },
    )
    assert verdict(empty, "keys-better") == better
    assert verdict(empty, "keys-because-of-the-game") == game


@pytest.mark.parametrize(
    ("spread", "expected"), [(0.03, claims.REPRODUCED), (0.12, claims.NOT_SUPPORTED)]
)
def test_smaller_spread_or_not(empty, spread, expected):
    write_keys(empty, {("ppo", "grey"): (0.8, 0.12), ("ipo", "grey"): (0.8, spread)})
    assert verdict(empty, "keys-consistent") == expected


# ------------------------------------------------------------------------------- door opening

DOOR = [
    "method", "train_frictions", "steps", "choice", "run", "domain", "door", "metric", "value",
]  # fmt: skip
FULL, HALF = 24903680, 12451840


def write_door(data: Path, name: str, cells: dict, metric: str = "success") -> None:
    """Ten runs of every cell ``(method, steps, domain)`` with two doors each, around a mean."""
    lines = [
        (method, "0.0+0.1", steps, "best", run, domain, door, metric, mean + noise + move)
        for (method, steps, domain), (mean, spread) in cells.items()
        for run, noise in enumerate(np.linspace(-spread, spread, 10))
        for door, move in ((0, -0.001), (1, 0.001))
    ]
    store_rows(data, f"door/{name}", pd.DataFrame(lines, columns=DOOR))


def door_table(data: Path, change: float) -> dict:
    """The paper's means, those of PPO changed, and IPO's for equal steps the same as PPO's."""
    paper = pd.read_csv(data / "paper" / "door.csv").set_index(["method", "domain"])
    cells = {}
    for (method, domain), row in paper.iterrows():
        mean = row["mean"] + (change if method == "ppo" else 0)
        cells[method, FULL if method == "ppo" else HALF, domain] = (mean, 0.005)
        if method == "ppo":
            cells["ipo", FULL, domain] = (mean, 0.005)
    return cells


@pytest.mark.parametrize(
    ("change", "numbers", "better"),
    [
        (0.0, claims.REPRODUCED, claims.IN_PART),
        (0.3, claims.IN_PART, claims.NOT_SUPPORTED),
    ],
)
def test_success_comes_back_or_not(empty, change, numbers, better):
    write_door(empty, "success", door_table(empty, change))
    assert verdict(empty, "door-numbers") == numbers
    assert verdict(empty, "door-better") == better


def test_better_in_both_comparisons(empty):
    cells = door_table(empty, 0.0)
    cells |= {
        ("ipo", FULL, domain): (mean + 0.05, 0.005)
        for (method, _, domain), (mean, _) in door_table(empty, 0.0).items()
        if method == "ppo"
    }
    write_door(empty, "success", cells)
    assert verdict(empty, "door-better") == claims.REPRODUCED


@pytest.mark.parametrize(
    ("ipo", "ppo", "expected"),
    [
        (0.95, 0.05, claims.REPRODUCED),
        (0.95, 0.95, claims.IN_PART),
        (0.50, 0.95, claims.NOT_SUPPORTED),
    ],
)
def test_strategies_come_back_or_not(empty, ipo, ppo, expected):
    cells = {("ipo", HALF, 0.1): (ipo, 0.02), ("ppo", FULL, 0.1): (ppo, 0.02)}
    write_door(empty, "strategies", cells, "inside_part")
    assert verdict(empty, "door-strategies") == expected


@pytest.mark.parametrize(("sign", "expected"), [(1, claims.REPRODUCED), (-1, claims.NOT_SUPPORTED)])
def test_hooks_are_robust_or_not(empty, sign, expected):
    arms = (("ppo", FULL), ("ipo", HALF))
    write_door(empty, "strategies", {(*arm, 1.3): (0.5, 0.3) for arm in arms}, metric="inside_part")
    write_door(empty, "success", {(*arm, 1.5): (0.6, sign * 0.2) for arm in arms})
    assert verdict(empty, "door-hooks-are-robust") == expected
