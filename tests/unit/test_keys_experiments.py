"""The coloured-keys experiment: its protocol by hand, what networks see, and the shipped data."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.stats
import torch
from minigrid.core.constants import OBJECT_TO_IDX

from experiments import keys as experiment
from experiments import keys_in_full, keys_labels, keys_tables
from experiments.experiment import filled, plain, rebuilt
from experiments.keys import (
    Cell,
    Keys,
    encode,
    evaluate,
    exact,
    published,
    published_protocol,
    recolor,
    returns,
    run_cell,
    run_curve,
)
from experiments.keys_tables import runs_of
from experiments.policies import load_policy
from experiments.registry import CHAPTERS
from experiments.regularized import trials
from experiments.store import Batch, Store
from experiments.tables import beside_shipped
from experiments.visits import occupancy
from ipo.worlds.colored_keys import COLORS
from ipo.worlds.networks import GridNetwork
from ipo.worlds.tabular import TabularDomains, TabularTask, expected_return

DATA = Path(__file__).resolve().parents[2] / "data"
RESULTS, POLICIES = DATA / "results" / "keys", DATA / "policies" / "keys"
CELL = ["method", "train_colors", "color_encoding", "size"]
EXACT = {"return_exact", "return_greedy", "success", "reaches_key", "unlocks_door", "entropy"}
TINY = {
    "num_updates": 2,
    "num_envs": 4,
    "num_steps": 16,
    "minibatch_size": 32,
    "num_epochs": 2,
}


# -------------------------------------------------------------------- published protocol


def corridor(starts: list[float], horizon: int = 6) -> TabularTask:
    """Cells in a row, the goal beyond the last: action 1 goes on, action 0 stays."""
    cells = np.arange(len(starts))
    goal = np.stack([cells < 0, cells == cells[-1]], axis=1)
    return TabularTask(
        next_state=np.stack([cells, np.minimum(cells + 1, cells[-1])], axis=1),
        goal=goal,
        done=goal,
        goal_reward=1 - 0.9 * np.arange(1, horizon + 1) / horizon,
        start=np.array(starts),
        observation=cells[::-1].copy(),  # not in the order of states
        images=np.zeros((len(cells), 1, 1, 1)) + cells[:, None, None, None],
        progress=np.zeros(len(cells), dtype=int),
        position=np.stack([cells, cells], axis=1),
        signature=cells.astype(np.uint64),
    )


def in_a_domain(
    task: TabularTask, logits: torch.Tensor, generators: list[np.random.Generator]
) -> np.ndarray:
    """The protocol in the only domain there is; logits are of the task's own images."""
    domains = TabularDomains([task])
    logits = logits[:, np.argsort(domains.observation_of[0])]
    (found,) = published_protocol(domains, logits, [generators])
    return found


def slow_protocol(
    task: TabularTask, probabilities: np.ndarray, rng: np.random.Generator
) -> tuple[float, int]:
    """Fifty copies, one by one, until a hundred episodes are over; also how many are."""

    def begin(uniform: float) -> int:
        return int((uniform >= np.cumsum(task.start)).sum())

    states, ages = [begin(u) for u in rng.random(50)], [0] * 50
    returns = []
    while len(returns) < 100:
        chances, starts = rng.random(50), rng.random(50)
        for copy in range(50):
            below = np.cumsum(probabilities[task.observation[states[copy]]])
            action = int((chances[copy] >= below[:-1]).sum())
            reached = task.goal[states[copy], action]
            states[copy] = task.next_state[states[copy], action]
            ages[copy] += 1
            if reached or ages[copy] == task.horizon:
                returns.append(task.goal_reward[ages[copy] - 1] if reached else 0)
                states[copy], ages[copy] = begin(starts[copy]), 0
    return float(np.mean(returns)), len(returns)


@pytest.mark.parametrize("go", [0.3, 0.6, 0.95])
def test_published_protocol_by_hand(go):
    task = corridor([0.25, 0.25, 0.5])
    probabilities = np.array([[1 - go, go], [1 - go / 2, go / 2], [0.5, 0.5]])
    logits = torch.tensor(np.stack([probabilities] * 3)).log()
    found = in_a_domain(task, logits, [np.random.default_rng(run) for run in range(3)])
    slow = [slow_protocol(task, probabilities, np.random.default_rng(run)) for run in range(3)]
    assert found == pytest.approx([mean for mean, _ in slow], rel=1e-6)
    assert all(count >= 100 for _, count in slow)


def test_protocol_of_the_only_episode_there_is():
    """Everybody reaches the goal in the second step: two rounds of fifty are over after four."""
    logits = torch.tensor([[[-100.0, 100.0]] * 2])
    found = in_a_domain(corridor([1.0, 0.0]), logits, [np.random.default_rng(0)])
    assert found == pytest.approx([1 - 0.9 * 2 / 6])


