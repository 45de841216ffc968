"""The verdicts follow the rows: each flips when the numbers do, and none stands without data."""

from __future__ import annotations

import inspect
import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.stats
from stored_rows import store_rows

import claims
import first_page
from experiments.sealed import DamagedError
from experiments.store import ResultsError, Store
from rules import RULES, Finding

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


def finding(data: Path, name: str) -> Finding:
    book = claims.read_claims(data)
    claim = next(claim for claim in book["claims"] if claim["id"] == name)
    return claims.decide(claim, book, claims.read_results(book, data), data)


def verdict(data: Path, name: str) -> str:
    return finding(data, name).verdict


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
    book = claims.read_claims(empty)
    findings = claims.decide_all(book, claims.read_results(book, empty), empty)
    assert {found.verdict for found in findings.values()} == {claims.NO_DATA}
    claims.write_fragments(empty, empty)  # and the pages still come


def test_a_cell_with_a_missing_run_does_not_count(data):
    edit(data, "lqr/tables", lambda table: table.drop(index=0))
    found = finding(data, "lqr-numbers")
    assert found.verdict == claims.NO_DATA
    assert "9 of 10 runs" in found.evidence


def test_a_verdict_is_not_flipped_by_hand(data):
    path = data / "results" / "lqr" / "tables.csv"
    path.write_text(path.read_text().replace("97.", "57.", 1))
    with pytest.raises(ResultsError, match=r"tables\.csv: the rows .* are cut short or changed"):
        verdict(data, "lqr-numbers")


def test_a_number_of_the_paper_is_not_changed_by_hand(data):
    path = data / "paper" / "lqr.csv"
    path.write_text(path.read_text().replace("97.7", "57.7", 1))
    with pytest.raises(DamagedError, match=r"lqr\.csv: is not as SHA256SUMS beside it has it"):
        verdict(data, "lqr-numbers")


def test_a_digest_that_is_no_text_is_refused_by_its_name(data):
    path = data / "paper" / "SHA256SUMS"
    path.write_bytes(bytes(byte | 128 for byte in path.read_bytes()))
    with pytest.raises(DamagedError, match=r"is not as SHA256SUMS beside it has it"):
        verdict(data, "lqr-numbers")


def test_a_missing_column_is_an_error_that_names_it(data):
    edit(data, "lqr/tables", lambda table: table.drop(columns="optimizer"))
    with pytest.raises(ValueError, match=r"lqr/tables: no column.*optimizer"):
        verdict(data, "lqr-numbers")


