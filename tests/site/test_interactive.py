"""Interactive figures: their numbers are those of the rows, and keys, phones and no scripts do."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch
from browse import PHONE, WIDE, new_context

from experiments import keys
from experiments.doors.arms import arms_of, trainings
from experiments.doors.success import evaluation_doors
from experiments.interactive import doors as door_explorer
from experiments.interactive import keys as keys_explorer
from experiments.interactive import lqr, page
from experiments.store import Store, select
from ipo.causality.small_games import vote
from ipo.lqr import oracle_cost
from ipo.worlds.tabular import expected_return, optimal_policy

ROOT = Path(__file__).resolve().parents[2]
FIGURES = {  # by page
    "algorithm": "regression-game",
    "lqr": "lqr-explorer",
    "keys": "keys-explorer",
    "door": "door-explorer",
}


def rows(chapter: str, name: str):
    """Shipped rows."""
    return Store(ROOT / "data" / "results" / chapter, name).rows()


@pytest.fixture
def shown(browser, tmp_path):
    """Opens a page with nothing but a figure; in the end, nothing has been complained of."""
    complaints = []
    with browser.new_context(viewport=PHONE, has_touch=True) as context:

        def show(name: str, data: dict):
            shutil.copytree(ROOT / "book" / "extra", tmp_path, dirs_exist_ok=True)
            made = page.figure(name, data, plt.figure(), "first").data
            (tmp_path / "page.html").write_text(f'<!doctype html><meta charset="utf-8">{made}')
            opened = context.new_page()
            opened.on("pageerror", lambda error: complaints.append(str(error)))
            opened.on("console", lambda message: complaints.append(message.text))
            opened.goto((tmp_path / "page.html").as_uri())
            return opened

        yield show
    assert complaints == []


def outcome(opened) -> str:
    return opened.locator(".interactive output").inner_text().replace("−", "-")


# ------------------------------------------------------------------------- on the pages of the site


@pytest.fixture(params=FIGURES)
def name(request) -> str:
    return request.param


@pytest.fixture(params=[WIDE, PHONE], ids=["wide", "phone"])
def on_the_site(request, browser, built_site, name):
    with new_context(browser, request.param) as context:
        opened = context.new_page()
        opened.goto(f"{built_site.as_uri()}/{name}.html")
        yield opened


def test_every_control_is_reached_by_keys_and_every_picture_fits(on_the_site, name):
    home = on_the_site.locator(f"#{FIGURES[name]}")
    on_the_site.evaluate(
        "home => home.querySelector('input, select, button').focus()", home.element_handle()
    )
    controls = home.locator("input:enabled, select:enabled, button:enabled")
    for number in range(controls.count()):
        is_focused = "control => control === document.activeElement"
        assert controls.nth(number).evaluate(is_focused), number
        style = controls.nth(number).evaluate("control => getComputedStyle(control).outlineStyle")
        assert style != "none"
        on_the_site.keyboard.press("Tab")
    right = on_the_site.evaluate("document.documentElement.clientWidth")
    for picture in home.locator("svg").all():
        box = picture.bounding_box()
        assert box["width"] > 0
        assert 0 <= box["x"] <= box["x"] + box["width"] <= right


def test_every_control_and_picture_has_a_name(on_the_site, name):
    home = on_the_site.locator(f"#{FIGURES[name]}")
    for control in home.locator("input, select").all():
        assert control.evaluate("control => control.labels[0].innerText").strip()
    for picture in home.locator("svg[role=img]").all():
        assert picture.get_attribute("aria-label")
    assert home.locator("output[aria-live=polite]").count() == 1


def test_without_scripts_there_is_a_picture(browser, built_site, name):
    with browser.new_context(java_script_enabled=False) as context:
        opened = context.new_page()
        opened.goto(f"{built_site.as_uri()}/{name}.html")
        picture = opened.locator(f"#{FIGURES[name]} img")
        assert picture.is_visible()
        assert len(picture.get_attribute("alt").split()) > 5


def test_data_cannot_end_their_element():
    made = page.figure("any", {"text": "</script>"}, plt.figure(), '"quoted"').data
    assert made.count("</script>") == 3  # of the data, and two that are loaded
    assert "&quot;quoted&quot;" in made


def test_data_that_are_not_finite_are_refused():
    with pytest.raises(ValueError, match="not JSON compliant"):
        page.figure("any", {"cost": float("inf")}, plt.figure(), "")


def test_data_that_would_slow_a_page_are_refused():
    with pytest.raises(ValueError, match=r"data of any: 300011 characters, must be at most 300000"):
        page.figure("any", {"text": "a" * 300_000}, plt.figure(), "")


# ------------------------------------------------------------------------------- the two players


@pytest.mark.parametrize("wishes", [(0.8, -0.4), (0.9, 0.5), (-0.3, -0.7)])
@pytest.mark.parametrize("bound", [0.1, 0.5, 2.0])
def test_bounded_players_end_where_the_theorem_says(shown, wishes, bound):
    said = outcome(shown("regression-game", {"wishes": wishes, "bound": bound}))
    elected = float(vote(torch.tensor(wishes).double()[:, None], bound=bound))
    assert f"their average at {elected:.2f}" in said.replace("-0.00", "0.00")
    assert f"The theorem says {elected:.2f}" in said


def test_sliders_are_moved_by_keys(shown):
    opened = shown("regression-game", {"wishes": (0.8, -0.4), "bound": 2.0})
    sliders = opened.locator("input[type=range]")
    sliders.nth(1).focus()
    for _ in range(20):  # from -0.4 to 0.6: the same sign now
        opened.keyboard.press("ArrowRight")
    assert sliders.nth(1).get_attribute("aria-valuetext") == "0.60"
    assert "their average at 0.60" in outcome(opened)
    opened.locator("input[type=checkbox]").focus()
    opened.keyboard.press("Space")
    assert "there is no equilibrium" in outcome(opened)
    assert sliders.nth(2).is_disabled()


# -------------------------------------------------------------------------------------------- LQR


@pytest.fixture(scope="module")
def lqr_tables():
    return [rows("lqr", n) for n in ("tables", "more_domains", "optimizers", "closed_form")]


@pytest.fixture(scope="module")
def lqr_data(lqr_tables):
    return lqr.costs_and_gains(lqr_tables, {"num_domains": 5, "dim_distractor": 1000})


def value(table, metric: str, **cell) -> float:
    return select(table, {"metric": metric, **cell})["value"].mean()


@pytest.mark.parametrize(
    ("table", "optimizer", "method", "num_domains", "dim_distractor"),
    [
        (0, "adam", "gradient_descent", 5, 1000),
        (0, "adam", "ipo_variable_phi", 2, 1000),
        (0, "adam", "overparameterized", 5, 100),
        (1, "adam", "ipo_fixed_phi", 50, 1000),
        (2, "plain", "ipo_fixed_phi", 10, 1000),
        (2, "lbfgs", "gradient_descent", 5, 1000),
    ],
)
def test_costs_and_gains_are_those_of_the_rows(
    shown, lqr_tables, lqr_data, table, optimizer, method, num_domains, dim_distractor
):
    opened = shown("lqr-explorer", lqr_data)
    chosen = {
        "num_domains": num_domains,
        "dim_distractor": dim_distractor,
        "method": method,
        "optimizer": optimizer,
    }
    for select_, option in zip(opened.locator("select").all(), chosen.values(), strict=True):
        select_.select_option(str(option))
    said = outcome(opened)
    found = {m: value(lqr_tables[table], m, **chosen) for m in ("test_cost", *lqr.MEANS.values())}
    assert f"cost {found['test_cost']:.1f} ±" in said
    assert f"{found['train_cost']:.1f} in the training domains" in said
    assert f"the oracle {oracle_cost():.1f}" in said
    assert f"{found['gain_norm_distractor']:.2f} looks at distractors" in said
    assert f"{found['gain_norm_outside']:.2f} lies where" in said
    assert opened.locator("g.chosen circle").count() == 10  # a point for each run


def test_keys_choose_what_was_run_and_nothing_else(shown, lqr_data):
    opened = shown("lqr-explorer", lqr_data)
    opened.locator("select").nth(3).focus()
    opened.keyboard.press("ArrowDown")
    assert "gradient descent, plain" in outcome(opened)
    wanted = {str(n) for n in (2, 5, 10)}
    domains = opened.locator("select").first.locator("option:enabled").all_inner_texts()
    assert set(domains) == wanted


# ------------------------------------------------------------------------------------ coloured keys

COLORS = ("red", "grey")


@pytest.fixture(scope="module")
def keys_task():
    return keys.Keys(ROOT / "data" / "tabulated")


@pytest.fixture(scope="module")
def keys_saved(keys_task):
    arms = [arm for arm in keys.main_arms(20) if arm.label in ("ppo", "ensemble")]
    policies = ROOT / "data" / "policies" / "keys"
    return {arm.label: keys_task.saved(arm, policies)[0] for arm in arms}


@pytest.fixture(scope="module")
def keys_data(keys_task, keys_saved):
    return keys_explorer.policies_in_states(keys_task, keys_saved, COLORS)


def spoken(pattern: str, opened) -> float:
    """A number from what has come out."""
    return float(re.search(pattern, outcome(opened))[1])


@pytest.mark.parametrize("color", COLORS)
@pytest.mark.parametrize(("arm", "run"), [("ppo", 0), ("ppo", 2), ("ensemble", 1)])
def test_returns_are_those_of_the_rows(shown, keys_data, color, arm, run):
    opened = shown("keys-explorer", keys_data)
    opened.locator("select").nth(0).select_option(color)
    chosen = next(n for n in keys_data["policies"] if n.endswith(f"run {run}") and arm in n.lower())
    opened.locator("select").nth(1).select_option(chosen)
    cell = {"train_colors": "red+green", "color_encoding": "integer", "size": 5}
    cell |= {"method": arm, "run": run, "domain": color}
    found = value(rows("keys", "main"), "return_exact", **cell)
    assert spoken(r"all layouts its expected return is ([\d.]+)\.", opened) == pytest.approx(
        found, abs=0.002
    )


@pytest.mark.parametrize(("pressed", "temperature"), [(0, 1.0), (4, 2.0), (-4, 0.0)])
def test_return_of_a_state_is_that_of_the_dynamic_programme(
    shown, keys_task, keys_saved, keys_data, pressed, temperature
):
    opened = shown("keys-explorer", keys_data)
    opened.locator("input[type=range]").focus()
    for _ in range(abs(pressed)):  # a quarter each
        opened.keyboard.press("ArrowRight" if pressed > 0 else "ArrowLeft")
    table = keys_task.tasks["red"]
    logits = keys_task.logits(keys_saved["ppo"], table.images)[:1].numpy()
    scores = np.exp(logits / temperature) if temperature else logits == logits.max(-1)[..., None]
    policy = scores / scores.sum(-1, keepdims=True)
    here = np.eye(len(table.start))[keys_data["layouts"][0]]
    returns, chances = expected_return(replace(table, start=here), policy)
    assert spoken(r"an expected return of ([\d.]+),", opened) == pytest.approx(
        returns[0], abs=0.002
    )
    assert spoken(r"with probability ([\d.]+)\.", opened) == pytest.approx(chances[0], abs=0.002)
    percent = float(opened.locator(".bars button").nth(1).inner_text().split()[1])
    seen = table.observation[keys_data["layouts"][0]]
    assert percent == pytest.approx(100 * policy[0, seen, 1], abs=0.2)


@pytest.mark.parametrize("layout", range(3))
def test_keys_lead_to_the_goal(shown, keys_task, keys_data, layout):
    """The best actions, pressed one after the other."""
    opened = shown("keys-explorer", keys_data)
    opened.locator("select").nth(2).select_option(str(layout))
    table = keys_task.tasks["red"]
    best, _ = optimal_policy(table)
    state, step = keys_data["layouts"][layout], 0
    while True:
        action = best[step, state]
        opened.locator(".bars button").nth(action).focus()
        opened.keyboard.press("Enter")
        step += 1
        if table.goal[state, action]:
            break
        state = table.next_state[state, action]
        column, row = table.position[state]
        agent = opened.locator("svg[role=img]").get_attribute("aria-label")
        assert agent.startswith(f"Agent at column {column}, row {row},")
        assert f"Step {step} of" in outcome(opened)
    assert f"Goal reached in step {step}: a return of {table.goal_reward[step - 1]:.3f}" in (
        outcome(opened)
    )
    opened.locator(".buttons button").last.press("Space")
    assert "Step 0 of" in outcome(opened)


def test_a_most_likely_and_a_sampled_action_are_steps(shown, keys_data):
    opened = shown("keys-explorer", keys_data)
    most_likely, sampled, _ = opened.locator(".buttons button").all()
    most_likely.press("Enter")
    assert "Step 1 of" in outcome(opened)
    sampled.tap()
    assert "Step 2 of" in outcome(opened)


# ------------------------------------------------------------------------------------------ doors

FRICTIONS = (0.1, 1.5)


@pytest.fixture(scope="module")
def success():
    return rows("door", "success")


@pytest.fixture(scope="module")
def door_data(success):
    policies, doors = ROOT / "data" / "policies" / "door", evaluation_doors()
    arms = arms_of(trainings(190, 4096))
    return door_explorer.doors_and_films(success, doors, arms, FRICTIONS, policies, 128)


@pytest.mark.parametrize("arm", ["ppo", "ipo_half"])
@pytest.mark.parametrize(("run", "friction"), [(0, 1.5), (1, 0.1), (2, 1.5)])
def test_opened_doors_are_those_of_the_rows(shown, success, door_data, arm, run, friction):
    opened = shown("door-explorer", door_data)
    for chosen, option in zip(opened.locator("select").all(), (arm, run, friction), strict=True):
        chosen.select_option(str(option))
    steps = 24_903_680 if arm == "ppo" else 12_451_840
    cell = {"method": arm[:3], "steps": steps, "run": run, "domain": str(friction)}
    found = select(success, cell).set_index("door")["value"]
    assert spoken(r"opens ([\d.]+) %", opened) == pytest.approx(100 * found.mean(), abs=0.05)
    levers = evaluation_doors().set_index("door")["lever"]
    weak = found[levers * 2 <= friction]  # newtons
    said = f"{100 * weak.mean():.1f} % of {len(weak)};" if len(weak) else "there are none;"
    assert f"(lever arms up to {friction / 2:.2f} m): {said}" in outcome(opened)
    assert opened.locator("circle[class^=point-]").count() == len(found) + 2  # and the legend's


def test_the_film_plays_and_changes_with_the_friction(shown, door_data):
    opened = shown("door-explorer", door_data)
    film = opened.locator("video")
    length = film.evaluate(
        "film => new Promise(done => { film.onloadedmetadata = () => done(film.duration); "
        "if (film.readyState) done(film.duration); })"
    )
    assert length > 0
    assert film.evaluate("film => film.paused")  # nothing moves unasked
    before = film.get_attribute("src")
    opened.locator("select").nth(2).focus()
    opened.keyboard.press("ArrowUp")
    assert film.get_attribute("src") != before


def test_films_end_as_the_rows_say(door_data):
    """But for a touch of the handle more or less on another processor."""
    cases = door_data["cases"]
    ends = [bool(int(case["opened"][door_data["filmed"]])) for case in cases]
    assert {*ends} == {True, False}  # it divides the runs
    same = [end == case["film_opened"] for end, case in zip(ends, cases, strict=True)]
    assert sum(same) >= len(cases) - 2
