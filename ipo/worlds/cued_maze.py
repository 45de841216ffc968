"""A T-maze with two signs at its junction's wall: the smallest task in which domains can disagree.

The agent walks down a corridor and turns left or right; behind one of the two is the reward. All
the way it sees two signs. The *landmark* points to the reward with the same probability in every
domain. The *cue* does so with one that depends on the domain, and may as well point away from it.
"""

from __future__ import annotations

import itertools
from functools import partial
from typing import Annotated

import numpy as np

from ipo.checks import Count, check_number, checked
from ipo.worlds.tabular import TabularTask

FORWARD, LEFT, RIGHT = range(3)  # actions
LANDMARK = 0.625  # probability that the landmark points to the reward

Cue = Annotated[float, partial(check_number, least=-1, most=1)]
Landmark = Annotated[float, partial(check_number, least=0, most=1)]


@checked
def cued_maze(
    cue: Cue, landmark: Landmark = LANDMARK, corridor: Count = 1, horizon: Count = 10
) -> TabularTask:
    """The maze of a domain: its states, and what is seen in them.

    ::

        P(reward is right) = 1/2,    P(landmark = side) = landmark,    P(cue = side) = (1 + cue) / 2

    A state is ``(side, landmark, cue, place)``, the first three -1 for left or 1 for right; the
    signs are drawn independently, given the side of the reward. Walking against a wall changes
    nothing. The reward is 1 however long it takes, so the return is the probability of a right turn
    within the horizon.

    Args:
        cue: strength and sign of the cue, the correlation between it and the side of the reward.
        landmark: probability that the landmark points to the reward.
        corridor: steps from the start to the junction.
        horizon: steps until the episode ends without a reward.

    Returns:
        a task whose ``images [8, 3]`` are what is seen: landmark, cue, and 1 at the junction.

    Raises:
        ValueError: a cue outside [-1, 1], a landmark outside [0, 1], no corridor or horizon.
    """
    signs = (-1, 1)
    states = list(itertools.product(signs, signs, signs, range(corridor + 1)))
    number = {state: i for i, state in enumerate(states)}
    seen = list(itertools.product(signs, signs, (0, 1)))
    next_state = np.repeat(np.arange(len(states))[:, None], 3, axis=1)
    goal, done = np.zeros((2, len(states), 3), dtype=bool)
    start = np.zeros(len(states))
    observation = np.zeros(len(states), dtype=np.int32)
    for i, (side, mark, sign, place) in enumerate(states):
        at_junction = place == corridor
        observation[i] = seen.index((mark, sign, int(at_junction)))
        if at_junction:
            done[i, [LEFT, RIGHT]] = True
            goal[i, RIGHT if side == 1 else LEFT] = True
        else:
            next_state[i, FORWARD] = number[side, mark, sign, place + 1]
        if place == 0:
            by_mark = landmark if mark == side else 1 - landmark
            start[i] = 0.5 * by_mark * (1 + cue * sign * side) / 2
    places = np.array([state[-1] for state in states])
    return TabularTask(
        next_state=next_state.astype(np.int32),
        goal=goal,
        done=done,
        goal_reward=np.ones(horizon),
        start=start,
        observation=observation,
        images=np.array(seen, dtype=np.int8),
        progress=places,
        position=np.stack([np.zeros_like(places), places], axis=1),
        signature=np.arange(len(states), dtype=np.uint64),
    )
