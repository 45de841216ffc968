"""The page on the algorithm: code that is included and not copied, and the game with sliders."""

import html
import inspect
import re

import pytest
from browse import PHONE, new_context, open_page

from ipo import game, lqr_learners, ppo


@pytest.mark.parametrize(
    "function",
    [
        game.moves,
        game.play_round,
        game.average,
        game.LinearPlayers._move_in_turn,
        lqr_learners.ipo_fixed_phi,
        lqr_learners.ipo_variable_phi,
        ppo.Training.update,
        ppo.Training.respond,
        ppo.Training.move_phi,
        ppo.Training._learn,
        ppo.Training.improve,
    ],
    ids=lambda function: function.__qualname__,
)
def test_shows_the_code_of_today(built_site, function):
    page = (built_site / "algorithm.html").read_text(encoding="utf-8")
    text = html.unescape(re.sub(r"<[^>]+>", "", page))
    # Word by word: a page shows methods without the indentation of their class.
    assert " ".join(inspect.getsource(function).split()) in " ".join(text.split())


@pytest.fixture(params=[None, PHONE], ids=["wide", "phone"])
def page(request, browser, built_site):
    options = {} if request.param is None else {"viewport": request.param}
    with new_context(browser, **options) as context:
        page = context.new_page()
        open_page(page, f"{built_site.as_uri()}/algorithm.html")
        yield page


def test_sliders_are_moved_by_keys_and_the_theorem_agrees(page):
    output = page.locator("#regression-game output")
    sliders = page.locator("#regression-game input[type=range]")
    assert sliders.count() == 3
    assert "their average at 0.00" in output.inner_text()
    assert "The theorem says 0.00" in output.inner_text()
    sliders.nth(1).focus()
    for _ in range(20):  # from -0.4 to 0.6: the same sign now
        page.keyboard.press("ArrowRight")
    assert "their average at 0.60" in output.inner_text()
    assert "The theorem says 0.60" in output.inner_text()
    page.locator("#regression-game input[type=checkbox]").check()
    assert "there is no equilibrium" in output.inner_text()
    assert sliders.nth(2).is_disabled()


def test_without_scripts_there_is_a_picture(browser, built_site):
    with browser.new_context(java_script_enabled=False) as context:
        page = context.new_page()
        page.goto(f"{built_site.as_uri()}/algorithm.html")
        picture = page.locator("#regression-game img")
        assert picture.is_visible()
        assert "average zero" in picture.get_attribute("alt")
