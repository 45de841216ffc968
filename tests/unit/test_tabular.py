"""The tabulated task against MiniGrid itself; exact returns against slow sums and sampling."""

import copy
import errno
import os
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

import gymnasium
import numpy as np
import pytest
import scipy.stats
import torch
from gymnasium.spaces import Discrete
from hypothesis import given
from hypothesis import strategies as st
from minigrid.core.constants import COLOR_TO_IDX, OBJECT_TO_IDX
from minigrid.envs import DynamicObstaclesEnv

from experiments import tabulated
from experiments.sealed import read_sealed
from experiments.tabulated import TableWarning, load_or_tabulate
from experiments.tensors import write_tensors
from experiments.visits import occupancy, reach
from ipo.worlds.colored_keys import COLORS, ColoredKeysEnv
from ipo.worlds.minigrid_tables import NotTabularError, state_of, tabulate
from ipo.worlds.tabular import (
    TabularDomains,
    TabularEnvironments,
    TabularTask,
    expected_return,
    optimal_policy,
)

ARRAYS = [field.name for field in fields(TabularTask)]
NUM_ACTIONS = 7
EARLY, LAST = 100, 250  # steps of an episode; the last one is the horizon

# ------------------------------------------------------------------- slow exploration


def describe(env: ColoredKeysEnv) -> tuple:
    """All that can change within an episode and between layouts."""
    where = {
        thing.type: (index, getattr(thing, "is_open", None), getattr(thing, "is_locked", None))
        for index, thing in enumerate(env.grid.grid)
        if thing is not None and thing.type in ("key", "door")
    }
    carrying = None if env.carrying is None else env.carrying.type
    return tuple(map(int, env.agent_pos)), env.agent_dir, carrying, where.get("key"), where["door"]


@dataclass
class Seen:
    """A state of MiniGrid, and what each action does there at two moments of an episode."""

    env: ColoredKeysEnv
    image: np.ndarray
    next_states: list[tuple]
    early: list[tuple[float, bool, bool]]
    last: list[tuple[float, bool, bool]]


@dataclass
class Explored:
    """Everything that can be reached, by copying the whole environment for every step."""

    seeds: dict[tuple, int]  # of each layout: one that draws it
    states: dict[tuple, Seen]


def stepped(env: ColoredKeysEnv, action: int, step: int) -> tuple[ColoredKeysEnv, tuple]:
    """A copy of ``env`` after ``action`` in this step of the episode."""
    env = copy.deepcopy(env)
    env.step_count = step - 1
    _, reward, terminated, truncated, _ = env.step(action)
    return env, (reward, terminated, truncated)


@pytest.fixture(scope="module")
def explored() -> Explored:
    env = ColoredKeysEnv(color="grey")
    seeds, pending = {}, []
    for seed in range(500):
        env.reset(seed=seed)
        if describe(env) not in seeds:
            seeds[describe(env)] = seed
            pending.append(copy.deepcopy(env))
    states = {}
    while pending:
        env = pending.pop()
        if describe(env) in states:
            continue
        after, early = zip(*(stepped(env, a, EARLY) for a in range(NUM_ACTIONS)), strict=True)
        states[describe(env)] = Seen(
            env,
            env.gen_obs()["image"],
            [describe(new) for new in after],
            list(early),
            [stepped(env, a, LAST)[1] for a in range(NUM_ACTIONS)],
        )
        pending += [new for new, (_, ended, _) in zip(after, early, strict=True) if not ended]
    return Explored(seeds, states)


def follow(
    explored: Explored, task: TabularTask, known: dict[tuple, int], layout: tuple, start: int
) -> dict[tuple, int] | None:
    """Go all ways from a layout and from a state of the table at once.

    Returns which state of the table each state is, or None where the two look different.
    """
    found, pending = dict(known), [(layout, start)]
    while pending:
        state, index = pending.pop()
        seen = explored.states[state]
        if state in found:
            if found[state] != index:
                return None
            continue
        if not np.array_equal(task.images[task.observation[index]], seen.image):
            return None
        found[state] = index
        for action, (_, terminated, _) in enumerate(seen.early):
            if not terminated:
                pending.append((seen.next_states[action], task.next_state[index, action]))
    return found


