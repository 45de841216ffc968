"""The rule that tells hooking from pulling with the outside, on motions that are known."""

from dataclasses import replace

import numpy as np
import pytest

from ipo.door import DoorEnv, DoorParams
from ipo.door_strategies import is_inside, strategy
from ipo.hooking import Hooking


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


def test_an_unknown_side_is_refused():
    with pytest.raises(ValueError, match=r"side = 'inner': must be one of inside, outside"):
        Hooking("inner")
