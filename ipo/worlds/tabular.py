"""Finite deterministic tasks as tables: fast rollouts, and returns without sampling error.

``minigrid_tables`` makes tables of MiniGrid's tasks, and ``cued_maze`` is one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from torch import Tensor

from ipo.checks import Count, Natural, check_count, checked
from ipo.distributions import Generators
from ipo.rollouts import Step


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
        signature: ``[S]``, by which a state of MiniGrid is found; see ``minigrid_tables.state_of``.
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