@pytest.fixture(scope="module")
def index_of(explored, keys) -> dict[tuple, int]:
    """The state of the table that each state of MiniGrid is."""
    task, known = keys["grey"], {}
    for layout in explored.seeds:
        attempts = (follow(explored, task, known, layout, s) for s in np.flatnonzero(task.start))
        known = next(found for found in attempts if found is not None)
    return known


# ------------------------------------------------------------- the table is the task


@pytest.mark.parametrize("color", COLORS)
def test_number_of_layouts_states_and_observations(keys, color):
    task = keys[color]
    assert np.count_nonzero(task.start) == 48
    assert task.start[task.start > 0] == pytest.approx(1 / 48)
    assert len(task.start) == 520
    assert len(task.images) == len(np.unique(task.images, axis=0)) == 289
    assert task.horizon == 250


def test_number_of_observations_in_two_domains(keys):
    assert len(TabularDomains([keys["red"], keys["green"]]).images) == 564


def test_every_state_is_in_the_table_once(explored, index_of, keys):
    assert len(explored.seeds) == 48
    assert index_of.keys() == explored.states.keys()
    assert sorted(index_of.values()) == list(range(520))
    starts = {index_of[layout] for layout in explored.seeds}
    assert starts == set(np.flatnonzero(keys["grey"].start))


def test_every_step_from_every_state_is_minigrids(explored, index_of, keys):
    """Observation, next state, reward, termination and truncation, early and in the last step."""
    task = keys["grey"]
    num_goals = 0
    for state, seen in explored.states.items():
        s = index_of[state]
        assert np.array_equal(task.images[task.observation[s]], seen.image)
        assert task.progress[s] == seen.env.progress
        assert tuple(task.position[s]) == tuple(seen.env.agent_pos)
        assert state_of(task, seen.env) == s
        for a in range(NUM_ACTIONS):
            goal, done = bool(task.goal[s, a]), bool(task.done[s, a])
            num_goals += goal
            for step, outcomes in ((EARLY, seen.early), (LAST, seen.last)):
                reward = task.goal_reward[step - 1] if goal else 0
                assert outcomes[a] == (reward, done, step == task.horizon)
            if not done:
                assert task.next_state[s, a] == index_of[seen.next_states[a]]
    assert num_goals > 0


def test_reward_of_the_goal_in_every_step(keys):
    expected = [1 - 0.9 * t / 250 for t in range(1, 251)]
    assert keys["red"].goal_reward == pytest.approx(expected, rel=1e-14)


@pytest.mark.parametrize("color", COLORS)
def test_colors_differ_in_the_images_of_key_and_door_alone(keys, color):
    task, grey = keys[color], keys["grey"]
    for name in ARRAYS:
        if name not in ("images", "observation", "signature"):
            assert np.array_equal(getattr(task, name), getattr(grey, name)), name
    seen, expected = task.images[task.observation], grey.images[grey.observation]
    colored = np.isin(expected[..., 0], [OBJECT_TO_IDX["key"], OBJECT_TO_IDX["door"]])
    assert colored.any() and not colored.all()
    expected[..., 1][colored] = COLOR_TO_IDX[color]
    assert np.array_equal(seen, expected)


def test_layouts_are_drawn_as_often_as_the_table_says(index_of, keys):
    env, counts = ColoredKeysEnv(), np.zeros(520)
    env.reset(seed=0)
    for _ in range(4800):
        env.reset()
        counts[index_of[describe(env)]] += 1
    starts = keys["grey"].start > 0
    assert counts[~starts].sum() == 0
    expected = 4800 * keys["grey"].start[starts]
    assert scipy.stats.chisquare(counts[starts], expected).pvalue > 1e-4


def test_state_of_another_task_is_refused(keys):
    env = ColoredKeysEnv(color="red")
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"^env = <.*: is in no state of this table$"):
        state_of(keys["green"], env)


