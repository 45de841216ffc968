"""The door: kinematics, dynamics and reward by hand, one door against many, bad input."""

import math
from dataclasses import replace

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given
from hypothesis import strategies as st

import ipo  # noqa: F401  (registers the environments)
from ipo.worlds.door import (
    ANCHOR,
    FINGERTIP,
    WRIST,
    DoorParams,
    build_door,
    draw_start,
    fingertip_position,
    hook_rotation,
    lever,
    observe,
    reward,
    shift_handle,
    target_position,
)
from ipo.worlds.many_doors import VectorDoor
from ipo.worlds.one_door import DoorEnv

NAN = math.nan


def random_door(seed: int = 0, friction: float = 0.0) -> DoorParams:
    return DoorParams.sample(np.random.default_rng(seed), friction)


# -------------------------------------------------------------------------------- kinematics


@given(seed=st.integers(0, 10**6))
def test_formulas_agree_with_mujoco_in_any_state(seed):
    random = np.random.default_rng(seed)
    params = DoorParams.sample(random)
    model = build_door(params).compile()
    data = mujoco.MjData(model)
    qpos, shift = random.uniform(-1.5, 1.5, 7), random.uniform(-0.15, 0.15, 2)
    data.qpos[:] = qpos
    shift_handle(model, params, shift)
    mujoco.mj_kinematics(model, data)
    wrist, handle = data.body("wrist"), data.body("handle")
    R = hook_rotation(qpos[3:6])
    np.testing.assert_allclose(R, wrist.xmat.reshape(3, 3), atol=1e-12)
    tip = wrist.xpos + wrist.xmat.reshape(3, 3) @ FINGERTIP
    np.testing.assert_allclose(fingertip_position(qpos, R), tip, atol=1e-12)
    target = handle.xpos + handle.xmat.reshape(3, 3) @ params.target_position
    hinge, arm = lever(params, shift)
    np.testing.assert_allclose(target_position(qpos[6], hinge, arm), target, atol=1e-12)


def test_the_fingertip_at_rest_is_in_front_of_the_wrist():
    tip = fingertip_position(np.zeros(7), np.eye(3))
    np.testing.assert_allclose(tip, [1 - 0.15989, 0, 1.2])


def test_the_wrist_turns_about_its_anchor():
    """A quarter turn about z moves the fingertip, which points to -x, to -y of the anchor."""
    qpos = np.array([0, 0, 0, math.pi / 2, 0, 0, 0.0])
    tip = fingertip_position(qpos, hook_rotation(qpos[3:6]))
    reach = ANCHOR[0] - FINGERTIP[0]
    np.testing.assert_allclose(tip, [1 + ANCHOR[0], -reach, 1.2], atol=1e-12)


def test_the_target_of_a_closed_door_by_hand():
    params = DoorParams(width=1.0, handle_ratio=0.2, wall_offset=0.05, thickness=0.02)
    hinge, arm = lever(params, np.array([0.1, -0.1]))
    np.testing.assert_allclose(hinge, [0.022, 0.05 + 0.5, 1.0])
    radius, bend = 0.008, 0.02
    rho = 0.97450 * (bend + radius**2 / (4 * bend))
    x = 0.022 + 0.01 - 0.006 + 0.095 - bend + rho * math.sin(math.pi / 8)
    np.testing.assert_allclose(target_position(0.0, hinge, arm), [x, 0.05 - 0.3 + 0.1, 0.9])


def test_an_open_door_is_nearer_to_the_robot():
    hinge, arm = lever(DoorParams(), np.zeros(2))
    closed, opened = (target_position(angle, hinge, arm) for angle in (0.0, math.pi / 2))
    assert opened[0] == pytest.approx(hinge[0] - arm[1])
    assert closed[0] < 0.2 < opened[0] < WRIST[0]


# ----------------------------------------------------------------------------------- reward


def test_reward_by_hand():
    """Level hook, at the target, closed door: only the logarithm and the constant remain."""
    assert reward(0.0, 0.0, np.eye(3)) == pytest.approx(-math.log(0.005) - 5)
    quarter = hook_rotation(np.array([math.pi / 6, 0.0, 0.0]))  # about z: e_z = 30 degrees
    found = reward(0.1, 0.3, quarter)
    expected = 30 * 0.1 - 0.3 - math.log(0.09 + 0.005) - 5 - abs(math.pi / 6 - 0.1)
    assert found == pytest.approx(expected)


def test_a_hook_that_turns_with_the_door_loses_nothing():
    angles = np.array([0.4, 0.0, 0.0])
    assert reward(0.4, 0.0, hook_rotation(angles)) == pytest.approx(12 - math.log(0.005) - 5)


def test_a_tilted_hook_loses_its_tilt():
    level, tilted = (hook_rotation(np.array([0.0, tilt, 0.0])) for tilt in (0.0, 0.3))
    assert reward(0.0, 0.1, level) - reward(0.0, 0.1, tilted) == pytest.approx(0.3)


def test_rewards_are_those_of_the_state_before_the_action():
    env = DoorEnv()
    env.reset(seed=0)
    hinge, arm = lever(env.params, env.handle_shift)
    before = observe(env.data.qpos, env.data.qvel, hinge, arm)[1]
    assert env.step(np.ones(6))[1] == before


