"""The coloured keys as an environment: what its arguments change, and what they must not."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from minigrid.core.actions import Actions
from minigrid.core.constants import COLOR_TO_IDX, OBJECT_TO_IDX
from minigrid.envs.doorkey import DoorKeyEnv

import ipo  # noqa: F401  (registers the environment)
from ipo.worlds.colored_keys import COLORS, ColoredKeysEnv

RIGHT, DOWN = 0, 1  # directions of MiniGrid
KEY, DOOR, GOAL, WALL = (OBJECT_TO_IDX[name] for name in ("key", "door", "goal", "wall"))


def things(env: ColoredKeysEnv) -> dict[str, tuple[object, tuple[int, int]]]:
    """Key, door and goal with their positions."""
    cells = enumerate(env.unwrapped.grid.grid)
    width = env.unwrapped.width
    return {
        thing.type: (thing, (index % width, index // width))
        for index, thing in cells
        if thing is not None and thing.type != "wall"
    }


def with_layout(agent: tuple, direction: int, key: tuple, door: tuple, **options) -> ColoredKeysEnv:
    """The environment after the first reset that draws this layout."""
    env = ColoredKeysEnv(**options)
    for seed in range(1000):
        env.reset(seed=seed)
        found = things(env)
        layout = tuple(env.agent_pos), env.agent_dir, found["key"][1], found["door"][1]
        if layout == (agent, direction, key, door):
            return env
    raise AssertionError(f"no seed draws {agent}, {direction}, {key}, {door}")


# ---------------------------------------------------------------------------- arguments


def test_colors_are_the_six_of_minigrid_by_code():
    assert [COLOR_TO_IDX[color] for color in COLORS] == [0, 1, 2, 3, 4, 5]
    assert COLORS == ("red", "green", "blue", "purple", "yellow", "grey")


@pytest.mark.parametrize("color", COLORS)
@pytest.mark.parametrize("size", [5, 6, 12])
def test_gymnasium_accepts_the_environment(size, color):
    env = gymnasium.make("ipo/ColoredKeys-v0", size=size, color=color)
    check_env(env.unwrapped, skip_render_check=True)


@pytest.mark.parametrize("color", COLORS)
@pytest.mark.parametrize("size", [5, 8, 12])
def test_color_is_that_of_key_and_door_alone(size, color):
    env = gymnasium.make("ipo/ColoredKeys-v0", size=size, color=color)
    for seed in range(20):
        env.reset(seed=seed)
        found = things(env)
        assert found.keys() == {"key", "door", "goal"}
        assert found["key"][0].color == found["door"][0].color == color
        assert found["goal"][0].color == "green"
        walls = {thing.color for thing in env.unwrapped.grid.grid if thing and thing.type == "wall"}
        assert walls == {"grey"}


@pytest.mark.parametrize("size", [5, 6, 8, 12])
def test_layout_is_two_rooms_with_a_locked_door(size):
    env = ColoredKeysEnv(size=size)
    for seed in range(20):
        env.reset(seed=seed)
        found = things(env)
        door, (wall, row) = found["door"]
        assert door.is_locked and not door.is_open
        assert 2 <= wall <= size - 3 and 1 <= row <= size - 3
        assert all(env.grid.get(wall, y).type == "wall" for y in range(size) if y != row)
        assert env.agent_pos[0] < wall and found["key"][1][0] < wall
        assert found["goal"][1] == (size - 2, size - 2)
        assert (env.width, env.height, env.max_steps) == (size, size, 10 * size**2)


def test_papers_grid_has_one_wall_two_doors_and_three_cells():
    env = ColoredKeysEnv()
    doors, cells = set(), set()
    for seed in range(200):
        env.reset(seed=seed)
        found = things(env)
        doors.add(found["door"][1])
        cells |= {tuple(map(int, env.agent_pos)), found["key"][1]}
    assert doors == {(2, 1), (2, 2)}
    assert cells == {(1, 1), (1, 2), (1, 3)}


def test_defaults_are_the_papers_test_domain():
    made = gymnasium.make("ipo/ColoredKeys-v0").unwrapped
    assert isinstance(made, ColoredKeysEnv)
    assert (made.width, made.color, made.max_steps) == (5, "grey", 250)


def test_yellow_is_minigrids_own_task():
    """MiniGrid's key and door are yellow: the same images, rewards and ends, step by step."""
    ours, theirs = ColoredKeysEnv(size=6, color="yellow"), DoorKeyEnv(size=6)
    rng = np.random.default_rng(0)
    for seed in range(5):
        (seen, _), (expected, _) = ours.reset(seed=seed), theirs.reset(seed=seed)
        assert np.array_equal(seen["image"], expected["image"])
        for action in rng.integers(0, 7, size=360):
            (seen, *rest), (expected, *others) = ours.step(action), theirs.step(action)
            assert np.array_equal(seen["image"], expected["image"])
            assert rest == others