def test_protocol_favours_short_episodes():
    """Half of all episodes take one step, the others all six; 100 runs, to 10 standard errors."""
    task = corridor([0.0, 0.0, 0.0, 0.5, 0.5])
    policy = np.array([[0.0, 1.0]] + [[1.0, 0.0]] * 4)  # from the last cell alone
    (value,), _ = expected_return(task, policy[None])
    assert value == pytest.approx(0.5 * (1 - 0.9 / 6))
    logits = torch.tensor(np.stack([policy] * 100)).clamp(1e-30).log()
    found = in_a_domain(task, logits, [np.random.default_rng(run) for run in range(100)])
    assert found.mean() - value > 10 * found.std() / 10


def test_protocol_of_the_coloured_keys_by_hand(keys):
    """The numbers of observations are those of the colour, not those of a pooled table."""
    task = keys["blue"]
    rng = np.random.default_rng(0)
    votes = np.zeros((289, 7))
    best = np.array([2, 2, 5, 3, 0, 1])
    votes[np.arange(289), best[rng.integers(0, 6, size=289)]] = 1
    probabilities = 0.3 * votes + 0.1
    logits = torch.tensor(probabilities)[None].log()
    (found,) = in_a_domain(task, logits, [np.random.default_rng(1)])
    assert 0 < found < 1
    assert found == pytest.approx(slow_protocol(task, probabilities, np.random.default_rng(1))[0])


# ----------------------------------------------------------------------------- encodings


@pytest.mark.parametrize(("name", "channels"), [("integer", 3), ("one_hot", 8), ("none", 2)])
def test_encodings_by_hand(keys, name, channels):
    images = keys["purple"].images
    encoded = encode(images, name)
    assert encoded.shape == (289, 7, 7, channels) and encoded.dtype == torch.float32
    for k, i, j in [(0, 0, 0), (5, 3, 6), (100, 3, 5), (288, 2, 4), (17, 4, 4)]:
        kind, color, state = (float(code) for code in images[k, i, j])
        expected = {
            "integer": [kind, color, state],
            "one_hot": [kind, state] + [float(color == code) for code in range(6)],
            "none": [kind, state],
        }
        assert encoded[k, i, j].tolist() == expected[name]


def test_without_color_all_domains_look_the_same(keys):
    seen = [encode(keys[color].images[keys[color].observation], "none") for color in COLORS]
    assert all(torch.equal(images, seen[0]) for images in seen)
    assert not torch.equal(
        *(encode(keys[color].images[keys[color].observation], "integer") for color in COLORS[:2])
    )


def test_recoloured_images_are_those_of_the_other_domain(keys):
    grey, red = (keys[color].images[keys[color].observation] for color in ("grey", "red"))
    assert np.array_equal(recolor(grey, {"key": 0, "door": 0}), red)
    before = grey.copy()
    key_only = recolor(grey, {"key": 9})
    assert np.array_equal(grey, before)
    changed = grey[..., 0] == OBJECT_TO_IDX["key"]
    assert (key_only[changed][:, 1] == 9).all()
    assert np.array_equal(key_only[~changed], grey[~changed])


# ---------------------------------------------------------------------------- evaluation


def tiny_cell(method: str, **options) -> Cell:
    return Cell(method, published(method, **TINY), **options)


@pytest.fixture(scope="module")
def trained(tables) -> tuple[Keys, list]:
    task = Keys(tables)
    *_, (_, players) = task.train(tiny_cell("ipo"), [0, 1])
    return task, players


def test_exact_metrics_are_those_of_the_average_policy(trained):
    task, players = trained
    metrics = exact(task, players)
    assert metrics.keys() == {(color, name) for color in COLORS for name in EXACT}
    table = task.tasks["yellow"]
    doubled = [{name: w.detach().double() for name, w in player.items()} for player in players]
    outputs = [
        GridNetwork()(player, torch.tensor(table.images).double().expand(2, 289, 7, 7, 3))[0]
        for player in doubled
    ]
    policy = (sum(outputs) / 2).softmax(-1).numpy()
    returns, success = expected_return(table, policy)
    assert metrics["yellow", "return_exact"] == pytest.approx(returns, rel=1e-10)
    assert metrics["yellow", "success"] == pytest.approx(success, rel=1e-10)
    entropy = -(policy * np.log(policy)).sum(-1).mean(-1)
    assert metrics["yellow", "entropy"] == pytest.approx(entropy, rel=1e-10)
    greedy = (policy == policy.max(-1, keepdims=True)).astype(float)
    assert metrics["yellow", "return_greedy"] == pytest.approx(expected_return(table, greedy)[0])
    steps = [metrics["yellow", name] for name in ("reaches_key", "unlocks_door", "success")]
    assert (steps[0] > steps[1]).all() and (steps[1] > steps[2]).all()