# ------------------------------------------------------------------------ the compiled model


def test_mass_damping_and_friction_are_in_the_compiled_model():
    params = random_door(3, friction=1.3)
    model = build_door(params).compile()
    np.testing.assert_allclose(
        model.dof_damping, [*[params.joint_damping] * 6, params.hinge_damping]
    )
    np.testing.assert_allclose(model.dof_frictionloss, [0] * 6 + [1.3])
    np.testing.assert_allclose(model.jnt_stiffness, [0] * 6 + [params.hinge_stiffness])
    np.testing.assert_allclose(model.dof_armature, [1] * 6 + [1e-4])
    volume = params.height * params.width * params.thickness
    np.testing.assert_allclose(model.body("door").mass, volume * params.density)
    np.testing.assert_allclose(model.body("wrist").mass, 0.657)
    np.testing.assert_allclose(model.jnt_range[-1], [0, 1.57])
    assert not model.opt.gravity.any()


def test_the_doors_inertia_about_its_hinge():
    params = random_door(4)
    model = build_door(params).compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    dense = np.zeros((7, 7))
    mujoco.mj_fullM(model, data, dense)
    panel = params.mass * (params.width**2 / 3 + params.thickness**2 / 12)
    out = params.handle_position[0]
    handle = 1.1 * (params.lever_arm**2 + out**2) + 1e-3
    assert dense[6, 6] == pytest.approx(panel + handle + 1e-4, rel=1e-6)


@pytest.mark.parametrize(("torque", "moves"), [(1.2, False), (1.4, True)])
def test_the_hinge_moves_when_the_torque_exceeds_its_friction(torque, moves):
    model = build_door(random_door(0, friction=1.3)).compile()
    data = mujoco.MjData(model)
    data.qfrc_applied[6] = torque
    mujoco.mj_step(model, data, 500)
    assert (data.qpos[6] > 0.02) == moves


def test_motors_have_the_published_strength():
    """2 N on 0.657 kg and an armature of 1 kg; more than full throttle changes nothing."""
    model = build_door(DoorParams()).compile()
    for throttle in (1.0, 5.0):
        data = mujoco.MjData(model)
        data.ctrl[0] = throttle
        mujoco.mj_forward(model, data)
        assert data.qacc[0] == pytest.approx(2 / 1.657, rel=1e-6)


# ------------------------------------------------------------------------------- random doors


def test_doors_are_drawn_from_the_published_ranges():
    doors = [random_door(seed) for seed in range(400)]
    for name, low, high in (
        ("height", 2.0, 2.5),
        ("width", 0.75, 1.2),
        ("thickness", 0.02, 0.03),
        ("handle_height", 0.9, 1.1),
        ("handle_ratio", 0.10, 0.20),
        ("wall_offset", -0.1, 0.1),
        ("density", 200, 300),
        ("hinge_damping", 1.0, 2.0),
        ("hinge_stiffness", 0.10, 0.20),
        ("handle_diameter", 0.012, 0.020),
        ("handle_depth", 0.070, 0.120),
        ("handle_half_length", 0.075, 0.100),
        ("handle_fillet", 0.008, 0.035),
    ):
        values = np.array([getattr(door, name) for door in doors])
        assert low <= values.min() < low + 0.15 * (high - low), name
        assert high - 0.15 * (high - low) < values.max() < high, name
    assert {door.joint_damping for door in doors} == {0.09, 0.10}


def test_starts_are_drawn_from_the_published_ranges():
    random = np.random.default_rng(0)
    starts, shifts = (
        np.array(x) for x in zip(*(draw_start(random) for _ in range(2000)), strict=True)
    )
    np.testing.assert_allclose(starts.min(0), [-0.3] * 5 + [0, 0], atol=0.01)
    np.testing.assert_allclose(starts.max(0), [0.3] * 5 + [3.13, 0], atol=0.01)
    np.testing.assert_allclose(shifts.min(0), [-0.10, -0.15], atol=0.01)
    np.testing.assert_allclose(shifts.max(0), [0.15, 0.0], atol=0.01)


def test_a_door_does_not_depend_on_its_friction():
    assert replace(random_door(5, 1.3), friction=0.0) == random_door(5, 0.0)


# ------------------------------------------------------------------------------ environments


@pytest.mark.filterwarnings("ignore:.*Box observation space")
def test_gymnasium_finds_nothing_wrong():
    check_env(gym.make("ipo/Door-v0", friction=0.1).unwrapped, skip_render_check=True)


def test_a_door_stays_until_a_seed_comes():
    env = DoorEnv(friction=0.5)
    first, _ = env.reset(seed=3)
    params = env.params
    second, _ = env.reset()
    assert env.params is params and not np.array_equal(first, second)
    again, _ = env.reset(seed=3)
    assert env.params == params and np.array_equal(first, again)
    env.reset(seed=4)
    assert env.params != params
    assert env.params.friction == 0.5


