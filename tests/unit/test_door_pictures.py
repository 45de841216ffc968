"""Pictures of the door, and the controller that hooks the handle."""

import gc
import subprocess
import sys

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import ipo  # noqa: F401  (registers the environments)
from experiments.doors.hooking import Hooking
from experiments.pictures import DoorPicture, RenderError, door_scene
from ipo.worlds.door import DoorParams, build_door
from ipo.worlds.one_door import DoorEnv

SHIFT = np.array([0.05, -0.05])


@pytest.fixture(scope="module")
def picture():
    try:
        return DoorPicture(DoorParams(), 160, 120)
    except RenderError as error:
        pytest.skip(str(error))


def test_a_picture_shows_something_and_stays_the_same(picture):
    closed = picture.frame(np.zeros(7), SHIFT)
    assert closed.shape == (120, 160, 3) and closed.dtype == np.uint8
    assert closed.std() > 20
    assert np.array_equal(picture.frame(np.zeros(7), SHIFT), closed)


def test_a_picture_that_nobody_closes_does_no_harm_to_the_next(picture):
    before = picture.frame(np.zeros(7), SHIFT)
    other = DoorPicture(DoorParams(width=0.8), 160, 120)
    other.frame(np.zeros(7), SHIFT)
    del other
    gc.collect()
    assert np.array_equal(picture.frame(np.zeros(7), SHIFT), before)


@pytest.mark.parametrize("joint", [0, 5, 6])
def test_a_picture_shows_what_moves(picture, joint):
    moved = np.zeros(7)
    moved[joint] = 0.5
    change = picture.frame(moved, SHIFT).astype(int) - picture.frame(np.zeros(7), SHIFT)
    assert (np.abs(change).max(-1) > 30).sum() > 20


def test_the_environment_draws_its_state(picture):
    env = gymnasium.make("ipo/Door-v0", render_mode="rgb_array", draw=DoorPicture)
    env.reset(seed=0)
    first = env.render()
    for _ in range(30):
        env.step(np.ones(6))
    assert first.shape == (480, 640, 3)
    assert not np.array_equal(env.render(), first)
    env.reset(seed=1)
    assert not np.array_equal(env.render(), first)
    env.close()


@pytest.mark.filterwarnings("ignore:.*Box observation space")
def test_gymnasium_finds_nothing_wrong_with_the_pictures(picture):
    made = gymnasium.make("ipo/Door-v0", max_steps=5, render_mode="rgb_array", draw=DoorPicture)
    check_env(made.unwrapped)


def test_pictures_before_a_reset_are_refused():
    with pytest.raises(gymnasium.error.ResetNeeded):
        DoorEnv(render_mode="rgb_array", draw=DoorPicture).render()


def test_an_unknown_camera_is_refused():
    with pytest.raises(ValueError, match=r"camera = 'rom': .* did you mean 'room'"):
        DoorPicture(DoorParams(), camera="rom")


def test_scenery_does_not_change_what_happens():
    models = [build(DoorParams()).compile() for build in (build_door, door_scene)]
    states = []
    for model in models:
        data = mujoco.MjData(model)
        data.ctrl[:] = [-1, -0.5, -0.2, 0.3, 0.1, 0.2]
        mujoco.mj_step(model, data, 600)
        states.append(data.qpos.copy())
    assert np.array_equal(*states)


def test_without_egl_the_message_names_the_packages_and_doors_still_work():
    """In a process in which OpenGL cannot be loaded."""
    code = (
        "import os; os.environ['PYOPENGL_PLATFORM'] = 'none'\n"
        "import numpy as np\n"
        "from ipo.worlds.one_door import DoorEnv\n"
        "from experiments.pictures import DoorPicture, RenderError\n"
        "env = DoorEnv(render_mode='rgb_array', draw=DoorPicture)\n"
        "env.reset(seed=0); env.step(np.zeros(6))\n"
        "try: env.render()\n"
        "except RenderError as error: print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "sudo apt-get install libegl1" in done.stdout


# ------------------------------------------------------------------------------- hooking


def hooked(friction: float, seed: int, timestep: float = 0.004) -> bool:
    env, hooking = DoorEnv(friction, timestep=timestep), Hooking()
    env.reset(seed=seed)
    hooking.begin(env.params, env.handle_shift)
    for _ in range(env.max_steps):
        info = env.step(hooking(env.data.qpos, env.data.qvel))[-1]
        if info["opened"]:
            return True
    return False


def test_hooking_opens_doors():
    assert all(hooked(0.1, seed) for seed in range(4))


def test_no_hook_is_strong_enough_for_any_friction():
    """2 N at an arm of at most 1.08 m, and 2 N m of the wrist's own."""
    assert not any(hooked(5.0, seed) for seed in range(2))


@pytest.mark.slow
@pytest.mark.parametrize("friction", [0.1, 1.5])
def test_the_long_time_step_opens_as_many_doors_as_the_short_one(friction):
    """0.004 s is what training uses, 0.001 s what was published."""
    found = {dt: np.array([hooked(friction, s, dt) for s in range(60)]) for dt in (0.004, 0.001)}
    assert abs(found[0.004].mean() - found[0.001].mean()) <= 0.05
    assert (found[0.004] == found[0.001]).mean() >= 0.9