@pytest.mark.parametrize("colors", [("grey",), ("red", "green"), ("yellow", "blue", "purple")])
def test_lockstep_with_minigrid(explored, index_of, keys, colors):
    """Thousands of steps, some of them towards the goal, through many ends of both kinds."""
    seed_of = {index_of[layout]: seed for layout, seed in explored.seeds.items()}
    domains = TabularDomains([keys[color] for color in colors])
    generators = [np.random.default_rng(seed) for seed in (0, 1)]
    copies = domains(range(len(colors)), 2, generators)
    best, rng = optimal_policy(keys["grey"])[0], np.random.default_rng(2)
    assert len(domains.next_state) == 520 * len(colors)

    observation = copies.reset()
    assert observation.shape == (2, 2 * len(colors))
    envs = [[ColoredKeysEnv(color=c) for c in np.repeat(colors, 2)] for _ in generators]
    places = [(r, n) for r in range(2) for n in range(2 * len(colors))]
    seen = {}
    for r, n in places:
        seen[r, n] = envs[r][n].reset(seed=seed_of[copies.state[r, n] % 520])[0]["image"]
    num_goals = num_timeouts = 0
    for _ in range(800):
        actions = rng.integers(0, NUM_ACTIONS, size=observation.shape)
        hint = best[copies.step_count, copies.state % 520]
        actions = np.where(rng.random(actions.shape) < 0.1, hint, actions)
        step = copies.step(torch.tensor(actions))
        for r, n in places:
            assert np.array_equal(domains.images[observation[r, n]], seen[r, n])
            obs, reward, terminated, truncated, _ = envs[r][n].step(actions[r, n])
            assert float(step.reward[r, n]) == np.float32(reward)
            assert bool(step.terminated[r, n]) == terminated
            assert bool(step.truncated[r, n]) == (truncated and not terminated)
            if not terminated:  # what is seen at the goal is nobody's business
                assert np.array_equal(domains.images[step.last_observation[r, n]], obs["image"])
            if terminated or truncated:
                assert copies.state[r, n] // 520 == n // 2  # the copy stays in its domain
                obs, _ = envs[r][n].reset(seed=seed_of[copies.state[r, n] % 520])
            seen[r, n] = obs["image"]
            num_goals += terminated
            num_timeouts += truncated
        observation = step.observation
    assert num_goals >= 8 and num_timeouts >= 3


