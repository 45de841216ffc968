"""What the chapter on doors decides: which rows count for an arm, and what is told of them."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import scipy.stats

from experiments import pictures
from experiments.doors import figures as door_figures
from experiments.doors import tables as door_tables
from experiments.doors import training as door_training
from experiments.doors import ways as door_ways
from experiments.doors.arms import (
    CONTROLS,
    arms_of,
    cell_of,
    controls,
    controls_of,
    mean_rate,
    rate,
    rate_by_friction,
    trainings,
)
from experiments.doors.success import door_seeds, evaluation_doors
from experiments.doors.training import NETWORK, made_for, policy_path
from experiments.policies import save_policy
from ipo.worlds.one_door import DoorEnv

FRICTIONS = (1.1, 1.5)
NUM_DOORS = 4
ARMS = arms_of(trainings(4, 512), frictions=FRICTIONS, num_doors=NUM_DOORS)
PARTS = {"ppo_half": [0.9, 0.1], "ppo": [0.9, 0.9], "ipo_half": [0.5, 0.9], "ipo": [0.1, 0.1]}


def rows_of(values, metric="success"):
    """Rows from ``{arm: function of run, friction and door}``, for three runs."""
    return pd.DataFrame(
        {
            **ARMS[arm].columns,
            "run": run,
            "domain": str(friction),
            "door": door,
            "metric": metric,
            "value": float(value(run, friction, door)),
        }
        for arm, value in values.items()
        for run in range(3)
        for friction in FRICTIONS
        for door in range(NUM_DOORS)
    )


@pytest.fixture
def success():
    """IPO opens a door more than PPO at half time, and all doors in the end."""
    return rows_of(
        {
            "ppo_half": lambda run, f, door: door < 1,
            "ppo": lambda run, f, door: door < 2 and f < 1.5,
            "ipo_half": lambda run, f, door: door < 2 + (run == 2),
            "ipo": lambda run, f, door: True,
        }
    )


@pytest.fixture
def paper():
    means = {"ppo": 0.5, "ipo": 0.75}
    return pd.DataFrame(
        {"method": m, "domain": str(f), "mean": means[m], "std": 0.1}
        for m in means
        for f in FRICTIONS
    )


def watched_rows():
    """The first two runs open all doors, in the way of their arm, the third none."""
    runs = {arm: lambda run, f, door, arm=arm: ([*PARTS[arm], 0])[run] for arm in ARMS}
    parts = rows_of(runs, "inside_part")
    opened = rows_of({arm: lambda run, f, door: run < 2 and (f < 1.5 or door > 0) for arm in ARMS})
    return pd.concat([parts[parts["run"] < 2], opened], ignore_index=True)


def test_arms_are_two_trainings_at_two_times():
    steps = {arm: cell.columns["steps"] for arm, cell in ARMS.items()}
    assert steps == {"ppo_half": 32768, "ppo": 65536, "ipo_half": 32768, "ipo": 65536}
    assert trainings(190, 4096) == {
        method: replace(door_training.CELLS[method], curve_every=10) for method in ("ppo", "ipo")
    }
    assert trainings(2, 512)["ipo"].settings.num_minibatches == 32


def test_controls_are_trained_as_long_as_ipo_as_published():
    assert controls(190, 4096) == door_training.controls()
    assert {*controls(4, 512)} == {*CONTROLS} - {"ppo_half"}
    for cell in controls(4, 512).values():
        assert (cell.settings.num_updates, cell.saved_after) == (2, (2,))
        assert cell.settings.num_minibatches == 32


def test_an_arm_has_its_own_rows_only(success):
    assert list(rate(success, ARMS["ppo"], 1.1)) == [0.5] * 3
    assert list(rate(success, ARMS["ppo"], 1.5)) == [0] * 3
    assert list(mean_rate(success, ARMS["ppo"], FRICTIONS)) == [0.25] * 3
    assert list(rate(success, ARMS["ipo_half"], 1.5)) == [0.5, 0.5, 0.75]
    assert [cell_of(row, ARMS) for _, row in success.iloc[::24].iterrows()] == [*ARMS.values()]
    last = replace(ARMS["ipo"], choice="last")
    assert rate(success, last, 1.1).empty


def test_rates_by_friction_count_successes_in_the_order_of_frictions():
    rows = watched_rows()
    rows["domain"] = rows["domain"].replace({"1.1": "9.0", "1.5": "10.0"})
    assert rate_by_friction(rows).to_dict() == {9.0: 2 / 3, 10.0: 2 / 3 * 3 / 4}
    assert list(rate_by_friction(rows).index) == [9.0, 10.0]


def test_table_4_has_our_arms_the_papers_and_the_controller(success, paper):
    table = door_tables.table_4(success, ARMS, FRICTIONS, paper, pd.Series({1.1: 0.9, 1.5: 0.5}))
    assert list(table["1.5"]) == [
        "25.0 ± 0.0", "0.0 ± 0.0", "58.3 ± 11.8", "100.0 ± 0.0", "50.0 ± 10.0", "75.0 ± 10.0",
        "50.0",
    ]  # fmt: skip


def test_comparisons_of_two_arms(success):
    compared = door_tables.comparisons(success, ARMS, FRICTIONS)
    found = door_tables.comparison_numbers(compared)
    assert found["published_all"] == pytest.approx(100 * (0.5 + 0.25 / 3 - 0.25))
    assert found["equal_full_hardest"] == 100
    assert found["equal_full_hardest_interval"] == "[+100.0, +100.0]"
    assert (found["published_all_better"], found["longer_ppo_hardest_better"]) == (1, 0)
    assert len(compared) == 2 * len(door_tables.PAIRS)


def test_controls_are_paired_with_the_runs_of_ipo_that_they_have(success):
    """Runs 0 and 1 of the controls, of IPO's three."""
    arms = ARMS | controls_of(controls(4, 512), frictions=FRICTIONS, num_doors=NUM_DOORS)
    of_ppo = success.query("method == 'ppo' and steps == 32768 and run < 2")
    of_controls = of_ppo.assign(value=of_ppo["run"].map({0: 0.25, 1: 0.5}))
    more = dict(zip(controls(4, 512), (0.25, 0, -0.25, 0.125, 0, 0.0625, -0.125, 0.5), strict=True))
    rows = [of_controls.assign(method=m, value=of_controls["value"] + by) for m, by in more.items()]
    table = door_tables.controlled(pd.concat([success, *rows]), arms, FRICTIONS, effect=10.0)
    assert list(table["pairs"]) == [3, 2, 2, 2, 2, 2, 2, 2, 2]
    differences = table.set_index("key")["difference"]
    assert differences["ppo_half"] == pytest.approx(100 / 3)
    for method, by in more.items():
        assert differences[method] == pytest.approx(12.5 - 100 * by)
    assert table.set_index("key").loc["in_turn", "it opens"] == "37.5 ± 12.5"
    assert table["power"].between(0.05, 1).all()


