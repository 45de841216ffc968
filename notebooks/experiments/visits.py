"""Where policies of a tabulated task go: the states that they reach, and their steps in each."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import numpy as np

from ipo.checks import checked
from ipo.worlds.tabular import Policies, TabularTask, expected_return


@checked
def reach(task: TabularTask, policy: Policies, states: Annotated[np.ndarray, "S"]) -> np.ndarray:
    """Probability ``[P]`` that policies ``[P, K, A]`` ever come to one of ``states [S]``.

    Within the horizon; ``states`` are true where the search ends.
    """
    entered = states[task.next_state] & ~task.done
    goal = replace(
        task, goal=entered, done=task.done | entered, start=np.where(states, 0.0, task.start)
    )
    return expected_return(goal, policy)[1] + float(task.start @ states)


@checked
def occupancy(task: TabularTask, policy: Policies) -> np.ndarray:
    """Expected number of steps ``[P, S]`` that policies ``[P, K, A]`` spend in each state.

    mu_(t+1)(s') = sum_(s, a) mu_t(s) pi(a | s) 1{not done},    summed over t < T
    """
    goes_on = policy[:, task.observation] * ~task.done  # [P, S, A]
    present = np.tile(task.start, (len(policy), 1))
    total = np.zeros_like(present)
    for _ in range(task.horizon):
        total += present
        later = np.zeros_like(present)
        for action, next_state in enumerate(task.next_state.T):
            np.add.at(later.T, next_state, (present * goes_on[..., action]).T)
        present = later
    return total