@pytest.mark.parametrize(
    "uniform",
    [
        0.0,
        1e-9,
        0.5,
        1 - 1e-9,
        np.nextafter(1, 0),
    ],
)
def test_any_draw_starts_in_the_domain_of_the_copy(keys, uniform):
    class Fixed(np.random.Generator):
        def random(self, size: int) -> np.ndarray:
            return np.full(size, uniform)

    domains = TabularDomains([keys[color] for color in COLORS])
    copies = domains(range(6), 1, [Fixed(np.random.PCG64())])
    copies.reset()
    assert (copies.state // 520).tolist() == [list(range(6))]
    assert (keys["red"].start[copies.state % 520] > 0).all()


@pytest.mark.parametrize("order", [("red", "green"), ("green", "red"), ("grey", "blue", "red")])
def test_domains_share_one_table_of_images(keys, order):
    domains = TabularDomains([keys[color] for color in order])
    assert len(np.unique(domains.images, axis=0)) == len(domains.images)
    for own, color in zip(domains.observation_of, order, strict=True):
        assert np.array_equal(domains.images[own], keys[color].images)
    seen = np.concatenate([keys[color].images[keys[color].observation] for color in order])
    assert np.array_equal(domains.images[domains.observation], seen)


def test_runs_may_have_domains_of_their_own(keys):
    """Run 0 has two copies in red, run 1 one in each domain; both draw what they would draw."""
    domains = TabularDomains([keys["red"], keys["green"]])

    def starts(chosen: list, *seeds: int) -> np.ndarray:
        generators = [np.random.default_rng(seed) for seed in seeds]
        copies = TabularEnvironments(domains, np.array(chosen), generators)
        copies.reset()
        return copies.state

    together = starts([[0, 0], [0, 1]], 3, 4)
    alone = [starts([0, 0], 3)[0], starts([0, 1], 4)[0]]
    assert np.array_equal(together, alone)
    assert (together >= 520).tolist() == [[False, False], [False, True]]


def test_copies_do_not_depend_on_other_runs(keys):
    domains = TabularDomains([keys["red"], keys["green"]])
    actions = torch.tensor(np.random.default_rng(0).integers(0, 7, size=(300, 3, 4)))

    def play(runs: list[int]) -> Iterator[torch.Tensor]:
        copies = domains([0, 1], 2, [np.random.default_rng(run) for run in runs])
        yield copies.reset()
        for action in actions[:, runs]:
            yield from copies.step(action)

    together = list(play([0, 1, 2]))
    for run in range(3):
        for alone, beside in zip(play([run]), together, strict=True):
            assert torch.equal(alone[0], beside[run])


def test_another_task_of_minigrid():
    """Empty-5x5 from its only start: two cells ahead, a turn, two cells ahead."""
    task = tabulate(gymnasium.make("MiniGrid-Empty-5x5-v0"))
    assert np.count_nonzero(task.start) == 1
    assert len(task.start) == 8 * 4  # every free cell but the goal, in every direction
    assert not task.progress.any()
    assert optimal_policy(task)[1] == pytest.approx(1 - 0.9 * 5 / 100)


# ---------------------------------------------------------------- what cannot be a table


class Drifting(ColoredKeysEnv):
    """Turns by itself now and then."""

    def step(self, action):
        if self.np_random.random() < 0.1:
            self.agent_dir = (self.agent_dir + 1) % 4
        return super().step(action)


class Worn(ColoredKeysEnv):
    """Draws nothing, but no two steps are alike: every third one fails."""

    count = 0

    def step(self, action):
        self.count += 1
        return super().step(6 if self.count % 3 == 0 else action)


class Noisy(ColoredKeysEnv):
    """The reward alone differs when a step is repeated."""

    rng = np.random.default_rng(0)

    def step(self, action):
        observation, reward, *rest = super().step(action)
        return observation, reward + self.rng.random(), *rest


RANDOM = {
    "draws from its generator": Drifting,
    "hidden counter": Worn,
    "random reward": Noisy,
    "moving obstacles": lambda: DynamicObstaclesEnv(size=5, n_obstacles=1),
}


@pytest.mark.parametrize("make", RANDOM.values(), ids=RANDOM.keys())
def test_random_steps_are_refused(make):
    with pytest.raises(NotTabularError, match=r"^env = <.*: must be deterministic, but action \d"):
        tabulate(make())


def test_environment_that_is_not_of_minigrid_is_refused():
    env = gymnasium.make("CartPole-v1")
    assert isinstance(env.action_space, Discrete)
    with pytest.raises(NotTabularError, match=r"^env = <CartPole.*: must be a MiniGridEnv$"):
        tabulate(env)


@pytest.mark.parametrize("max_states", [1, 47, 519])
def test_too_many_states_are_refused(max_states):
    message = rf"^max_states = {max_states}: the task has more states$"
    with pytest.raises(NotTabularError, match=message):
        tabulate(ColoredKeysEnv(), max_states)


def test_tabulation_leaves_the_environment_as_it_was(keys):
    env, fresh = ColoredKeysEnv(), ColoredKeysEnv()
    assert_same(tabulate(env, max_states=520), keys["grey"])  # 520 are not too many
    for seed in range(5):
        seen, expected = (e.reset(seed=seed)[0]["image"] for e in (env, fresh))
        assert np.array_equal(seen, expected)
        for action in (2, 3, 2, 5, 0, 2):
            assert np.array_equal(env.step(action)[0]["image"], fresh.step(action)[0]["image"])


# -------------------------------------------------------------------------------- cache


def assert_same(task: TabularTask, other: TabularTask) -> None:
    for name in ARRAYS:
        left, right = getattr(task, name), getattr(other, name)
        assert left.dtype == right.dtype and np.array_equal(left, right), name


@pytest.fixture
def calls(monkeypatch, keys) -> list:
    """What would have been tabulated; the tables are those made before."""
    asked = []

    def remember(env):
        asked.append((env.width, env.color))
        return keys[env.color]

    monkeypatch.setattr(tabulated, "tabulate", remember)
    return asked


def test_table_is_made_once_and_loaded_afterwards(tmp_path, calls, keys):
    first = load_or_tabulate(ColoredKeysEnv, tmp_path / "new", color="red")
    again = load_or_tabulate(ColoredKeysEnv, tmp_path / "new", color="red")
    assert calls == [(5, "red")]
    assert_same(first, keys["red"])
    assert_same(again, keys["red"])


def test_other_options_or_minigrid_give_another_table(tmp_path, calls, monkeypatch):
    load_or_tabulate(ColoredKeysEnv, tmp_path, color="red")
    load_or_tabulate(ColoredKeysEnv, tmp_path, color="blue")
    load_or_tabulate(ColoredKeysEnv, tmp_path, color="blue", size=5)
    monkeypatch.setattr(tabulated, "version", lambda package: "3.2.99")
    load_or_tabulate(ColoredKeysEnv, tmp_path, color="red")
    assert len(calls) == 4 and len(list(tmp_path.glob("*.table"))) == 4


def test_table_that_the_environment_contradicts_is_made_again(tmp_path, calls, keys):
    load_or_tabulate(ColoredKeysEnv, tmp_path, color="red")
    (path,) = tmp_path.glob("*.table")
    wrong = replace(keys["red"], goal_reward=keys["red"].goal_reward - 0.1)
    for other in (wrong, keys["blue"]):
        assert not tabulated.agrees(other, ColoredKeysEnv(color="red"))
        write_tensors(path, tensors(**vars(other)), "made_by", "")
        assert_same(load_or_tabulate(ColoredKeysEnv, tmp_path, color="red"), keys["red"])
    assert len(calls) == 3


def tensors(**arrays) -> dict[str, torch.Tensor]:
    return {name: torch.from_numpy(array) for name, array in arrays.items()}


DAMAGE = {
    "truncated": lambda path: path.write_bytes(path.read_bytes()[:-9]),
    "changed": lambda path: path.write_bytes(path.read_bytes()[:-9] + b"?" * 9),
    "empty": lambda path: path.write_bytes(b""),
    "without a seal": lambda path: path.write_bytes(read_sealed(path)),
    "other keys": lambda path: write_tensors(path, tensors(images=np.zeros(3)), "made_by", ""),
}


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE.keys())
def test_damaged_table_is_named_and_made_again(tmp_path, calls, keys, damage):
    load_or_tabulate(ColoredKeysEnv, tmp_path, color="red")
    (path,) = tmp_path.glob("*.table")
    damage(path)
    with pytest.warns(TableWarning, match=rf"{path}: is made anew: "):
        assert_same(load_or_tabulate(ColoredKeysEnv, tmp_path, color="red"), keys["red"])
    assert_same(load_or_tabulate(ColoredKeysEnv, tmp_path, color="red"), keys["red"])
    assert len(calls) == 2


