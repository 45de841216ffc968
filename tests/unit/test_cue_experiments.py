"""The cued maze: its rules beside the game as it is played, V-REx by hand, and what is shipped."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from experiments.cue import outcomes, theory, training
from experiments.experiment import filled
from experiments.paper import read_paper
from experiments.store import Store, asked
from ipo.causality.small_games import GameSettings, last
from ipo.game import average
from ipo.worlds.cued_maze import cued_maze
from ipo.worlds.tabular import TabularDomains, expected_return

DATA = Path(__file__).resolve().parents[2] / "data"
RESULTS = DATA / "results" / "cue"
GRIDS = {2: theory.STRONGER, 3: theory.COARSE, 4: theory.COARSE}
NUM_UPDATES, NUM_UPDATES_FIRST, NUM_RUNS = 60, 25, 30
POINT = (0.9, -0.3)  # where steps and frames are varied
ASKED = {
    "two_domains": training.phase_cells(theory.points(2, theory.STRONGER), NUM_UPDATES),
    "three_domains": training.phase_cells(theory.points(3, theory.COARSE), NUM_UPDATES),
    "four_domains": training.phase_cells(theory.points(4, theory.COARSE), NUM_UPDATES),
    "encodings": training.encoding_cells([POINT, (0.9, -0.9)], NUM_UPDATES),
    "many_steps": training.many_step_cells(theory.contested(2, theory.STRONGER), NUM_UPDATES_FIRST),
    "varied": training.varied_cells(POINT, NUM_UPDATES),
}


# ------------------------------------------------------------------------------ what is predicted


def test_predictions_are_those_that_were_committed():
    committed = read_paper("cue", DATA / "predictions")
    pd.testing.assert_frame_equal(theory.predictions(), committed)


@pytest.mark.parametrize(
    ("cues", "one_player", "players"),
    [
        ((0.9, -0.3), "cue", "landmark"),  # a mean of 0.3; opposite signs
        ((0.9, -0.5), "landmark", "landmark"),  # a mean of 0.2
        ((0.5, 0.1), "cue", "landmark"),  # a mean of 0.3; a product of 0.05, below 0.0625
        ((0.7, 0.1), "cue", "cue"),  # a product of 0.07
        ((0.6, 0.6, -0.9), "landmark", "cue"),  # a mean of 0.1; a majority
        ((0.1, 0.1, 0.1, 0.9), "cue", "landmark"),  # a mean of 0.3; a majority
    ],
)
def test_rules_by_hand(cues, one_player, players):
    assert (theory.pooled(cues), theory.game(cues)) == (one_player, players)


@pytest.mark.parametrize("num_domains", [2, 3, 4])
@pytest.mark.parametrize(("method", "rule"), [("pooled", theory.pooled), ("ipo", theory.game)])
def test_rules_are_how_the_game_ends(num_domains, method, rule):
    """Exact returns, a weight for each sign, players within wide bounds."""
    points = theory.points(num_domains, GRIDS[num_domains])
    cues = torch.tensor(points, dtype=torch.float64)
    start = torch.zeros(len(points), 2, dtype=torch.float64)
    settings = GameSettings(method, "adam", learning_rate=0.05, num_rounds=600, bound=6.0)
    a, b = average(last([theory.cost(c) for c in cues.T], start, settings)).unbind(-1)
    ends = {p: "cue" if u < v else "landmark" for p, u, v in zip(points, a, b, strict=True)}
    assert ends == {p: rule(p) for p in points}


@given(st.floats(-1, 1), st.floats(-4, 4), st.floats(-4, 4))
def test_cost_of_two_weights_is_the_mazes(cue, a, b):
    task = cued_maze(cue)
    mark, sign, at_junction = task.images.T
    right = 1 / (1 + np.exp(-(a * mark + b * sign)))
    policy = np.stack([1 - at_junction, at_junction * (1 - right), at_junction * right], 1)
    found = theory.cost(torch.tensor([cue]))(torch.tensor([[a, b]], dtype=torch.float64))
    assert -found.item() == pytest.approx(expected_return(task, policy[None])[0][0])


@pytest.mark.parametrize("cues", [(0.9, 0.5), (0.9, -0.3), (0.6, 0.6, 0.1)])
@pytest.mark.parametrize("penalty", [0.5, 3, 20])
def test_cue_use_is_the_best_for_its_penalty(cues, penalty):
    """Among policies that follow both signs where they agree, by trying them all."""
    use = np.linspace(0, 1, 10_001)
    returns = np.array(
        [
            0.5 + 0.5 * ((theory.STRENGTH + c) * 0.5 + (theory.STRENGTH - c) * (0.5 - use))
            for c in cues
        ]
    )
    best = use[np.argmax(returns.mean(0) - penalty * returns.var(0))]
    assert theory.cue_use(cues, penalty) == pytest.approx(best, abs=1e-3)


@given(st.floats(-1, 1), st.lists(st.floats(-1, 1), min_size=2, max_size=4))
def test_spread_of_returns(use, cues):
    """Returns at both extremes differ by ``use``, and are linear between them."""
    returns = [0.5 + 0.5 * c * use for c in cues]
    assert theory.spread(cues, use) == pytest.approx(max(returns) - min(returns))


def test_penalty_is_the_smallest_that_is_enough():
    assert theory.chosen_penalty({10: 0.019, 100: 0.001}) == 10
    assert theory.chosen_penalty({100: 0.001, 10: 0.021}) == 100
    assert theory.chosen_penalty({10: 0.3, 100: 0.2}) == 100


# -------------------------------------------------------------------------------------- training


def tiny(method="ppo", cues=(0.9, -0.9), **more):
    settings = replace(training.one_step(method, 1), num_envs=16)
    return training.Cell(settings, cues, **more)


def test_vrex_is_ppo_with_a_penalty_on_the_variance_of_returns():
    *_, cell = training.phase_cells([(0.9, -0.9)], 2)
    assert cell.columns["method"] == "vrex_100" and cell.settings.method == "ppo"
    almost_none = replace(tiny().settings, variance_penalty=1e-12)
    with_penalty = training.run_cell(replace(tiny(), settings=almost_none), [0, 1])
    np.testing.assert_allclose(with_penalty["value"], training.run_cell(tiny(), [0, 1])["value"])


@pytest.mark.parametrize("encoding", training.ENCODINGS)
def test_rows_are_exact_returns_at_both_extremes(encoding):
    cell = tiny("ipo", encoding=encoding)
    rows = training.run_cell(cell, [3, 1])
    *_, (_, players) = training.training(cell, [3, 1]).reports()
    seen = TabularDomains([cued_maze(0.0)]).observation_of[0]
    logits, _ = training.network(encoding).frozen(players)(torch.tensor(seen).expand(2, -1))
    for cue in (-1, 1):
        own = rows[rows["domain"] == str(cue)].set_index("run")["value"]
        expected = expected_return(cued_maze(cue), logits.softmax(-1).numpy())[0]
        np.testing.assert_allclose(own[[3, 1]], expected, rtol=1e-4)


# -------------------------------------------------------------------------------------- outcomes


@pytest.mark.parametrize(
    ("worst", "plain", "expected"),
    [(0.62, 0.62, "landmark"), (0.02, 0.5, "cue"), (0.5, 0.5, "neither"), (0.32, 0.57, "landmark")],
)
def test_what_policies_follow(worst, plain, expected):
    assert outcomes.follows(worst, plain) == expected


def rows_of(returns: dict[tuple[str, str], tuple[float, float]]) -> pd.DataFrame:
    """Rows of 10 runs at one point from mean returns with a wrong and with a right cue."""
    noise = np.random.default_rng(0).normal(scale=0.01, size=10)
    return pd.DataFrame(
        {"encoding": "signs", "cues": cues, "method": method, "run": run, "domain": domain}
        | {"metric": "return_exact", "value": mean + noise[run] * (1 + (method == "ipo"))}
        for (cues, method), means in returns.items()
        for domain, mean in zip(("-1", "1"), means, strict=True)
        for run in range(10)
    )


def test_differences_count_where_they_are_large_and_sure():
    rows = rows_of(
        {
            ("0.9 -0.3", "ipo"): (0.6, 0.6),
            ("0.9 -0.3", "ppo"): (0.1, 0.9),
            ("0.9 -0.5", "ipo"): (0.6, 0.6),
            ("0.9 -0.5", "ppo"): (0.55, 0.7),  # sure, and small
            ("0.6 0.6 -0.9", "ipo"): (0.9, 0.1),  # the cue's sign does not matter
            ("0.6 0.6 -0.9", "ppo"): (0.6, 0.6),
        }
    )
    found = outcomes.differences(outcomes.by_run(rows), ["ppo"]).set_index("cues")
    assert found["verdict"].to_dict() == {
        "0.9 -0.3": "better",
        "0.9 -0.5": "alike",
        "0.6 0.6 -0.9": "worse",
    }
    assert found["mean"]["0.9 -0.3"] == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize(
    ("ipo", "other", "expected"),
    [
        ("landmark", "cue", "better"),
        ("neither", "cue", "better"),
        ("neither", "landmark", "worse"),
        ("cue", "cue", "alike"),
    ],
)
def test_predicted_difference(ipo, other, expected):
    assert outcomes.predicted_difference(ipo, other) == expected


def test_vrex_stands_once_with_the_penalty_of_its_training_domains():
    rows = rows_of(
        {
            ("0.9 -0.3", "ppo"): (0.1, 0.9),
            ("0.9 -0.3", "vrex_10"): (0.6, 0.62),  # a spread of 0.6 * 0.02
            ("0.9 -0.3", "vrex_100"): (0.5, 0.5),
            ("0.9 0.7", "vrex_10"): (0.1, 0.9),
            ("0.9 0.7", "vrex_100"): (0.2, 0.8),  # 0.06: not enough, but the largest
        }
    )
    runs = outcomes.with_chosen_penalty(outcomes.by_run(rows))
    mean = runs["worst"].groupby(level=["cues", "method"]).mean()
    assert mean.index.tolist() == [("0.9 -0.3", "ppo"), ("0.9 -0.3", "vrex"), ("0.9 0.7", "vrex")]
    assert mean["0.9 -0.3", "vrex"] == pytest.approx(0.6, abs=0.01)
    assert mean["0.9 0.7", "vrex"] == pytest.approx(0.2, abs=0.01)


def test_methods_of_all_cells_have_a_name():
    cells = ASKED["two_domains"]
    names = {cell.columns["method"]: outcomes.name_of(cell.columns["method"]) for cell in cells}
    assert names["in_turn"] == "one network, one domain at a time"
    assert names["vrex_10"] == "V-REx, weight 10"


def test_returns_in_training_are_between_those_at_the_extremes():
    """Cues 0.9 and -0.3, mean 0.3: 0.35 of the way down from the right cue to the wrong one."""
    rows = rows_of({("0.9 -0.3", "ppo"): (0.1, 0.9)})
    found = outcomes.in_training(outcomes.by_run(rows))
    expected = rows.groupby("domain")["value"].mean()
    assert found.item() == pytest.approx(0.65 * expected["1"] + 0.35 * expected["-1"])


# -------------------------------------------------------------------------------- what is shipped


@pytest.mark.parametrize("name", training.EXPERIMENTS)
def test_rows_are_whole_and_what_the_chapter_asks_for(name):
    experiment, store = training.EXPERIMENTS[name], Store(RESULTS, name)
    wanted = [asked(experiment, cell, range(NUM_RUNS)) for cell in ASKED[name]]
    store.rows()  # each batch is checked against its digest
    recorded = [
        {key: batch[key] for key in wanted[0]} | {"cell": filled(experiment.cell, batch["cell"])}
        for batch in store.batches()
    ]
    assert sorted(map(json.dumps, recorded)) == sorted(map(json.dumps, wanted))
    assert all(batch["seeds"] == list(range(NUM_RUNS)) for batch in store.batches())


@pytest.mark.parametrize("name", training.EXPERIMENTS)
def test_shipped_returns_are_possible(name):
    values = Store(RESULTS, name).rows()["value"]
    assert values.between(0, 1).all()