@pytest.mark.parametrize(
    ("shift", "of", "expected"),
    [
        (0.0, "every cell", claims.REPRODUCED),
        (0.1, "every cell", claims.REPRODUCED),
        (0.5, "one cell", claims.IN_PART),
        (2.0, "every cell", claims.CONTRADICTED),
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
    [(0.0, claims.REPRODUCED), (10.0, claims.IN_PART), (100.0, claims.CONTRADICTED)],
)
def test_better_than_gradient_descent(data, added, expected):
    def change(table):
        table.loc[table.method == "ipo_fixed_phi", "value"] += added
        return table

    edit(data, "lqr/tables", change)
    assert verdict(data, "lqr-better-than-gradient-descent") == expected


def test_overparameterised_wins_one_configuration_in_the_paper_itself(data):
    found = finding(data, "lqr-better-than-both-baselines")
    assert found.verdict == claims.IN_PART
    assert "34 of 36" in found.evidence
    assert "under overparameterised at 5 domains, 100 distractors by −6.2" in found.evidence


def test_a_gain_that_the_paper_does_not_have_is_named(data):
    def change(table):
        chosen = (table.method == "ipo_variable_phi") & (table.dim_distractor == 100)
        table.loc[chosen, "value"] = 30.0 + 0.1 * table["run"]
        return table

    edit(data, "lqr/tables", change)
    found = finding(data, "lqr-better-than-both-baselines")
    assert "35 of 36" in found.evidence
    assert "of the other sign than in the paper: IPO, variable Φ under over" in found.evidence


def test_a_difference_within_the_noise_is_not_significant(data):
    def change(table):
        chosen = table.method.str.startswith("ipo") & (table.run % 2 == 0)
        table.loc[chosen, "value"] += 1000.0
        table.loc[table.method.str.startswith("ipo") & (table.run % 2 == 1), "value"] -= 1000.0
        return table

    edit(data, "lqr/tables", change)  # the means are as before
    assert verdict(data, "lqr-better-than-both-baselines") == claims.UNDECIDED


def moved(data: Path, method: str, by: float, of: str = "every cell") -> None:
    """A method costs what fixed Φ does, and with two domains or everywhere so much more."""

    def change(table):
        fixed = table[table.method == "ipo_fixed_phi"].set_index([*COLUMNS[1:3], "run"])["value"]
        chosen = table.method == method
        cells = pd.MultiIndex.from_frame(table.loc[chosen, [*COLUMNS[1:3], "run"]])
        wiggle = 0.01 * table.loc[chosen, "run"].to_numpy()
        table.loc[chosen, "value"] = fixed.loc[cells].to_numpy() + wiggle
        moves = chosen if of == "every cell" else chosen & (table.num_domains == 2)
        table.loc[moves, "value"] += by
        return table

    edit(data, "lqr/tables", change)


@pytest.mark.parametrize(
    ("by", "of", "similar", "no_benefit"),
    [
        (0.0, "every cell", claims.REPRODUCED, claims.REPRODUCED),
        (-30.0, "one cell", claims.IN_PART, claims.IN_PART),
        (-30.0, "every cell", claims.CONTRADICTED, claims.CONTRADICTED),
        (30.0, "every cell", claims.CONTRADICTED, claims.REPRODUCED),
    ],
)
def test_updating_the_representation_changes_something_or_not(data, by, of, similar, no_benefit):
    moved(data, "ipo_variable_phi", by, of)
    assert verdict(data, "lqr-similar") == similar
    assert verdict(data, "lqr-no-benefit") == no_benefit


@pytest.mark.parametrize(
    ("by", "of", "expected"),
    [
        (-5.0, "every cell", claims.REPRODUCED),
        (-5.0, "one cell", claims.IN_PART),
        (5.0, "every cell", claims.CONTRADICTED),
    ],
)
def test_a_strong_baseline_or_not(data, by, of, expected):
    moved(data, "gradient_descent", 0.0)
    moved(data, "overparameterized", by, of)
    assert verdict(data, "lqr-overparameterized") == expected


@pytest.mark.parametrize(
    ("shift", "expected"),
    [(-5.0, claims.REPRODUCED), (0.0, claims.UNDECIDED), (5.0, claims.CONTRADICTED)],
)
def test_gradient_descent_overfits_or_not(data, shift, expected):
    def with_training(table):
        chosen = table[table.method == "gradient_descent"]
        value = chosen["value"] + shift + np.where(chosen["run"] % 2, 0.1, -0.1)
        trained = chosen.assign(domain="train", metric="train_cost", value=value)
        return pd.concat([table, trained], ignore_index=True)

    edit(data, "lqr/tables", with_training)
    assert verdict(data, "lqr-overfits") == expected


@pytest.mark.parametrize(
    ("at_20", "at_50", "expected"),
    [
        (36.0, 33.0, claims.REPRODUCED),
        (42.0, 41.0, claims.IN_PART),
        (44.0, 33.0, claims.IN_PART),
    ],
)
def test_towards_the_oracle(data, at_20, at_50, expected):
    more = rows("ipo_fixed_phi", 20, 1000, at_20) + rows("ipo_fixed_phi", 50, 1000, at_50)
    write(data, "lqr/more_domains", more)
    assert verdict(data, "lqr-more-domains") == expected


@pytest.mark.parametrize(
    ("costs", "expected"),
    [
        (PLAIN, claims.EXPLAINED),
        ({2: (60, 40), 5: (60, 40), 10: (60, 40)}, claims.REPRODUCED),
        ({2: (60, 40), 5: (32.7, 32.8), 10: (32.2, 32.2)}, claims.IN_PART),
        ({2: (50, 40), 5: (50, 40), 10: (50, 40)}, claims.IN_PART),
    ],
)
def test_the_gap_survives_plain_steps_or_not(data, costs, expected):
    write_plain(data, costs)
    assert verdict(data, "lqr-plain-steps") == expected


@pytest.mark.parametrize(
    ("above", "expected"),
    [
        (0.0, claims.EXPLAINED),  # the control costs what IPO does
        (0.5, claims.IN_PART),
        (1.0, claims.REPRODUCED),  # and here what gradient descent does
    ],
)
def test_one_controller_recovers_the_advantage_or_not(data, above, expected):
    paper = claims.load_paper("lqr", data).set_index(["method", *COLUMNS[1:3]])["mean"]
    lines = []
    for size in paper["ipo_fixed_phi"].index:
        ipo, baseline = paper["ipo_fixed_phi"][size], paper["gradient_descent"][size]
        lines += rows("in_turn", *size, ipo + above * (baseline - ipo))
    assert verdict(data, "lqr-because-of-the-game") == claims.NO_DATA
    write(data, "lqr/turns", lines)
    assert verdict(data, "lqr-because-of-the-game") == expected


def test_the_fitted_methods_are_scored_on_other_runs(data):
    def change(table):
        chosen = (table.method == "ipo_variable_phi") & (table.run >= 3)
        table.loc[chosen, "value"] += 2.0
        table.loc[(table.method == "ipo_variable_phi") & (table.run < 3), "value"] -= 2.0
        return table

    edit(data, "lqr/tables", change)
    found = finding(data, "lqr-numbers")
    assert found.verdict == claims.REPRODUCED
    (name,) = (name for name in found.variants if "runs 3 to 9" in name)
    assert found.variants[name].verdict == claims.IN_PART


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
    assert "1 explained otherwise" in found


def test_without_results_the_first_page_claims_nothing(empty, tmp_path):
    first_page.write_fragments(tmp_path, empty)
    text = (tmp_path / "_generated" / "finding.md").read_text(encoding="utf-8")
    assert text.count(claims.NO_DATA) == 3
    assert "image" not in text


def test_the_picture_is_in_units_of_the_papers_advantage(data):
    book = claims.read_claims(data)
    shown = {row.label: row for row in first_page.advantages(book, data)}
    adam, plain = shown["linear control, Adam"], shown["linear control, plain steps"]
    assert adam.mean == pytest.approx(1)  # the rows have the paper's means
    assert plain.mean == pytest.approx(0, abs=0.01)
    assert len(shown) == 2  # of keys and doors there are no rows


def test_the_page_of_claims_has_every_claim(data, tmp_path):
    claims.write_fragments(tmp_path, data)
    page = (tmp_path / "_generated" / "claims.md").read_text(encoding="utf-8")
    for claim in claims.read_claims(data)["claims"]:
        assert f"({claim['id']})=" in page
        assert claim["where"] in page
        assert f"*Decided by* `{claim['rule']}`" in page
        for choice in claim.get("variants", {}):
            assert f"| {choice} | {{bdg-" in page


def test_negative_numbers_have_a_minus_sign(data):
    book = claims.read_claims(data)
    found = claims.decide_all(book, claims.read_results(book, data), data).values()
    text = " ".join(own.evidence for one in found for own in (one, *one.variants.values()))
    assert "−" in text
    assert not re.search(r"(?<!\w)-\d", text)


@pytest.mark.parametrize("claim", claims.read_claims()["claims"], ids=lambda claim: claim["id"])
def test_every_claim_names_a_rule_and_its_settings(claim):
    parameters = list(inspect.signature(RULES[claim["rule"]]).parameters)
    assert parameters[2:] == list(claim["settings"])
    assert all(variant.keys() <= claim["settings"].keys() for variant in variants(claim))
    texts = {"id", "chapter", "title", "claim", "where", "test"}
    assert claim.keys() - {"variants", "paper", "columns"} == texts | {
        "results",
        "rule",
        "settings",
    }


def variants(claim: dict) -> list[dict]:
    return list(claim.get("variants", {}).values())


# ------------------------------------------------------------------------------ coloured keys

KEYS = ["method", "train_colors", "color_encoding", "size", "run", "domain", "metric", "value"]
AS_IN_THE_PAPER = {("ppo", "grey"): (0.80, 0.12), ("ipo", "grey"): (0.85, 0.03)}


def write_keys(
    data: Path, cells: dict[tuple[str, str], tuple[float, float]], name: str = "keys/main"
) -> None:
    """A hundred runs of every cell, with this mean and spread, for both metrics."""
    lines = []
    for (method, domain), (mean, spread) in cells.items():
        for metric in ("return_exact", "return_published_protocol"):
            for run in range(100):
                value = mean + spread * scipy.stats.norm.ppf((run + 0.5) / 100)
                lines.append((method, "red+green", "integer", 5, run, domain, metric, value))
    store_rows(data, name, pd.DataFrame(lines, columns=KEYS))


def training_colors(mean: float) -> dict:
    return {(m, color): (mean, 0.004) for m in ("ppo", "ipo") for color in ("red", "green")}


@pytest.mark.parametrize(
    ("cells", "expected"),
    [
        (training_colors(0.94) | AS_IN_THE_PAPER, claims.REPRODUCED),
        (training_colors(0.90) | AS_IN_THE_PAPER, claims.IN_PART),
        (
            training_colors(0.90) | {("ppo", "grey"): (0.3, 0.1), ("ipo", "grey"): (0.3, 0.1)},
            claims.CONTRADICTED,
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
        (0.85, 0.85, claims.REPRODUCED, claims.EXPLAINED),
        (0.82, 0.85, claims.IN_PART, claims.EXPLAINED),  # better, but by less than in the paper
        (0.80, 0.85, claims.CONTRADICTED, claims.CONTRADICTED),  # nothing to explain
        (0.75, 0.70, claims.CONTRADICTED, claims.CONTRADICTED),
    ],
)
def test_higher_return_or_not(empty, ipo, ensemble, better, game):
    write_keys(
        empty,
        {
            ("ppo", "grey"): (0.80, 0.10),
            ("ipo", "grey"): (ipo, 0.101),
            ("ensemble", "grey"): (ensemble, 0.10),
        },
    )
    assert verdict(empty, "keys-better") == better
    assert verdict(empty, "keys-because-of-the-game") == game


@pytest.mark.parametrize(
    ("grey", "expected"),
    [(0.79, claims.REPRODUCED), (0.9, claims.IN_PART), (0.97, claims.CONTRADICTED)],
)
def test_standard_training_degrades_or_not(empty, grey, expected):
    write_keys(empty, training_colors(0.94) | {("ppo", "grey"): (grey, 0.01)})
    assert verdict(empty, "keys-degrades") == expected


@pytest.mark.parametrize(
    ("ipo", "expected"),
    [(0.90, claims.REPRODUCED), (0.80, claims.CONTRADICTED)],
)
def test_better_in_the_worst_colour_or_not(empty, ipo, expected):
    worst = {("ppo", "grey"): (0.80, 0.1), ("ipo", "grey"): (ipo, 0.101)}
    write_keys(empty, training_colors(0.94) | worst)
    assert verdict(empty, "keys-worst") == expected


@pytest.mark.parametrize(
    ("short", "long", "expected"),
    [
        (0.79, 0.79, claims.CONTRADICTED),
        (0.74, 0.79, claims.IN_PART),
        (0.74, 0.70, claims.REPRODUCED),
    ],
)
def test_updating_the_convolutions_has_a_benefit_or_not(empty, short, long, expected):
    """At the paper's frames, and at twice as many."""
    arms = {
        ("ipo_phi_short", "grey"): (short, 0.1),
        ("ipo_phi", "grey"): (long, 0.1),
        **{(baseline, "grey"): (0.75, 0.101) for baseline in ("ipo", "ipo_inner2")},
    }
    write_keys(empty, arms, "keys/in_full")
    assert verdict(empty, "keys-no-benefit") == expected
    found = finding(empty, "keys-no-benefit").variants
    again = next(name for name in found if "runs 50 to 99" in name)
    assert "50 runs" in found[again].evidence


@pytest.mark.parametrize(
    ("spread", "expected"),
    [(0.03, claims.REPRODUCED), (0.1, claims.IN_PART), (0.13, claims.CONTRADICTED)],
)
def test_smaller_spread_or_not(empty, spread, expected):
    write_keys(empty, {("ppo", "grey"): (0.8, 0.12), ("ipo", "grey"): (0.8, spread)})
    assert verdict(empty, "keys-consistent") == expected


# ------------------------------------------------------------------------------- door opening

DOOR = [
    "method", "train_frictions", "steps", "choice", "run", "domain", "door", "metric", "value",
]  # fmt: skip
FULL, HALF = 24903680, 12451840


def write_door(data: Path, name: str, **cells_of_metric: dict) -> None:
    """Ten runs of every cell ``(method, steps, domain)`` with two doors each, around a mean."""
    lines = [
        (method, "0.0+0.1", steps, "best", run, domain, door, metric, mean + noise + move)
        for metric, cells in cells_of_metric.items()
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
        (0.3, claims.IN_PART, claims.CONTRADICTED),
    ],
)
def test_success_comes_back_or_not(empty, change, numbers, better):
    write_door(empty, "success", success=door_table(empty, change))
    assert verdict(empty, "door-numbers") == numbers
    assert verdict(empty, "door-better") == better


def test_better_in_both_comparisons(empty):
    cells = door_table(empty, 0.0)
    cells |= {
        ("ipo", FULL, domain): (mean + 0.05, 0.005)
        for (method, _, domain), (mean, _) in door_table(empty, 0.0).items()
        if method == "ppo"
    }
    write_door(empty, "success", success=cells)
    assert verdict(empty, "door-better") == claims.REPRODUCED


@pytest.mark.parametrize(
    ("part", "spread", "hooks", "outside"),
    [
        (0.95, 0.02, claims.REPRODUCED, claims.CONTRADICTED),
        (0.05, 0.02, claims.CONTRADICTED, claims.REPRODUCED),
        (0.36, 0.35, claims.CONTRADICTED, claims.UNDECIDED),  # three of ten pull outside
    ],
)
def test_policies_pull_in_one_way_or_not(empty, part, spread, hooks, outside):
    cells = {(*arm, 0.1): (part, spread) for arm in (("ipo", HALF), ("ppo", FULL))}
    write_door(empty, "strategies", inside_part=cells)
    assert verdict(empty, "door-strategies") == hooks
    assert verdict(empty, "door-outside") == outside


@pytest.mark.parametrize(
    ("ipo", "ppo", "expected"),
    [
        (0.95, 0.05, claims.REPRODUCED),
        (0.95, 0.94, claims.CONTRADICTED),
        (0.05, 0.95, claims.CONTRADICTED),
    ],
)
def test_policies_differ_in_kind_or_not(empty, ipo, ppo, expected):
    parts = {("ipo", HALF, 0.1): (ipo, 0.02), ("ppo", FULL, 0.1): (ppo, 0.02)}
    write_door(empty, "strategies", inside_part=parts)
    assert verdict(empty, "door-qualitative") == expected


@pytest.mark.parametrize(
    ("sign", "expected"),
    [(1, claims.REPRODUCED), (0, claims.UNDECIDED), (-1, claims.CONTRADICTED)],
)
def test_hooks_are_robust_or_not(empty, sign, expected):
    arms = (("ppo", FULL), ("ipo", HALF))  # the first of ten runs pull outside, the last hook
    write_door(empty, "strategies", inside_part={(*arm, 0.1): (0.5, 0.45) for arm in arms})
    write_door(empty, "success", success={(*arm, 1.5): (0.6, sign * 0.2) for arm in arms})
    found = finding(empty, "door-hooks-are-robust")
    assert found.verdict == expected
    assert (
        found.variants["share of the hook's inside and success of policies, not matched"].verdict
        == expected
    )


@pytest.mark.parametrize(
    ("opened", "spread", "expected"),
    [
        (0.97, 0.01, claims.REPRODUCED),
        (0.9, 0.1, claims.UNDECIDED),
        (0.5, 0.1, claims.CONTRADICTED),
    ],
)
def test_the_outside_serves_or_not(empty, opened, spread, expected):
    arms = (("ppo", FULL), ("ipo", HALF))
    write_door(
        empty,
        "strategies",
        inside_part={(*arm, 0.1): (0.05, 0.02) for arm in arms},
        success={(*arm, 0.1): (opened, spread) for arm in arms},
    )
    assert verdict(empty, "door-outside-viable") == expected


@pytest.mark.parametrize(
    ("cost", "expected"),
    [
        ([0.0, 0.0], claims.REPRODUCED),
        ([0.0, 0.5], claims.IN_PART),
        ([0.5, 0.5], claims.CONTRADICTED),
    ],
)
def test_equilibria_of_relu_networks(empty, cost, expected):
    """Of two architectures; games that are not at rest say nothing."""
    ends = [(width, run, 0.0, own) for width, own in enumerate(cost, 1) for run in range(2)]
    ends.append((1, 2, 0.1, 0.9))
    lines = [
        ("no_bias", width, 1.0, run, "train", metric, value)
        for width, run, gap, own in ends
        for metric, value in (("gap", gap), ("cost", own))
    ]
    columns = ["method", "width", "scale", "run", "domain", "metric", "value"]
    store_rows(empty, "algorithm/relu", pd.DataFrame(lines, columns=columns))
    found = finding(empty, "algorithm-relu")
    assert found.verdict == expected
    assert found.variants["starts ten times as large"].verdict == claims.NO_DATA