def test_protocol_in_all_colours_is_that_of_each_alone(trained):
    task, players = trained
    metrics = evaluate(task, players, [3, 4])
    for code, (color, table) in enumerate(task.tasks.items()):
        generators = [np.random.default_rng([seed, code]) for seed in (3, 4)]
        alone = in_a_domain(table, task.logits(players, table.images), generators)
        assert metrics[color, "return_published_protocol"] == pytest.approx(alone, rel=1e-12)


def test_evaluation_of_a_run_does_not_depend_on_the_others(trained):
    task, players = trained
    second = [{name: weight[1:] for name, weight in player.items()} for player in players]
    together, alone = evaluate(task, players, [0, 1]), evaluate(task, second, [1])
    assert together.keys() == alone.keys()
    for key, values in alone.items():
        assert together[key][1:] == pytest.approx(values, rel=1e-9), key


@pytest.mark.parametrize(
    ("method", "options"),
    [
        ("ppo", {}),
        ("ipo", {"color_encoding": "one_hot"}),
        ("ensemble", {"train_colors": ("red", "yellow"), "color_encoding": "none"}),
    ],
)
def test_rows_and_policies_of_a_cell(tmp_path, tables, method, options):
    cell = tiny_cell(method, **options)
    rows = run_cell(cell, [0, 1], tables, tmp_path)
    assert list(rows.columns) == [*CELL, "run", "domain", "metric", "value"]
    assert not rows.duplicated([*CELL, "run", "domain", "metric"]).any()
    assert len(rows) == 2 * 6 * 7
    assert set(rows["metric"]) == EXACT | {"return_published_protocol"}
    assert rows[CELL].drop_duplicates().to_dict("records") == [cell.columns]
    assert np.isfinite(rows["value"]).all()

    (path,) = tmp_path.iterdir()
    assert path.name == f"{cell.name}.safetensors"
    task = Keys(tables, cell.color_encoding)
    players, about = load_policy(path, task.network, {"cell": cell})
    assert about["seeds"] == [0, 1]
    returns = rows[rows["metric"] == "return_exact"].set_index(["domain", "run"])["value"]
    for (color, metric), values in exact(task, players).items():
        if metric == "return_exact":
            assert returns[color].tolist() == pytest.approx(values, rel=1e-9)


def test_policies_of_other_settings_or_runs_are_not_overwritten(tmp_path, tables):
    cell = tiny_cell("ppo")
    run_cell(cell, [0], tables, tmp_path)
    (path,) = tmp_path.iterdir()
    before = path.read_bytes()
    longer = replace(cell, settings=replace(cell.settings, learning_rate=0.1))
    for other, seeds, differs in ((longer, [0], "learning_rate"), (cell, [0, 1], "seeds")):
        with pytest.raises(ValueError, match=rf"was made for something else: .*{differs}"):
            run_cell(other, seeds, tables, tmp_path)
        assert path.read_bytes() == before
    with pytest.raises(ValueError, match=r"was made for something else: cell\..*learning_rate"):
        Keys(tables).saved(longer, tmp_path)


@pytest.mark.parametrize("label", ["../ppo", "a/b", "/ppo", ""])
def test_a_label_with_a_path_in_it_is_refused(label):
    with pytest.raises(ValueError, match=r"label = .*: must be the name of a file"):
        experiment.arm(label, "ppo")


