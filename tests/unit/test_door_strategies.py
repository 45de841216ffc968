"""The rule that tells hooking from pulling with the outside, on motions that are known."""

from dataclasses import replace

import numpy as np
import pytest

from experiments.doors import success as door_experiments
from experiments.doors.hooking import Hooking
from experiments.doors.pulling import (
    is_inside,
    strategy,
    strategy_of_part,
    strategy_of_policy,
)
from experiments.doors.success import Cell, ScriptedCell, watch
from experiments.doors.training import CELLS, NETWORK, last_info, made_for, policy_path
from experiments.policies import save_policy
from ipo.worlds.door import DoorParams
from ipo.worlds.one_door import DoorEnv


def scripted(side: str, seed: int) -> str:
    params = DoorParams.sample(np.random.default_rng(seed), 0.1)
    if side == "outside":  # room behind the handle
        params = replace(params, handle_depth=0.12, handle_diameter=0.014)
    env, hooking = DoorEnv(params=params), Hooking(side)
    observation, _ = env.reset(seed=seed)
    hooking.begin(params, env.handle_shift)
    return strategy(env, lambda _: hooking(env.data.qpos, env.data.qvel), observation)[0]


@pytest.mark.parametrize(("side", "name"), [("inside", "hook"), ("outside", "outside")])
@pytest.mark.parametrize("seed", [0, 4])
def test_a_scripted_motion_is_recognised(side, name, seed):
    assert scripted(side, seed) == name


def test_a_door_that_stays_closed_has_failed():
    env = DoorEnv(max_steps=5)
    observation, _ = env.reset(seed=0)
    name, part = strategy(env, lambda _: np.zeros(6), observation)
    assert name == "failed" and np.isnan(part)


@pytest.mark.parametrize(
    ("geom", "point", "inside"),
    [
        ("hook_1", (-0.155, 0.0, 0.0), True),  # between the outer side and the wrist
        ("hook_1", (-0.165, 0.0, 0.0), False),
        ("hook_0", (-0.13, 0.020, 0.0), True),
        ("hook_0", (-0.13, 0.030, 0.0), False),
        ("hook_2", (-0.150, -0.020, 0.0), True),
        ("hook_2", (-0.150, -0.030, 0.0), False),
        ("hook_2", (-0.140, -0.0251, 0.0), True),  # the end of the tip
        ("hook_3", (-0.115, 0.013, 0.0), True),
        ("wrist_front", (-0.0985, 0.0, 0.0), False),
    ],
)
def test_sides_of_the_tubes(geom, point, inside):
    assert is_inside(geom, np.array(point)) is inside


@pytest.mark.parametrize(
    ("parts", "name"),
    [
        ([0.9, 0.8, 0.1], "hook"),  # two thirds
        ([0.9, 0.79, 0.1], "mixed"),
        ([0.2, 0.0, 0.9], "outside"),
        ([0.5, 0.5, 0.5], "mixed"),
        ([], "mixed"),
    ],
)
def test_strategy_of_a_policy(parts, name):
    assert strategy_of_policy(parts) == name


def test_names_of_parts():
    names = [strategy_of_part(part) for part in (0.0, 0.2, 0.21, 0.79, 0.8, 1.0)]
    assert names == ["outside", "outside", "mixed", "mixed", "hook", "hook"]


def test_the_controller_by_hand_hooks_the_doors_of_the_evaluation():
    rows = watch(ScriptedCell((0.1,), 3), [0]).set_index(["door", "metric"])["value"]
    for door in range(3):
        assert rows[door, "success"] == 1
        assert rows[door, "inside_part"] > 0.95
        assert 100 < rows[door, "opened_at"] < 512


def test_a_policy_that_is_watched_opens_the_doors_that_it_opens(tmp_path):
    """One door after the other, with contacts looked at, or all side by side."""
    players = [NETWORK.start([np.random.default_rng(0)])]
    cell = Cell(CELLS["ppo"], 95, frictions=(0.0,), num_doors=4)
    made = made_for(CELLS["ppo"], 0, 95, "best")
    save_policy(policy_path(tmp_path, "ppo", 0, 95), players, made)
    rows = watch(cell, [0], tmp_path)
    success = rows[rows["metric"] == "success"]["value"]
    assert list(success) == list(
        last_info(players, 0.0, 4, door_experiments.EVALUATION_SEED)["opened"]
    )


def test_an_unknown_side_is_refused():
    with pytest.raises(ValueError, match=r"side = 'inner': must be one of inside, outside"):
        Hooking("inner")
