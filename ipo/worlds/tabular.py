"""Small deterministic MiniGrid tasks as tables: fast rollouts, and returns without sampling error.

MiniGrid stays the source of truth: :func:`tabulate` visits every state that can be reached and
writes down what MiniGrid does there. Everything else is look-up in that table.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import torch
from gymnasium import Env
from gymnasium.spaces import Discrete
from minigrid.core.world_object import WorldObj
from minigrid.minigrid_env import MiniGridEnv
from torch import Tensor
from tqdm import tqdm

from ipo.checks import Count, Natural, check_count, checked
from ipo.distributions import Generators
from ipo.rollouts import Step


class NotTabularError(ValueError):
    """An environment that a table cannot describe."""


@checked
@dataclass(frozen=True)
class TabularTask:
    """A finite deterministic task: S states, A actions, K distinct observations, horizon T.

    Attributes:
        next_state: ``[S, A]``; where the episode ends, the state itself.
        goal: ``[S, A]``, whether the action ends the episode with a reward.
        done: ``[S, A]``, whether it ends the episode.
        goal_reward: ``[T]``, the reward for reaching the goal in step 1, 2, ... T.
        start: ``[S]``, probabilities of the states in which an episode begins.
        observation: ``[S]``, the index of what the agent sees.
        images: ``[K, height, width, channels]``, the distinct observations.
        progress: ``[S]``, how many of the task's steps are done, as ``env.progress`` counts them;
            zero where the environment does not.
        position: ``[S, 2]``, the agent's column and row.
        signature: ``[S]``, by which :func:`state_of` finds the state that MiniGrid is in.
    """

    next_state: Annotated[np.ndarray, "S A"]
    goal: Annotated[np.ndarray, "S A"]
    done: Annotated[np.ndarray, "S A"]
    goal_reward: Annotated[np.ndarray, "T"]
    start: Annotated[np.ndarray, "S"]
    observation: Annotated[np.ndarray, "S"]
    images: Annotated[np.ndarray, "K ..."]
    progress: Annotated[np.ndarray, "S"]
    position: Annotated[np.ndarray, "S 2"]
    signature: Annotated[np.ndarray, "S"]

    @property
    def horizon(self) -> int:
        return len(self.goal_reward)

    @property
    def sizes(self) -> dict[str, int]:
        S, A = self.next_state.shape
        return {"S": S, "A": A, "K": len(self.images)}


def _check_policy(name: str, policy: np.ndarray) -> None:
    if bool((policy < 0).any()) or not np.allclose(policy.sum(-1), 1, atol=1e-3):
        raise ValueError(f"{name}: must hold probabilities, whose sum over actions is 1")


Policies = Annotated[np.ndarray, "P K A", _check_policy]


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


class TabularDomains:
    """Several tabulated domains of one task as one table, to be trained in.

    Attributes:
        images: the distinct observations of all domains, ``[K, height, width, channels]``.
        observation_of: for each domain, the index in ``images`` of its own observations.
    """

    @checked
    def __init__(self, tasks: Annotated[Sequence[TabularTask], "E"]) -> None:
        for d, task in enumerate(tasks):
            if not np.array_equal(task.goal_reward, tasks[0].goal_reward):
                raise ValueError(f"tasks[{d}]: has other goal rewards, must have those of tasks[0]")
        everything = np.concatenate([task.images for task in tasks])
        self.images, index = np.unique(everything, axis=0, return_inverse=True)
        self.observation_of = np.split(index, np.cumsum([len(task.images) for task in tasks])[:-1])
        first = np.cumsum([0] + [len(task.start) for task in tasks])
        self.next_state = np.concatenate(
            [task.next_state + offset for task, offset in zip(tasks, first, strict=False)]
        )
        self.goal = np.concatenate([task.goal for task in tasks])
        self.done = np.concatenate([task.done for task in tasks])
        seen = [own[t.observation] for own, t in zip(self.observation_of, tasks, strict=True)]
        self.observation = torch.tensor(np.concatenate(seen))
        self.goal_reward = tasks[0].goal_reward
        # Starts of domain d as cumulative probabilities over all states, from d to d + 1.
        self.starts = np.cumsum(np.concatenate([task.start for task in tasks]))
        possible = [np.flatnonzero(task.start) for task in tasks]
        self.first_start = np.array([own[0] + n for own, n in zip(possible, first, strict=False)])
        self.last_start = np.array([own[-1] + n for own, n in zip(possible, first, strict=False)])

    @checked
    def __call__(
        self,
        domains: Annotated[Sequence[Natural], "d"],
        num_copies: Count | Annotated[Sequence[Count], "d"],
        generators: Annotated[Generators, "R"],
    ) -> TabularEnvironments:
        """``num_copies`` of each of ``domains``, or a list of them; one run per generator."""
        check_count("domains", max(domains), 0, len(self.observation_of) - 1)
        return TabularEnvironments(self, np.repeat(domains, num_copies), generators)


class TabularEnvironments:
    """``[R, N]`` copies that begin anew when they end: ``rollouts.Environments``.

    Their ``domains`` are ``[N]``, or ``[R, N]`` where runs have others.
    """

    def __init__(
        self, table: TabularDomains, domains: np.ndarray, generators: Sequence[np.random.Generator]
    ) -> None:
        self.table, self.domains, self.generators = table, domains, generators

    def reset(self) -> Tensor:
        """Begin all episodes; returns indices of observations ``[R, N]``."""
        self.state = self._starts()
        self.step_count = np.zeros_like(self.state)
        return self.table.observation[self.state]

    def step(self, actions: Tensor) -> Step:
        table, action = self.table, actions.numpy()
        goal, done = table.goal[self.state, action], table.done[self.state, action]
        reward = goal * table.goal_reward[self.step_count]
        self.state = table.next_state[self.state, action]
        self.step_count += 1
        truncated = ~done & (self.step_count == len(table.goal_reward))
        last_observation = table.observation[self.state]
        ended = done | truncated
        self.state = np.where(ended, self._starts(), self.state)
        self.step_count[ended] = 0
        return Step(
            table.observation[self.state],
            torch.tensor(reward, dtype=torch.float32),
            torch.tensor(done),
            torch.tensor(truncated),
            last_observation,
        )

    def _starts(self) -> np.ndarray:
        num_copies = self.domains.shape[-1]
        uniform = np.stack([generator.random(num_copies) for generator in self.generators])
        drawn = np.searchsorted(self.table.starts, self.domains + uniform, side="right")
        # The sums are rounded: a draw next to 0 or 1 could lead into the next domain.
        return np.clip(
            drawn, self.table.first_start[self.domains], self.table.last_start[self.domains]
        )


@checked
def expected_return(task: TabularTask, policy: Policies) -> tuple[np.ndarray, np.ndarray]:
    """Expected return and success probability of policies, by dynamic programming.

        V_t(s) = sum_a pi(a | s) [ r_t 1{goal} + 1{not done} V_(t+1)(s') ],    V_T = 0

    Args:
        policy: probabilities ``[P, K, A]``, by observation.

    Returns:
        returns ``[P]`` and success probabilities ``[P]``, over the starts of the task.
    """
    returns, success = values(task, policy)
    return task.start @ returns, task.start @ success


@checked
def values(task: TabularTask, policy: Policies) -> tuple[np.ndarray, np.ndarray]:
    """V_0 of :func:`expected_return` and the probability of success, ``[S, P]`` each."""
    chosen = policy[:, task.observation].transpose(2, 1, 0)  # [A, S, P]
    scores = (chosen * task.goal.T[..., None]).sum(0)
    goes_on = np.tile(chosen * ~task.done.T[..., None], 2)  # for return and success side by side
    value, later = np.zeros_like(goes_on[0]), task.next_state.T
    for reward in task.goal_reward[::-1]:
        now = np.concatenate([reward * scores, scores], axis=1)
        value = now + np.einsum("asp,asp->sp", goes_on, value[later])
    returns, success = np.split(value, 2, axis=1)
    return returns, success


@checked
def optimal_policy(task: TabularTask) -> tuple[np.ndarray, float]:
    """Best action ``[T, S]`` for every step and state, and its expected return.

    Value iteration over the finite horizon. It sees the state, not only the observation.
    """
    value = np.zeros(len(task.start))
    actions = np.empty((task.horizon, len(value)), dtype=int)
    for t in reversed(range(task.horizon)):
        q = task.goal * task.goal_reward[t] + ~task.done * value[task.next_state]
        actions[t], value = q.argmax(1), q.max(1)
    return actions, float(task.start @ value)


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