def test_runs_are_compared_in_pairs():
    """Every run gains a little, and runs differ much: only a paired test can see it."""
    noise = np.array([0.0, 0.2, 0.5])
    rows = rows_of(
        {
            "ppo_half": lambda run, f, door: noise[run],
            "ppo": lambda run, f, door: noise[run] + 0.1 + 0.001 * run,
            "ipo_half": lambda run, f, door: 0.2 - noise[run],
            "ipo": lambda run, f, door: noise[run],
        }
    )
    p = door_tables.comparisons(rows, ARMS, FRICTIONS).set_index("key")["p"]
    assert p["longer_ppo_all"] < 0.001
    ours, theirs = (mean_rate(rows, ARMS[arm], FRICTIONS) for arm in ("ipo_half", "ppo"))
    assert p["published_all"] == pytest.approx(scipy.stats.ttest_rel(ours, theirs).pvalue)


def test_a_draw_has_the_same_runs_at_all_frictions():
    rows = rows_of({arm: lambda run, f, door, arm=arm: run * (arm == "ipo_half") for arm in ARMS})
    gaps = door_tables.gaps_of_draws(rows, ARMS, FRICTIONS, np.random.default_rng(0), 50, 2)
    assert gaps.shape == (2, 50)
    np.testing.assert_array_equal(gaps[0], gaps[1])
    assert {*gaps[0]} == {0, 50, 100, 150, 200}