def test_color_does_not_change_what_is_drawn():
    layouts = []
    for color in COLORS:
        env = ColoredKeysEnv(size=8, color=color)
        env.reset(seed=3)
        places = {name: place for name, (_, place) in things(env).items()}
        layouts.append((tuple(env.agent_pos), env.agent_dir, places))
    assert layouts == layouts[:1] * len(COLORS)


# -------------------------------------------------------------------------- observation


@pytest.mark.parametrize("color", COLORS)
def test_view_shows_codes_of_object_color_and_state(color):
    """The agent looks along the left wall: walls on both sides, the key two cells ahead."""
    env = with_layout((1, 1), DOWN, (1, 3), (2, 2), color=color)
    image = env.gen_obs()["image"]
    assert image.shape == (7, 7, 3) and image.dtype == np.uint8
    # The agent stands at column 3 of the last row and looks towards row 0; left is the door.
    assert image[3, 4].tolist() == [KEY, COLOR_TO_IDX[color], 0]
    assert image[2, 5].tolist() == [DOOR, COLOR_TO_IDX[color], 2]
    assert image[4, 5].tolist() == [WALL, COLOR_TO_IDX["grey"], 0]
    assert GOAL not in image[..., 0]


# ------------------------------------------------------------------ rewards and progress


@pytest.mark.parametrize("color", COLORS)
@pytest.mark.parametrize(("max_steps", "horizon"), [(None, 250), (40, 40)])
def test_the_way_to_the_goal(color, max_steps, horizon):
    """Down to the key, back, through the door, down to the goal: 12 steps, worked out by hand."""
    env = with_layout((1, 1), DOWN, (1, 3), (2, 1), color=color, max_steps=max_steps)
    way = [Actions.forward, Actions.pickup, Actions.left, Actions.left, Actions.forward]
    way += [Actions.right, Actions.toggle, Actions.forward, Actions.forward]
    way += [Actions.right, Actions.forward, Actions.forward]
    assert env.progress == 0
    progress, rewards, ends = [], [], []
    for action in way:
        _, reward, terminated, truncated, _ = env.step(action)
        progress.append(env.progress)
        rewards.append(reward)
        ends.append((terminated, truncated))
    assert progress == [0] + [1] * 5 + [2] * 6
    assert rewards == [0] * 11 + [pytest.approx(1 - 0.9 * 12 / horizon)]
    assert ends == [(False, False)] * 11 + [(True, False)]
    assert env.carrying.type == "key"  # it stays in hand after unlocking


def test_door_stays_locked_without_the_key():
    env = with_layout((1, 1), RIGHT, (1, 3), (2, 1))
    env.step(Actions.toggle)
    env.step(Actions.forward)
    assert tuple(env.agent_pos) == (1, 1) and env.progress == 0


def test_key_laid_down_again_is_progress_lost():
    env = with_layout((1, 2), DOWN, (1, 3), (2, 1))
    progress = []
    for action in (Actions.pickup, Actions.drop, Actions.pickup):
        env.step(action)
        progress.append(env.progress)
    assert progress == [1, 0, 1]


@pytest.mark.parametrize("options", [{}, {"size": 6}, {"max_steps": 7}])
def test_time_runs_out_without_reward(options):
    env = ColoredKeysEnv(**options)
    env.reset(seed=0)
    horizon = options.get("max_steps", 10 * options.get("size", 5) ** 2)
    ends = [env.step(Actions.left)[1:4] for _ in range(horizon)]
    assert ends == [(0, False, False)] * (horizon - 1) + [(0, False, True)]


def test_rendered_frames_show_the_color():
    frames = []
    for color in COLORS:
        env = gymnasium.make("ipo/ColoredKeys-v0", color=color, render_mode="rgb_array")
        env.reset(seed=0)
        frames.append(env.render())
    assert all(frame.shape == (160, 160, 3) for frame in frames)
    assert len({frame.tobytes() for frame in frames}) == len(COLORS)
