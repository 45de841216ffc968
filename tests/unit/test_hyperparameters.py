"""The paper's tables of hyperparameters: our settings are its programs', and steps are counted."""

import pytest

from experiments.keys import Keys, arm
from experiments.paper import read_paper
from hyperparameters import SETTINGS, differs, num_frames, num_gradient_steps, ours
from hyperparameters import tables as page
from ipo.network_players import NetworkPlayers

STATED = read_paper("hyperparameters")


@pytest.mark.parametrize(
    ("problem", "method", "setting", "programs"),
    STATED.dropna(subset="programs").drop(columns="paper").to_numpy().tolist(),
)
def test_our_settings_are_those_of_the_programs(problem, method, setting, programs):
    assert ours(problem, method, setting) == programs


def test_every_method_of_the_tables_is_there():
    assert set(zip(STATED["problem"], STATED["method"], strict=True)) == SETTINGS.keys()


@pytest.mark.parametrize(
    ("text", "here", "expected"),
    [
        ("256", "256", False),
        ("256", "512", True),
        ("", "5000", False),
        ("120K", "122,880", False),
        ("25M", "24,903,680", False),
        ("25M", "12,451,840", True),
    ],
)
def test_what_differs_from_the_text(text, here, expected):
    assert differs(text, here) == expected


def test_only_three_settings_are_not_as_the_text_says():
    assert page().count("**") == 2 * 3


@pytest.mark.parametrize("method", ["ppo", "ipo", "ensemble", "in_turn"])
@pytest.mark.parametrize("shares", [{}, {"num_envs": (6, 2), "num_minibatches": 3}])
def test_gradient_steps_are_counted_as_they_are_taken(tables, monkeypatch, method, shares):
    tiny = {"num_updates": 2, "num_envs": 8, "num_steps": 10, "minibatch_size": 16, "num_epochs": 3}
    own = arm(method, method, **(tiny | shares))
    taken = []
    monkeypatch.setattr(NetworkPlayers, "step", lambda *_: taken.append(1))
    *_, (frames, _) = Keys(tables).train(own, [0])
    assert num_gradient_steps(own.settings, 2) == len(taken)
    assert num_frames(own.settings, 2) == frames