def test_numbers_of_the_verdict(success, paper):
    found = door_tables.verdict_numbers(success, ARMS, FRICTIONS, paper)
    assert (found["rate_ppo_low"], found["rate_ppo_high"]) == (50, 0)
    assert (found["paper_ipo_low"], found["worst_ipo_half"]) == (75, 0)
    assert found["paper_gap"] == 25
    assert found["gradient_steps"] == 4 * 10 * 32 / 1000
    assert found["gradient_ratio"] == 2
    assert found["needed_published"] >= 2 and found["needed_equal"] >= 2
    of_paper = 2 * 0.1 / np.sqrt(5)  # the least that is allowed, if ours did not vary
    assert found["tolerance"] >= 100 * of_paper


def test_minibatches_of_each_player():
    """256 of them, of 32 doors with 4096 steps for PPO, of 24 and of 8 doors for IPO's players."""
    sizes = [door_tables.minibatch_sizes(door_training.published_door(m)) for m in ("ppo", "ipo")]
    assert sizes == ["512", "384 and 128"]


def test_a_curve_is_read_at_the_first_record_that_is_late_enough():
    curves = pd.DataFrame(
        {"metric": metric, "domain": "0.1", "frames": frames, "run": run, "value": frames + run}
        for metric in ("return", "success")
        for frames in (10, 20, 30)
        for run in (0, 1)
    )
    assert door_tables.mean_after(curves, "success", 0.1, 11) == 20.5
    assert door_tables.mean_after(curves, "success", 0.1, 20) == 20.5


def test_the_last_policies_beside_the_best(success):
    last = success.assign(choice="last", value=0.0)
    table = door_tables.table_of_choices(success, last, ARMS, (1.5,)).set_index("arm")
    assert list(table.loc["IPO, as in the text"]) == ["100.0 ± 0.0", "0.0 ± 0.0"]


def test_policies_by_strategy():
    parts = door_ways.opened_parts(watched_rows())
    found = door_ways.strategy_numbers(parts, ARMS, 1.1)
    assert [found[f"count_ppo_{kind}"] for kind in door_ways.STRATEGIES] == [2, 0, 0]
    assert [found[f"count_ipo_half_{kind}"] for kind in door_ways.STRATEGIES] == [1, 1, 0]
    assert (found["kept_ppo"], found["kept_ipo"], found["agree"]) == (1, 0, 1)
    paper = pd.DataFrame(
        {"method": "ppo", "strategy": kind, "runs": n}
        for kind, n in zip(door_ways.STRATEGIES, (1, 2, 3), strict=True)
    )
    table = door_ways.table_of_strategies(parts, ARMS, 1.1, paper).set_index("arm")
    assert list(table.loc["PPO, half"]) == [1, 0, 1, "50%", "0%", "50%"]
    assert list(table.loc["PPO, the paper"])[:3] == [1, 2, 3]


def test_examples_of_a_strategy_are_of_different_runs():
    parts = door_ways.opened_parts(watched_rows())
    found = pd.DataFrame(door_ways.strategy_examples(parts, 1.5))
    assert set(found["domain"]) == {"1.5"}
    assert not found.duplicated(["method", "run", "strategy"]).any()
    assert (found["strategy"].map(door_ways.STRATEGIES.index).diff().dropna() >= 0).all()


def test_the_way_of_opening_beside_success():
    watched = watched_rows()
    parts = door_ways.opened_parts(watched)
    opened = watched[watched["metric"] == "success"]
    policies = door_ways.parts_and_success(parts, opened, ARMS, 1.1, 1.5)
    assert len(policies) == 2 * len(ARMS)  # the third runs have opened nothing
    assert list(policies[policies["arm"] == "ipo_half"]["part"]) == pytest.approx([0.5, 0.9])
    assert set(policies["success"]) == {3 / 4}
    doors = door_ways.same_doors(watched, 1.1, 1.5)
    assert len(doors) == 2 * len(ARMS) * NUM_DOORS
    assert list(doors["hard"]) == [float(door > 0) for *_, door in doors.index]
    found = door_ways.robustness_numbers(policies.assign(success=policies["part"]), doors)
    assert found["rho"] == pytest.approx(1)
    assert (found["hard_hook"], found["hard_mixed_n"]) == (3 / 4, NUM_DOORS)
    assert np.isnan(door_ways.robustness_numbers(policies.head(2), doors)["rho"])