def test_table_that_cannot_be_kept_is_made_each_time(tmp_path, calls, keys, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    (tmp_path / "file").write_text("not a folder")
    monkeypatch.setattr(os, "fsync", full)
    for folder in (tmp_path / "file" / "tables", tmp_path / "full"):
        with pytest.warns(TableWarning, match=rf"{folder}.*: cannot be written \(N"):
            assert_same(load_or_tabulate(ColoredKeysEnv, folder, color="red"), keys["red"])
    assert len(calls) == 2
    assert [path.suffix for path in (tmp_path / "full").iterdir()] in ([], [".lock"])


# ------------------------------------------------------------------------ exact returns

NUM_POLICIES = 3


def random_task(seed: int, num_states: int, num_actions: int, horizon: int) -> TabularTask:
    rng = np.random.default_rng(seed)
    shape = num_states, num_actions
    goal = rng.random(shape) < 0.2
    return TabularTask(
        next_state=rng.integers(0, num_states, size=shape),
        goal=goal,
        done=goal | (rng.random(shape) < 0.1),
        goal_reward=rng.random(horizon),
        start=rng.dirichlet(np.ones(num_states)),
        observation=rng.integers(0, 2, size=num_states),
        images=np.zeros((2, 1, 1, 1)),
        progress=np.zeros(num_states, dtype=int),
        position=np.zeros((num_states, 2), dtype=int),
        signature=np.arange(num_states, dtype=np.uint64),
    )


def random_policy(task: TabularTask, seed: int, sharpness: float = 1.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    shape = NUM_POLICIES, len(task.images), task.next_state.shape[1]
    return torch.tensor(sharpness * rng.standard_normal(shape)).softmax(-1).numpy()


tasks = st.builds(
    random_task,
    seed=st.integers(0, 10_000),
    num_states=st.integers(1, 4),
    num_actions=st.integers(1, 3),
    horizon=st.integers(1, 4),
)


def slow_outcomes(task: TabularTask, policy: np.ndarray) -> np.ndarray:
    """Return and success probability of one policy ``[K, A]``: the sum over all episodes."""

    def ahead(state: int, t: int) -> np.ndarray:
        if t == task.horizon:
            return np.zeros(2)
        total = np.zeros(2)
        for action, probability in enumerate(policy[task.observation[state]]):
            if task.goal[state, action]:
                total += probability * np.array([task.goal_reward[t], 1])
            elif not task.done[state, action]:
                total += probability * ahead(task.next_state[state, action], t + 1)
        return total

    return sum(p * ahead(state, 0) for state, p in enumerate(task.start))


def slow_reach(task: TabularTask, policy: np.ndarray, states: np.ndarray) -> float:
    """Probability that an episode ever visits ``states``: the sum over all episodes."""

    def ahead(state: int, t: int) -> float:
        if states[state]:
            return 1
        if t == task.horizon:
            return 0
        return sum(
            probability * ahead(task.next_state[state, action], t + 1)
            for action, probability in enumerate(policy[task.observation[state]])
            if not task.done[state, action]
        )

    return sum(p * ahead(state, 0) for state, p in enumerate(task.start))


@given(tasks, st.integers(0, 100))
def test_return_is_the_sum_over_all_episodes(task, seed):
    policy = random_policy(task, seed)
    returns, success = expected_return(task, policy)
    slow = np.stack([slow_outcomes(task, each) for each in policy])
    assert np.stack([returns, success], axis=1) == pytest.approx(slow, rel=1e-12)


@given(tasks, st.integers(0, 100))
def test_reach_is_the_sum_over_all_episodes(task, seed):
    policy = random_policy(task, seed)
    states = np.random.default_rng(seed).random(len(task.start)) < 0.4
    slow = [slow_reach(task, each, states) for each in policy]
    assert reach(task, policy, states) == pytest.approx(slow, rel=1e-12)


def slow_occupancy(task: TabularTask, policy: np.ndarray) -> np.ndarray:
    """Expected number of steps in each state: the sum over all episodes."""
    steps = np.zeros(len(task.start))

    def ahead(state: int, t: int, probability: float) -> None:
        if t == task.horizon:
            return
        steps[state] += probability
        for action, share in enumerate(policy[task.observation[state]]):
            if not task.done[state, action]:
                ahead(task.next_state[state, action], t + 1, probability * share)

    for state, probability in enumerate(task.start):
        ahead(state, 0, probability)
    return steps


@given(tasks, st.integers(0, 100))
def test_occupancy_is_the_sum_over_all_episodes(task, seed):
    policy = random_policy(task, seed)
    slow = np.stack([slow_occupancy(task, each) for each in policy])
    assert occupancy(task, policy) == pytest.approx(slow, rel=1e-12)


@given(tasks)
def test_optimal_policy_is_the_best_of_all_action_sequences(task):
    def best(state: int, t: int) -> float:
        if t == task.horizon:
            return 0
        return max(
            task.goal_reward[t]
            if task.goal[state, action]
            else 0
            if task.done[state, action]
            else best(task.next_state[state, action], t + 1)
            for action in range(task.next_state.shape[1])
        )

    actions, value = optimal_policy(task)
    expected = [best(state, 0) for state in range(len(task.start))]
    assert value == pytest.approx(task.start @ expected, rel=1e-12)
    assert [follow_actions(task, actions, s) for s in range(len(expected))] == pytest.approx(
        expected, rel=1e-12
    )


def follow_actions(task: TabularTask, actions: np.ndarray, state: int) -> float:
    """The return of one deterministic episode."""
    for t in range(task.horizon):
        action = actions[t, state]
        if task.done[state, action]:
            return task.goal_reward[t] * task.goal[state, action]
        state = task.next_state[state, action]
    return 0


def noisy_optimal(task: TabularTask, noise: float) -> np.ndarray:
    """Mostly the action that is best most often where the agent sees this: ``[1, K, A]``."""
    votes = np.zeros((len(task.images), NUM_ACTIONS))
    np.add.at(votes, (task.observation, optimal_policy(task)[0][0]), 1)
    return ((1 - noise) * np.eye(NUM_ACTIONS)[votes.argmax(1)] + noise / NUM_ACTIONS)[None]


@pytest.mark.parametrize("noise", [0.4, 0.8])
def test_exact_return_and_reach_are_the_mean_over_episodes(keys, noise):
    """Episodes of sampled actions in ten thousand copies, the first one of each."""
    task, num_copies = keys["grey"], 10_000
    policy = noisy_optimal(task, noise)
    domains, rng = TabularDomains([task]), np.random.default_rng(0)
    own = domains.observation_of[0].argsort()
    below = policy[0, own].cumsum(1)[:, :-1]  # by the numbers of the pooled table
    copies = domains([0], num_copies, [rng])
    observation = copies.reset()[0].numpy()
    returns, success, unlocked = (np.zeros(num_copies) for _ in range(3))
    running = np.ones(num_copies, dtype=bool)
    for _ in range(task.horizon):
        unlocked[running & (task.progress[copies.state[0]] == 2)] = 1
        action = (rng.random((num_copies, 1)) > below[observation]).sum(1)
        step = copies.step(torch.tensor(action[None]))
        returns += running * step.reward[0].numpy()
        success += running * step.terminated[0].numpy()
        running &= ~(step.terminated | step.truncated)[0].numpy()
        observation = step.observation[0].numpy()
    assert not running.any()
    exact = *expected_return(task, policy), reach(task, policy, task.progress == 2)
    for sampled, value in zip((returns, success, unlocked), exact, strict=True):
        # Four standard errors: one seed in 16,000 would fail by chance, and this one is fixed.
        error = sampled.std() / num_copies**0.5
        assert 0 < 4 * error < 0.1 * value[0]
        assert abs(sampled.mean() - value[0]) < 4 * error


@pytest.mark.parametrize("color", COLORS)
def test_known_returns_of_the_coloured_keys(keys, color):
    task = keys[color]
    uniform = np.full((1, len(task.images), NUM_ACTIONS), 1 / NUM_ACTIONS)
    returns, _ = expected_return(task, uniform)
    assert returns[0] == pytest.approx(0.0338, abs=5e-5)
    actions, value = optimal_policy(task)
    assert value == pytest.approx(0.9646, abs=5e-6)
    episodes = [follow_actions(task, actions, s) for s in np.flatnonzero(task.start)]
    assert np.mean(episodes) == pytest.approx(value, rel=1e-12)
    steps = (1 - value) / 0.9 * 250
    assert steps == pytest.approx(9.83, abs=0.005)


def test_subtasks_come_in_their_order(keys):
    task = keys["red"]
    policy = random_policy(task, 0)
    key, door = (reach(task, policy, task.progress >= step) for step in (1, 2))
    success = expected_return(task, policy)[1]
    assert (key < 1).all() and (key > door).all() and (door > success).all()
    assert (success > 0).all()
    assert reach(task, policy, np.ones(520, dtype=bool)) == pytest.approx(1)
    assert (reach(task, policy, np.zeros(520, dtype=bool)) == 0).all()


def test_policies_are_evaluated_each_for_itself(keys):
    policies = random_policy(keys["blue"], 1)
    together = np.stack(expected_return(keys["blue"], policies), axis=1)
    alone = [np.concatenate(expected_return(keys["blue"], policy[None])) for policy in policies]
    assert together == pytest.approx(np.stack(alone), rel=1e-12)
