"""Tables of tasks, kept in files; one that is damaged, or not of its environment, is made anew."""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Callable
from dataclasses import fields
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch
from filelock import FileLock
from gymnasium import Env

from experiments.sealed import DamagedError
from experiments.tensors import read_tensors, write_tensors
from ipo.worlds.minigrid_tables import goal_reward, state_of, tabulate
from ipo.worlds.tabular import TabularTask

FORM = "tensors"  # of the files; those of another one are not looked at
NUM_STEPS = 200  # of random episodes in which a table and its environment are compared


class TableWarning(UserWarning):
    """A table that cannot be used, or not be kept; it is made anew."""


def load_or_tabulate(make_env: Callable[..., Env], folder: str | Path, **options) -> TabularTask:
    """:func:`ipo.worlds.minigrid_tables.tabulate` ``make_env(**options)``, or the same from a file.

    Where the folder cannot be written, the table is made each time, with a warning.
    """
    made_by = f"{make_env.__module__}.{make_env.__qualname__}"
    key = json.dumps([made_by, options, version("minigrid"), FORM], sort_keys=True)
    path = Path(folder) / f"{hashlib.sha256(key.encode()).hexdigest()[:16]}.table"
    env = make_env(**options)
    task = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(path.with_suffix(".lock")):  # others that want the same table wait for it
            task = _kept(path, env)
            if task is None:
                task = tabulate(env)
                tensors = {name: torch.from_numpy(array) for name, array in vars(task).items()}
                write_tensors(path, tensors, "made_by", made_by)
    except OSError as error:  # a checkout that is read-only, or a full disk
        kept = _kept(path, env)
        if kept is None:
            warnings.warn(f"{path}: cannot be written ({error.strerror})", TableWarning, 2)
        task = kept or task or tabulate(env)
    return task


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


def _kept(path: Path, env: Env) -> TabularTask | None:
    """The table in a file, if there is one that can be used."""
    if not path.exists():
        return None
    try:
        tensors, _ = read_tensors(path, "made_by")
        task = TabularTask(**{f.name: tensors[f.name].numpy() for f in fields(TabularTask)})
    except (DamagedError, KeyError) as error:  # KeyError: of code with other fields
        warnings.warn(f"{path}: is made anew: {error}", TableWarning, stacklevel=3)
        return None
    return task if agrees(task, env) else None
