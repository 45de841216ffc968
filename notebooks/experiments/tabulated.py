"""Tables of tasks, kept in files; one that its environment contradicts is made anew."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import fields
from importlib.metadata import version
from pathlib import Path

import numpy as np
from filelock import FileLock
from gymnasium import Env

from ipo.worlds.tabular import TabularTask, goal_reward, state_of, tabulate

NUM_STEPS = 200  # of random episodes in which a table and its environment are compared


def load_or_tabulate(make_env: Callable[..., Env], folder: str | Path, **options) -> TabularTask:
    """:func:`ipo.worlds.tabular.tabulate` ``make_env(**options)``, or the same from a file."""
    made_by = f"{make_env.__module__}.{make_env.__qualname__}"
    key = json.dumps([made_by, options, version("minigrid")], sort_keys=True)
    path = Path(folder) / f"{hashlib.sha256(key.encode()).hexdigest()[:16]}.npz"
    path.parent.mkdir(parents=True, exist_ok=True)
    env = make_env(**options)
    with FileLock(path.with_suffix(".lock")):  # others that want the same table wait for it
        if path.exists() and agrees(task := _load(path), env):
            return task
        partial = path.with_suffix(".partial.npz")
        np.savez_compressed(partial, **vars(tabulate(env)))
        partial.replace(path)
    return _load(path)


def agrees(task: TabularTask, env: Env) -> bool:
    """Whether a table knows what the goal is worth, and what some hundred random steps do."""
    env = env.unwrapped
    if not np.array_equal(task.goal_reward, goal_reward(env)):
        return False
    generator, ended, step = np.random.default_rng(0), True, 0
    for _ in range(NUM_STEPS):
        if ended:
            observation, step = env.reset(seed=int(generator.integers(2**31)))[0], 0
        try:
            state = state_of(task, env)
        except ValueError:
            return False
        if not np.array_equal(task.images[task.observation[state]], observation["image"]):
            return False
        action = int(generator.integers(task.next_state.shape[1]))
        observation, reward, terminated, truncated, _ = env.step(action)
        promised = task.goal[state, action] * task.goal_reward[step]
        if reward != promised or terminated != task.done[state, action]:
            return False
        ended, step = terminated or truncated, step + 1
    return True


def _load(path: Path) -> TabularTask:
    with np.load(path) as arrays:
        return TabularTask(**{field.name: arrays[field.name] for field in fields(TabularTask)})