def test_later_runs_do_not_overwrite_the_first_policies(tmp_path, tables):
    cell = tiny_cell("ppo")
    run_cell(cell, [1], tables, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_curve_begins_before_training_and_ends_where_the_run_ends(tables):
    cell = tiny_cell("ppo")
    curve = run_curve(cell, [0], tables)
    assert list(curve.columns) == [*CELL, "frames", "run", "domain", "metric", "value"]
    assert sorted(curve["frames"].unique()) == [0, 64, 128]
    index = ["domain", "metric", "run"]
    last = curve[curve["frames"] == 128].set_index(index)["value"]
    rows = run_cell(cell, [0], tables).set_index(index)["value"]
    assert last.to_dict() == pytest.approx(rows[last.index].to_dict(), rel=1e-9)


# -------------------------------------------------------------------------- shipped rows

TWO, THREE, INSIDE = "red+green", "red+green+blue", "red+yellow"
MAIN = {(name, TWO, "integer", 5): 100 for name in ("ppo", "ipo", "ppo_lr5e-4", "ipo_lr1e-3")}
MAIN |= {("ensemble", TWO, "integer", 5): 100}
VARIANTS = {
    (method, TWO, encoding, 5): 50
    for method in ("ppo", "ipo", "ensemble")
    for encoding in ("one_hot", "none")
}
for method in ("ppo", "ipo"):
    VARIANTS |= {
        (f"{method}_3colors", THREE, "integer", 5): 50,
        (f"{method}_inside", INSIDE, "integer", 5): 50,
        (f"{method}_normalized", TWO, "integer", 5): 50,
    }
SHIPPED = {
    "main": MAIN,
    "turns": {(f"in_turn{rate}", TWO, "integer", 5): 100 for rate in ("", "_lr1e-3")},
    "variants": VARIANTS,
    "larger": {
        (f"{method}{length}", TWO, "integer", 6): 30
        for method in ("ppo", "ipo")
        for length in ("", "_long")
    },
    "in_full": {
        ("ipo_phi_short", TWO, "integer", 5): 50,
        ("ipo_inner2", TWO, "integer", 5): 100,
        ("ipo_phi", TWO, "integer", 5): 100,
        ("ipo_phi_inner2", TWO, "integer", 5): 50,
        ("ensemble_inner2", TWO, "integer", 5): 50,
        ("ensemble_phi", TWO, "integer", 5): 50,
    },
    "regularized": {(label, TWO, "integer", 5): 50 for label in trials.KEYS.settings},
    "curves": {(method, TWO, "integer", 5): 30 for method in ("ppo", "ipo", "ensemble")},
    "fair": {
        (method, TWO, "integer", 5): 50
        for method in ("ppo_wide", "ppo_wide_lr5e-4", "ppo_75_25", "ipo_75_25")
    },
    "labels": {
        (f"ipo_{labels}", TWO, "integer", 5): 50 for labels in ("clustered", "inferred", "random")
    },
}
CELLS = [(name, *cell) for name, cells in SHIPPED.items() for cell in cells]
LEARNING_RATES = {
    "ppo": 1e-3,
    "ipo": 5e-4,
    "ensemble": 5e-4,
    "ppo_lr5e-4": 5e-4,
    "ppo_wide_lr5e-4": 5e-4,
    "ipo_lr1e-3": 1e-3,
    "in_turn": 5e-4,
    "in_turn_lr1e-3": 1e-3,
}


@pytest.fixture(scope="module")
def shipped() -> dict[str, pd.DataFrame]:
    return {name: pd.read_csv(RESULTS / f"{name}.csv") for name in SHIPPED}


def test_every_shipped_file_is_tested_here():
    assert {path.stem for path in RESULTS.glob("*.csv")} == SHIPPED.keys() | {"grids"}
    assert CHAPTERS["keys"].keys() == SHIPPED.keys() | {"grids"}


@pytest.mark.parametrize("name", SHIPPED)
def test_every_shipped_run_is_there_with_every_metric_in_every_color(shipped, name):
    rows = shipped[name]
    counted = rows.groupby(CELL)["run"].agg(lambda runs: sorted(set(runs)))
    assert counted.to_dict() == {cell: list(range(n)) for cell, n in SHIPPED[name].items()}
    if name == "labels":
        about = rows[rows["domain"] == "train"]
        assert about.groupby("metric")["run"].count().to_dict() == {
            "agreement": 150,
            "smaller_domain": 150,
        }
        assert about["value"].between(0, 1).all()
        rows = rows[rows["domain"] != "train"]
    metrics = EXACT if name == "curves" else EXACT | {"return_published_protocol"}
    keys = [column for column in rows.columns if column != "value"]
    assert not rows.duplicated(keys).any()
    num_moments = 1
    if name == "curves":
        assert sorted(rows["frames"].unique()) == [6144 * update for update in range(21)]
        num_moments = 21
    assert set(rows["domain"]) == set(COLORS) and set(rows["metric"]) == metrics
    num_runs = sum(SHIPPED[name].values())
    assert len(rows) == num_runs * len(COLORS) * len(metrics) * num_moments
    assert np.isfinite(rows["value"]).all()


def batches(name: str) -> list[Batch]:
    """The origin of the shipped rows, each batch checked against its rows."""
    return Store(RESULTS, name).batches()


def settings_of(label: str, color_encoding: str) -> dict:
    """The settings that an arm's name stands for."""
    method = "in_turn" if label.startswith("in_turn") else label.split("_")[0]
    learning_rate = LEARNING_RATES.get(label, LEARNING_RATES[method])
    normalize = "minibatch" if label.endswith("_normalized") else "none"
    settings = published(method, learning_rate=learning_rate, normalize_advantages=normalize)
    if label.endswith("_75_25"):
        settings = replace(settings, num_envs=(36, 12))
        if method == "ipo":
            settings = replace(settings, num_minibatches=12)
    return plain(replace(settings, num_updates=80 if label.endswith("_long") else 20))


@pytest.mark.parametrize("name", ["main", "turns", "variants", "larger", "curves"])
def test_shipped_rows_are_of_the_published_settings(name):
    for batch in batches(name):
        label, encoding = batch["columns"]["method"], batch["columns"]["color_encoding"]
        cell = batch["cell"]["trained"] if name == "labels" else batch["cell"]
        assert filled(Cell, cell)["settings"] == settings_of(label, encoding)
        assert "+".join(cell["train_colors"]) == batch["columns"]["train_colors"]
        wide = 2**0.5 if "wide" in label else 1
        assert cell.get("width", 1) == pytest.approx(wide)  # older rows do not say it


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_values_are_possible(shipped, name):
    rows = shipped[name]
    values = rows[rows["domain"].isin(COLORS)].pivot_table(
        index=[c for c in rows.columns if c not in ("metric", "value")],
        columns="metric",
        values="value",
    )
    best = 0.9646 if name != "larger" else 1
    assert (values["return_exact"] >= 0).all() and (values["return_exact"] <= best).all()
    assert (values["return_exact"] <= values["success"]).all()
    assert (values["success"] <= values["unlocks_door"] + 1e-9).all()
    assert (values["unlocks_door"] <= values["reaches_key"] + 1e-9).all()
    assert values["entropy"].between(0, np.log(7)).all()


def test_shipped_curves_end_where_the_shipped_runs_end(shipped):
    """The same runs, to what the order of sums can change: training colours, to two digits."""
    curves, main = shipped["curves"], shipped["main"]
    index = ["method", "run", "domain"]

    def returns(rows: pd.DataFrame) -> pd.Series:
        return rows[rows["metric"] == "return_exact"].set_index(index)["value"]

    last = returns(curves[curves["frames"] == 122_880])
    difference = (last - returns(main)).dropna()
    assert len(difference) == 3 * 30 * 6
    trained_on = difference[difference.index.get_level_values("domain").isin(["red", "green"])]
    assert abs(trained_on.mean()) < 0.005


# ------------------------------------------------------------------------ shipped policies

WITHOUT_POLICIES = ("curves", "in_full", "regularized", "fair", "labels")
POLICY_CELLS = [cell for cell in CELLS if cell[0] not in WITHOUT_POLICIES]


def test_every_arm_ships_its_policies():
    expected = {"_".join(map(str, cell[1:])) for cell in POLICY_CELLS}
    assert {path.stem for path in POLICIES.iterdir()} == expected


@pytest.fixture(scope="module")
def keys_of(tables) -> dict[tuple, Keys]:
    """The task by encoding and size; each is made once."""
    return {
        (encoding, size): Keys(tables, encoding, size)
        for encoding, size in sorted({cell[3:] for cell in POLICY_CELLS})
        if size == 5
    }


def shipped_policy(cell: tuple, network: GridNetwork) -> list:
    """Players of the first ten runs."""
    name = "_".join(map(str, cell[1:]))
    path = POLICIES / f"{name}.safetensors"
    players, about = load_policy(path, network)
    assert rebuilt(Cell, about["cell"]).name == name
    assert about["seeds"] == list(range(10))
    assert {len(weight) for player in players for weight in player.values()} == {10}
    return players


def shipped_values(shipped: dict, cell: tuple, color: str, metric: str) -> list[float]:
    name, *columns = cell
    rows = shipped[name]
    for column, value in zip(CELL, columns, strict=True):
        rows = rows[rows[column] == value]
    rows = rows[(rows["domain"] == color) & (rows["metric"] == metric) & (rows["run"] < 10)]
    return rows.sort_values("run")["value"].tolist()


@pytest.mark.parametrize(
    "cell",
    [cell for cell in POLICY_CELLS if cell[4] == 5],
    ids=lambda cell: "_".join(map(str, cell[1:])),
)
def test_shipped_policies_have_the_shipped_returns(shipped, keys_of, cell):
    task = keys_of[cell[3:]]
    players = shipped_policy(cell, task.network)
    num_players = {"ppo": 1, "ipo": cell[2].count("+") + 1, "ensemble": 2, "in": 1}
    assert len(players) == num_players[cell[1].split("_")[0]]
    for color, table in task.tasks.items():
        policy = task.logits(players, table.images).softmax(-1).numpy()
        returns, success = expected_return(table, policy)
        for metric, values in (("return_exact", returns), ("success", success)):
            expected = shipped_values(shipped, cell, color, metric)
            assert values == pytest.approx(expected, rel=0, abs=1e-6), (color, metric)


@pytest.mark.parametrize("method", ["ppo", "ipo"])
def test_shipped_policies_have_every_shipped_metric(shipped, keys_of, method):
    """Greedy returns, subtasks, entropy, and the published protocol with its random draws."""
    cell = ("main", method, TWO, "integer", 5)
    task = keys_of[cell[3:]]
    metrics = evaluate(task, shipped_policy(cell, task.network), list(range(10)))
    assert len(metrics) == 6 * 7
    for (color, metric), values in metrics.items():
        expected = shipped_values(shipped, cell, color, metric)
        assert values == pytest.approx(expected, rel=0, abs=1e-6), (color, metric)


# ------------------------------------------------------------------------- arms of the chapter


@pytest.mark.parametrize(
    ("name", "arms"),
    [
        ("main", experiment.main_arms(20)),
        ("variants", experiment.variant_arms(20)),
        ("larger", experiment.larger_arms(20, 6)),
        ("fair", experiment.fair_arms(20)),
        ("labels", keys_labels.label_cells(20)),
    ],
)
def test_arms_of_the_chapter_are_those_of_the_shipped_rows(name, arms):
    kind = type(arms[0])
    cells = {json.dumps(filled(kind, batch["cell"])) for batch in batches(name)}
    assert {json.dumps(plain(cell)) for cell in arms} == cells
    assert len(arms) == len(SHIPPED[name])


def test_every_arm_of_a_table_has_a_name():
    labels = {name: {cell[0] for cell in cells} for name, cells in SHIPPED.items()}
    assert experiment.MAIN.keys() == labels["main"]
    assert experiment.LARGER.keys() == labels["larger"]
    assert experiment.fair_names(("red", "green")).keys() == labels["fair"] | {"ppo", "ipo"}
    assert keys_labels.NAMES.keys() == labels["labels"] | {"ipo", "ensemble"}
    others = {arm for arm in labels["variants"] if arm.endswith(("3colors", "normalized"))}
    assert experiment.setting_names(experiment.TRAINED).keys() == others | {"ppo", "ipo"}


def test_arms_of_other_colours_differ_in_the_colours_alone():
    """All but those whose colours stand for themselves, of codes with the others between them."""
    colors = ("blue", "yellow")
    for make, options in (
        (experiment.main_arms, [20]),
        (experiment.variant_arms, [20]),
        (experiment.larger_arms, [20, 6]),
        (keys_in_full.full_arms, [20]),
        (trials.keys_arms, [20]),
    ):
        for usual, other in zip(make(*options), make(*options, colors), strict=True):
            fixed = usual.label.endswith("_inside")
            three = usual.label.endswith("_3colors")
            expected = usual.train_colors if fixed else (*colors, *["red"] * three)
            assert other == replace(usual, train_colors=expected)
    assert experiment.setting_names(colors)["ipo_3colors"] == "IPO, blue, yellow and red"


# -------------------------------------------------------------------------- read off the rows


def made_up(values: dict[tuple[str, str], list[float]], metric: str = "return_exact"):
    """Rows of made-up runs by arm and colour, the last run first."""
    return pd.DataFrame(
        {"method": method, "domain": color, "run": run, "metric": metric, "value": value}
        for (method, color), runs in values.items()
        for run, value in reversed(list(enumerate(runs)))
    )


def test_runs_of_an_arm_are_in_the_order_of_their_seeds():
    rows = made_up({("ppo", "grey"): [0.1, 0.2, 0.3], ("ipo", "grey"): [0.5], ("ppo", "red"): [1]})
    other = made_up({("ppo", "grey"): [9.0]}, "success")
    found = runs_of(pd.concat([rows, other]), "ppo", "grey")
    assert found.to_dict() == {0: 0.1, 1: 0.2, 2: 0.3} and found.tolist() == [0.1, 0.2, 0.3]


def test_table_has_the_mean_and_deviation_over_runs_beside_the_papers():
    rows = made_up({("ppo", "red"): [0.25, 0.75], ("ipo", "red"): [1, 1], ("ppo", "grey"): [0]})
    names = {"ipo": "I", "ppo": "P"}
    paper = pd.DataFrame({"method": ["ipo"], "domain": ["red"], "text": ["0.9 ± 0.1"]})
    table = keys_tables.table_by(rows, names, "return_exact", ["red"], paper)
    assert table.to_dict("list") == {
        "arm": ["I", "P"],
        "red": ["1.000 ± 0.000", "0.500 ± 0.250"],
        "red, paper": ["0.9 ± 0.1", ""],
    }


def test_comparison_on_grey_by_hand():
    ours, theirs = [0.5, 0.75, 1.0], [0.25, 0.5, 0.75]  # run by run 0.25 more
    rows = made_up({("ipo", "grey"): ours, ("ppo", "grey"): theirs})
    (row,) = keys_tables.comparison(rows, [("ipo", "ppo")]).to_dict("records")
    assert row["difference on grey"] == "IPO, as published − PPO, as published"
    assert row["mean"] == 0.25 and row["95 % interval"] == "[+0.250, +0.250]"
    assert row["P(improvement)"] == pytest.approx((6 + 2 / 2) / 9)  # of nine pairs two are equal
    assert row["p"] == 0.0
    assert keys_tables.gap(rows, "ipo", "ppo") == "+0.250 [+0.250, +0.250]"
    assert keys_tables.gap(rows, "ppo", "ipo").startswith("-0.250")


def test_draws_are_of_the_published_protocol_and_of_each_methods_own_runs():
    values = {("ipo", "grey"): [1.0, 3.0], ("ppo", "grey"): [10.0, 20.0, 60.0]}
    rows = pd.concat(
        [
            made_up(values, "return_published_protocol"),
            made_up({key: [-1.0] * 5 for key in values}),
        ]
    )
    drawn = keys_tables.draws_of_ten(rows, np.random.default_rng(0), num_draws=20_000)
    assert drawn["ipo"].shape == drawn["ppo"].shape == (20_000, 10)
    assert set(drawn["ipo"].flat) == {1, 3} and set(drawn["ppo"].flat) == {10, 20, 60}
    for method, runs in (("ipo", [1, 3]), ("ppo", [10, 20, 60])):
        error = np.std(runs) / np.sqrt(10 * 20_000)
        assert abs(drawn[method].mean() - np.mean(runs)) < 5 * error


def test_runs_for_a_difference_have_the_stated_power():
    """Normal samples of so many runs: the two-sample test finds the difference in 80 %."""
    rng = np.random.default_rng(0)
    values = rng.normal(size=(2, 1000))
    values = (values - values.mean(1, keepdims=True)) / values.std(1, ddof=1, keepdims=True)
    rows = made_up({("ipo", "grey"): 2 * values[0], ("ppo", "grey"): 0.5 * values[1]})
    needed = keys_tables.runs_for(0.5, rows)
    one, other = rng.normal(0.5, 2, (4000, needed)), rng.normal(0, 0.5, (4000, needed))
    found = scipy.stats.ttest_ind(one, other, axis=1, equal_var=False).pvalue < 0.05
    assert found.mean() == pytest.approx(0.8, abs=0.03)


def test_computed_rows_stand_beside_the_shipped_ones_of_the_same_run():
    shipped = made_up({("ppo", "red"): [0.1, 0.2], ("ppo", "grey"): [0.3, 0.4]}).assign(frames=64)
    again = shipped[shipped["domain"] == "red"].assign(value=[0.25, 0.1]).iloc[::-1]
    both = beside_shipped(again, shipped).sort_values("run")
    assert both["run"].tolist() == [0, 1] and both["shipped"].tolist() == [0.1, 0.2]
    assert both["difference"].tolist() == pytest.approx([0, 0.05])
    (row,) = keys_tables.by_update(both).to_dict("records")
    assert (row.pop("arm"), row.pop("frames")) == ("PPO, as published", 64)
    means = {"red, shipped": 0.15, "red, live": 0.175, "largest difference": 0.05}
    assert row == pytest.approx(means)
    with pytest.raises(ValueError, match=r"has no row for \{.*'run': 1"):
        beside_shipped(again, shipped[shipped["run"] == 0])


def test_encodings_keep_the_arms_of_each_network_apart(shipped):
    panels = keys_tables.encodings(shipped["main"], shipped["variants"])
    variants = shipped["variants"]
    titles = [title for title, *_ in panels.values()]
    assert titles[1:3] == ["integer, red and yellow", "one-hot, red and green"]
    for (_, rows, colors), (suffix, encoding, arms) in zip(
        panels.values(),
        [
            ("", "integer", MAIN),
            ("_inside", "integer", [("ppo",), ("ipo",)]),
            ("", "one_hot", [("ppo",), ("ipo",), ("ensemble",)]),
            ("", "none", [("ppo",), ("ipo",), ("ensemble",)]),
        ],
        strict=True,
    ):
        assert set(rows["method"]) == {arm[0] for arm in arms}
        assert set(rows["color_encoding"]) == {encoding}
        assert set(rows["train_colors"]) == {"+".join(colors)}
        assert [COLORS[code] for code in rows["code"]] == rows["domain"].tolist()
        source = shipped["main"] if arms is MAIN else variants[variants.color_encoding == encoding]
        assert runs_of(rows, "ipo", "blue").equals(runs_of(source, f"ipo{suffix}", "blue"))


def test_frames_of_the_algorithm_in_full_are_counted_as_training_counts_them(tables):
    """Phi's, and those of every inner round."""
    task = Keys(tables)
    for arm in keys_in_full.full_arms(20):
        tiny = replace(arm, settings=replace(arm.settings, **TINY))
        *_, (frames, _) = task.train(tiny, [0])
        assert keys_in_full.num_frames(tiny) == frames
    assert [keys_in_full.num_frames(arm) for arm in keys_in_full.full_arms(20)] == [
        *(122_880, 245_760, 245_760, 368_640),
        *(245_760, 245_760),
    ]


def test_steps_of_the_task_follow_one_another(shipped):
    steps = keys_tables.subtasks(shipped["main"], "red")
    assert list(steps.index) == [(arm, c) for arm in experiment.MAIN for c in ("red", "grey")]
    assert list(steps.columns) == ["holds the key", "unlocks the door", "reaches the goal"]
    expected = runs_of(shipped["main"], "ipo", "grey", "unlocks_door").mean()
    assert steps.loc[("ipo", "grey"), "unlocks the door"] == pytest.approx(expected)


# ------------------------------------------------------------------ read off saved policies


def test_returns_are_those_of_the_exact_metrics(trained):
    task, players = trained
    metrics = exact(task, players)
    assert returns(task, players).keys() == {(color, "return_exact") for color in COLORS}
    for key, values in returns(task, players, ["grey", "red"]).items():
        assert values.tolist() == metrics[key].tolist()


def test_a_policy_sees_grey_keys_and_walls_as_they_are_in_code_5(trained):
    task, players = trained
    rows = keys_tables.beyond_codes(task, {"ipo": players}, walls=[2, 5], codes=[0, 5])
    assert len(rows) == 2 * 2 * 2 and set(rows["method"]) == {"ipo"}
    grey = returns(task, players)["grey", "return_exact"]
    seen = rows.set_index(["wall", "code", "run"])["value"]
    assert seen[5, 5].tolist() == pytest.approx(grey.tolist(), rel=1e-12)
    # A red key in the grey domain: what is seen is what the red domain shows.
    assert seen[5, 0].tolist() == pytest.approx(
        returns(task, players)["red", "return_exact"], rel=1e-9
    )
    assert (seen[2, 5] != grey).all()


def test_temperatures_lead_from_the_best_action_to_the_policy_to_chance(trained):
    task, players = trained
    rows = keys_tables.by_temperature(task, {"ipo": players}, ["green"], [0.0, 1.0, 1e9])
    found = rows.set_index(["temperature", "run"])["value"]
    metrics, table = exact(task, players), task.tasks["green"]
    assert found[0.0].tolist() == metrics["green", "return_greedy"].tolist()
    assert found[1.0].tolist() == pytest.approx(metrics["green", "return_exact"], rel=1e-12)
    uniform = np.full((1, len(table.images), 7), 1 / 7)
    assert found[1e9].tolist() == pytest.approx(list(expected_return(table, uniform)[0]) * 2)


def test_visits_count_every_step_in_the_cell_where_it_is_spent(trained):
    task, players = trained
    spent = keys_tables.visits(task, players, "red")
    table = task.tasks["red"]
    assert spent.shape == (3, 5, 5)
    assert (spent[:, [0, -1], :] == 0).all() and (spent[:, :, [0, -1]] == 0).all()
    steps = occupancy(table, task.policies(players, ["red"])["red"]).mean(0)
    assert spent.sum() == pytest.approx(steps.sum()) and steps.sum() <= table.horizon
    x, y = table.position[7]
    here = (table.position == (x, y)).all(1) & (table.progress == table.progress[7])
    assert spent[table.progress[7], y, x] == pytest.approx(steps[here].sum())


def test_description_of_a_table(keys):
    found = experiment.description(keys["grey"])
    assert found.pop("optimal return") == pytest.approx(0.9646, abs=1e-9)
    assert found == {"layouts": 48, "states": 520, "distinct observations": 289}


@pytest.mark.slow
@pytest.mark.parametrize("method", ["ppo", "ipo"])
def test_shipped_policies_of_larger_grids_have_the_shipped_returns(shipped, tables, method):
    cell, task = ("larger", method, TWO, "integer", 6), Keys(tables, size=6)
    metrics = exact(task, shipped_policy(cell, task.network))
    for (color, metric), values in metrics.items():
        expected = shipped_values(shipped, cell, color, metric)
        assert values == pytest.approx(expected, rel=0, abs=1e-6), (color, metric)


@pytest.mark.slow
def test_runs_trained_today_are_distributed_as_the_shipped_ones(shipped, tables):
    """Same seeds, other order of sums: returns on the training colours, ten runs of PPO."""
    rows = run_cell(Cell("ppo", published("ppo")), list(range(10)), tables)
    exact_rows = rows[rows["metric"] == "return_exact"]
    for color in ("red", "green"):
        ours = exact_rows[exact_rows["domain"] == color]["value"]
        theirs = shipped["main"].query(
            "method == 'ppo' and metric == 'return_exact' and domain == @color"
        )["value"]
        error = np.hypot(ours.sem(), theirs.sem())
        assert abs(ours.mean() - theirs.mean()) < 4 * error