def test_the_distance_of_players():
    player = NETWORK.start([np.random.default_rng(0)])
    half = {name: weight / 3 for name, weight in player.items()}
    assert door_ways.distance(player, player) == 0
    assert door_ways.distance(player, half) == pytest.approx(1, rel=1e-5)


def test_gains_of_players_who_go_on_alone():
    gaps = pd.DataFrame(
        {"run": run, "domain": domain, "metric": metric, "value": value}
        for run in (0, 1)
        for domain, before, after in (("0.0", -100.0, -50.0 - 100 * run), ("0.1", 200.0, 220.0))
        for metric, value in (("before", before), ("after", after))
    )
    gains = door_ways.relative_gains(gaps)
    assert gains["0.0"].tolist() == [0.5, -0.5]
    assert gains["0.1"].tolist() == pytest.approx([0.1, 0.1])
    table = door_ways.table_of_gains(gaps)
    assert list(table["runs that gain"]) == ["1 of 2", "2 of 2"]
    assert list(table["return after"]) == ["-100 ± 50", "220 ± 0"]


def test_a_lever_that_decides_is_found():
    doors = evaluation_doors(NUM_DOORS)
    np.testing.assert_allclose(doors["lever"], doors["lever_arm"] - doors["shift_y"])
    success = rows_of({arm: lambda run, f, door: doors["lever"][door] for arm in ARMS})
    rho = door_ways.trait_correlations(success, doors, ARMS["ppo"], 1.5)
    assert rho["lever"] == pytest.approx(1)
    assert rho.drop("lever").abs().max() <= 1
    by_lever = door_ways.success_by_lever(success, doors, ARMS["ppo"], 1.5)
    np.testing.assert_allclose(by_lever, by_lever.index)
    found = door_ways.lever_numbers(success, doors, ARMS, 1.5)
    assert found["short_levers"] == by_lever.iloc[0] <= found["long_levers"]


def test_the_best_the_median_and_the_worst_run():
    by_run = pd.Series([0.5, 0.9, 0.5, 0.1, 0.7])
    assert door_figures.ranked(by_run) == {"best": 1, "median": 0, "worst": 3}


def test_the_controller_by_hand_plays_until_the_door_is_open():
    env = DoorEnv(friction=0.1)
    episode = door_figures.play(env, door_seeds(1)[0])
    assert episode.opened and len(episode.joints) == env.step_count + 1 < 500
    assert [abs(joints[6]) < 0.2 for joints in episode.joints[-2:]] == [True, False]
    waiting = door_figures.play(env, door_seeds(1)[0], lambda _: np.zeros(6))
    assert not waiting.opened and len(waiting.joints) == env.max_steps + 1


def test_every_frame_of_the_films_is_drawn_once(tmp_path, monkeypatch):
    drawn = []

    class Counting(pictures.Blank):
        def frame(self, *joints):
            drawn.append(joints)
            return super().frame()

    monkeypatch.setattr(pictures, "camera", lambda params: Counting(16, 12))
    for arm, num_players in (("ppo", 1), ("ipo_half", 2)):
        cell = ARMS[arm]
        players = [NETWORK.start([np.random.default_rng(d)]) for d in range(num_players)]
        path = policy_path(tmp_path, cell.trained.label, 1, cell.updates)
        save_policy(path, players, made_for(cell.trained, 1, cell.updates, "best"))
    films = {
        (arm, 0.1): door_figures.filmed(
            ARMS[arm], {"median": 1}, 0.1, door_seeds(1)[0], tmp_path, 200
        )
        for arm in ("ppo", "ipo_half")
    }
    assert [len(film.frames) for row in films.values() for film in row] == [4, 4]  # of 512 steps
    page = door_figures.film_page(films, 200)
    assert page.count("<video") == 2
    assert "PPO, as published, friction 0.1: median run 1 does not." in page
    figure = door_figures.median_strips(films, ARMS, 200)
    assert [ax.texts[0].get_text() for ax in figure.axes[::8]] == ["PPO, 0.1", "IPO, 0.1"]
    assert len(drawn) == 8