def test_an_episode_ends_at_the_time_limit_only():
    env = DoorEnv(max_steps=3)
    env.reset(seed=0)
    ends = [env.step(np.zeros(6))[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (False, True)]


def test_many_doors_are_as_many_single_ones():
    frictions, seeds, steps = [0.0, 0.1, 1.3], [11, 12, 13], 12
    singles = [DoorEnv(friction, max_steps=steps) for friction in frictions]
    doors = VectorDoor(frictions, max_steps=steps)
    observations, _ = doors.reset(seed=seeds)
    for env, seed, row in zip(singles, seeds, observations, strict=True):
        assert np.array_equal(env.reset(seed=seed)[0], row)
    random = np.random.default_rng(0)
    for _ in range(2 * steps + 3):
        actions = 2 * random.normal(size=(3, 6))
        found = doors.step(actions)
        for d, env in enumerate(singles):
            row, earned, _, truncated, info = env.step(actions[d])
            assert (earned, truncated) == (found[1][d], found[3][d])
            assert info["door_angle"] == found[4]["door_angle"][d]
            assert info["opened"] == found[4]["opened"][d]
            if truncated:
                assert np.array_equal(row, found[4]["final_obs"][d])
                row, _ = env.reset()
            assert np.array_equal(row, found[0][d])
    assert len(doors.episodes) == 2


def test_an_episodes_return_is_the_sum_of_its_rewards():
    doors = VectorDoor([0.0, 0.1], max_steps=5)
    doors.reset(seed=0)
    random = np.random.default_rng(0)
    rewards = [doors.step(random.normal(size=(2, 6)))[1] for _ in range(10)]
    (first, _), (second, _) = doors.episodes
    np.testing.assert_allclose(first, sum(rewards[:5]))
    np.testing.assert_allclose(second, sum(rewards[5:]))


def test_doors_go_on_from_their_state_in_the_middle_of_an_episode():
    random = np.random.default_rng(0)
    actions = random.normal(size=(40, 2, 6))
    doors, others = (VectorDoor([0.0, 1.3], max_steps=25) for _ in range(2))
    doors.reset(seed=7)
    for action in actions[:15]:
        doors.step(action)
    others.restore(doors.state())
    for action in actions[15:]:
        for one, other in zip(doors.step(action)[:4], others.step(action)[:4], strict=True):
            assert np.array_equal(one, other)
    np.testing.assert_array_equal(doors.episodes[0][0], others.episodes[0][0])


def test_a_given_door_stays():
    params = random_door(9, 0.7)
    doors = VectorDoor([params, 0.2], max_steps=5)
    doors.reset(seed=0)
    assert doors.frictions == [0.7, 0.2]
    assert doors.params[0] == params
    doors.reset(seed=1)
    assert doors.params[0] == params


# --------------------------------------------------------------------------------- bad input


def test_a_handle_that_cannot_be_is_refused():
    with pytest.raises(ValueError, match=r"^handle_fillet = 0.1: must be less than handle_depth ="):
        DoorParams(handle_fillet=0.1)


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        ({"friction": 0.1, "params": DoorParams()}, "friction = 0.1: must not be given beside"),
        ({"timestep": 0.003}, "timestep = 0.003: a whole number of them must make 0.02 s"),
        ({"render_mode": "rgb_array"}, "render_mode = 'rgb_array': must come with draw"),
    ],
)
def test_an_environment_that_makes_no_sense_is_refused(arguments, error):
    with pytest.raises(ValueError, match=f"^{error}"):
        DoorEnv(**arguments)


def test_steps_after_the_end_are_refused():
    env = DoorEnv(max_steps=1)
    env.reset(seed=0)
    env.step(np.zeros(6))
    with pytest.raises(gym.error.ResetNeeded, match="the episode has ended"):
        env.step(np.zeros(6))


def test_steps_before_a_reset_are_refused():
    with pytest.raises(gym.error.ResetNeeded):
        DoorEnv().step(np.zeros(6))
    with pytest.raises(gym.error.ResetNeeded):
        VectorDoor([0.0]).step(np.zeros((1, 6)))
    with pytest.raises(gym.error.ResetNeeded):
        VectorDoor([0.0]).state()


@pytest.mark.parametrize("bad", [NAN, math.inf])
def test_an_action_that_is_not_finite_names_door_and_step_and_moves_nothing(bad):
    doors, others = (VectorDoor([0.0, 0.1]) for _ in range(2))
    for both in (doors, others):
        both.reset(seed=0)
        both.step(np.zeros((2, 6)))
    actions = np.ones((2, 6))
    actions[1, 3] = bad
    with pytest.raises(ValueError, match="of door 1 in step 1: must be finite"):
        doors.step(actions)
    answers = [both.step(np.zeros((2, 6)))[:4] for both in (doors, others)]
    for one, other in zip(*answers, strict=True):
        assert np.array_equal(one, other)


def test_a_simulation_that_diverges_names_door_and_step(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log into the present folder
    doors = VectorDoor([0.0, 0.1])
    doors.reset(seed=0)
    doors.data[1].qvel[0] = 1e12
    with pytest.raises(FloatingPointError, match="of door 1 diverged in step 1"):
        doors.step(np.zeros((2, 6)))
