"""Small deterministic MiniGrid tasks as tables.

MiniGrid stays the source of truth: :func:`tabulate` visits every state that can be reached and
writes down what MiniGrid does there. Everything else is look-up in that table.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from gymnasium import Env
from gymnasium.spaces import Discrete
from minigrid.core.world_object import WorldObj
from minigrid.minigrid_env import MiniGridEnv
from tqdm import tqdm

from ipo.checks import Count, checked
from ipo.worlds.tabular import TabularTask


class NotTabularError(ValueError):
    """An environment that a table cannot describe."""


@checked
def tabulate(env: Env, max_states: Count = 100_000) -> TabularTask:
    """Breadth-first search over all states of a MiniGrid task, from every possible start.

    Raises:
        NotTabularError: an environment that is not of MiniGrid, one whose steps draw random
            numbers or give different results when repeated, or one with more than ``max_states``
            states.
    """
    env = _minigrid(env)
    visited = _Visited(env, max_states)
    start: dict[int, float] = {}
    for probability, image in _all_starts(env):
        state = visited.visit(image)
        start[state] = start.get(state, 0.0) + probability
    assert isinstance(env.action_space, Discrete)
    actions = range(env.action_space.n)
    rows: list[list[tuple[int, bool, bool]]] = []
    with tqdm(desc="tabulating", unit="state", leave=False) as bar:
        while len(rows) < len(visited.snapshots):
            rows.append([visited.step(len(rows), action) for action in actions])
            bar.update()
    table = np.array(rows)
    return TabularTask(
        next_state=table[..., 0].astype(np.int32),
        goal=table[..., 1].astype(bool),
        done=table[..., 2].astype(bool),
        goal_reward=goal_reward(env),
        start=np.array([start.get(state, 0.0) for state in range(len(rows))]),
        observation=np.array(visited.observation, dtype=np.int32),
        images=np.stack(visited.images),
        progress=np.array(visited.progress),
        position=np.array(visited.position),
        signature=np.array([_signature(key) for key in visited.index], dtype=np.uint64),
    )


@checked
def goal_reward(env: Env) -> np.ndarray:
    """What MiniGrid gives for reaching the goal in step 1, 2, ... T; ``reset`` must follow."""
    env = _minigrid(env)
    rewards = np.empty(env.max_steps)
    for step in range(env.max_steps):
        env.step_count = step + 1
        rewards[step] = env._reward()
    return rewards


@checked
def state_of(task: TabularTask, env: Env) -> int:
    """The state of the table that a MiniGrid environment is in.

    Raises:
        ValueError: an environment of another task.
    """
    states = np.flatnonzero(task.signature == _signature(_key(_minigrid(env))))
    if len(states) != 1:
        raise ValueError(f"env = {env}: is in no state of this table")
    return int(states[0])


def _minigrid(env: Env) -> MiniGridEnv:
    """The environment without wrappers."""
    if not isinstance(env.unwrapped, MiniGridEnv):
        raise NotTabularError(f"env = {env.unwrapped}: must be a MiniGridEnv")
    return env.unwrapped


class _Visited:
    """States of an environment, numbered in the order in which they were seen first."""

    def __init__(self, env: MiniGridEnv, max_states: int) -> None:
        self.env, self.max_states = env, max_states
        self.index: dict[Any, int] = {}  # from a state's key to its number
        self.snapshots: list[Any] = []
        self.images: list[np.ndarray] = []  # the distinct ones
        self.image_index: dict[bytes, int] = {}
        self.observation: list[int] = []
        self.progress: list[int] = []
        self.position: list[tuple[int, int]] = []

    def visit(self, image: np.ndarray) -> int:
        """The number of the present state, which looks like ``image``."""
        key = _key(self.env)
        if key not in self.index:
            if len(self.index) == self.max_states:
                raise NotTabularError(f"max_states = {self.max_states}: the task has more states")
            self.index[key] = len(self.index)
            self.snapshots.append(_snapshot(self.env))
            seen = self.image_index.setdefault(image.tobytes(), len(self.images))
            if seen == len(self.images):
                self.images.append(image)
            self.observation.append(seen)
            self.progress.append(getattr(self.env, "progress", 0))
            column, row = self.env.agent_pos
            self.position.append((int(column), int(row)))
        return self.index[key]

    def step(self, state: int, action: int) -> tuple[int, bool, bool]:
        """Next state, whether the goal was reached, whether the episode ended."""
        env, outcomes = self.env, []
        for _ in range(2):
            _restore(env, self.snapshots[state])
            env.step_count = 0
            before = env.np_random.bit_generator.state
            observation, reward, terminated, _, _ = env.step(action)
            drew = env.np_random.bit_generator.state != before
            outcomes.append((_key(env), reward, terminated))
        if drew or outcomes[0] != outcomes[1]:
            raise NotTabularError(
                f"env = {env}: must be deterministic, but action {action} has random effects"
            )
        next_state = state if terminated else self.visit(observation["image"])
        return next_state, float(reward) > 0, terminated


class _Choices:
    """Stands in for the generator that MiniGrid draws a layout from, and takes every branch.

    ``integers`` replays a script of choices; what lies beyond its end is choice 0.
    """

    def __init__(self) -> None:
        self.script: list[int] = []
        self.options: list[int] = []

    def integers(self, low: int, high: int) -> int:
        self.options.append(high - low)
        if len(self.script) < len(self.options):
            self.script.append(0)
        return low + self.script[len(self.options) - 1]

    def next_branch(self) -> bool:
        """Go to the next script; false after the last one."""
        while self.script and self.script[-1] + 1 == self.options[len(self.script) - 1]:
            self.script.pop()
        self.options = []
        if self.script:
            self.script[-1] += 1
        return bool(self.script)


def _all_starts(env: MiniGridEnv) -> Iterator[tuple[float, np.ndarray]]:
    """Every layout that ``reset`` can draw: its probability and the first image."""
    choices: Any = _Choices()
    own_generator = env.np_random

    def place(
        obj: WorldObj | None,
        top: tuple[int, int] | None = None,
        size: tuple[int, int] | None = None,
        reject_fn: Callable[[MiniGridEnv, tuple[int, int]], bool] | None = None,
        max_tries: float | None = None,
    ) -> tuple[int, int]:
        """MiniGrid tries cells until one is free; that is a uniform choice of the free ones."""
        left, up = (max(corner, 0) for corner in (top or (0, 0)))
        wide, high = size or (env.grid.width, env.grid.height)
        free = [
            (x, y)
            for x in range(left, min(left + wide, env.grid.width))
            for y in range(up, min(up + high, env.grid.height))
            if env.grid.get(x, y) is None
            and (x, y) != tuple(env.agent_pos)
            and not (reject_fn and reject_fn(env, (x, y)))
        ]
        position = free[choices.integers(0, len(free))]
        if obj is not None:
            env.put_obj(obj, *position)
        return position

    vars(env)["place_obj"] = place  # instead of the method
    try:
        while True:
            env.np_random = choices
            observation, _ = env.reset()
            yield 1 / float(np.prod(choices.options)), observation["image"]
            if not choices.next_branch():
                return
    finally:
        del vars(env)["place_obj"]
        env.np_random = own_generator


def _key(env: MiniGridEnv) -> Any:
    """What tells one state from another; MiniGrid's own hash leaves out what is carried."""
    carried = env.carrying.encode() if env.carrying else None
    pose = tuple(map(int, (*env.agent_pos, env.agent_dir)))
    return pose, carried, env.grid.encode().tobytes()


def _signature(key: Any) -> int:
    """A number for a state that is the same in every process, unlike Python's hash."""
    return int.from_bytes(hashlib.blake2b(repr(key).encode(), digest_size=8).digest())


def _snapshot(env: MiniGridEnv) -> Any:
    things = {id(thing): thing for thing in [*env.grid.grid, env.carrying] if thing is not None}
    contents = [(thing, dict(vars(thing))) for thing in things.values()]
    return env.grid, list(env.grid.grid), contents, env.agent_pos, env.agent_dir, env.carrying


def _restore(env: MiniGridEnv, snapshot: Any) -> None:
    env.grid, cells, contents, env.agent_pos, env.agent_dir, env.carrying = snapshot
    env.grid.grid = list(cells)
    for thing, content in contents:
        vars(thing).update(content)
