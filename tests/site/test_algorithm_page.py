"""The page on the algorithm: code that is included and not copied."""

import html
import inspect
import re

import pytest

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
