"""The cued maze: its returns by hand, and what can be seen in it."""

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.cue.theory import STRENGTH
from ipo.worlds.cued_maze import FORWARD, LANDMARK, LEFT, RIGHT, cued_maze
from ipo.worlds.tabular import expected_return

LEFT_OR_RIGHT = {-1: LEFT, 1: RIGHT}
TURN = 2  # column of what is seen: at the junction
cues = st.floats(-1, 1)


def policy(task, at_junction, in_corridor=(1.0, 0.0, 0.0)):
    """Probabilities ``[1, K, A]``; ``at_junction(landmark, cue)`` are those there."""
    return np.array([[at_junction(*i[:2]) if i[TURN] else in_corridor for i in task.images]])


def choose(side):
    return np.eye(3)[LEFT_OR_RIGHT[side]]


def return_of(task, *given) -> float:
    return expected_return(task, policy(task, *given))[0][0]


@pytest.mark.parametrize(("cue", "expected"), [(-1, 0.0), (0, 0.5), (0.6, 0.8), (1, 1.0)])
def test_following_the_cue(cue, expected):
    assert return_of(cued_maze(cue), lambda mark, cue: choose(cue)) == pytest.approx(expected)


@pytest.mark.parametrize("cue", [-1, -0.3, 0.9])
def test_following_the_landmark_is_worth_the_same_everywhere(cue):
    task = cued_maze(cue)
    assert return_of(task, lambda mark, cue: choose(mark)) == pytest.approx(LANDMARK)


def test_both_signs_by_hand():
    """Left, unless both signs say right: right 3/8 of the time that the reward is there."""
    task = cued_maze(0.5, landmark=0.5)  # the cue is right in 3 of 4 episodes
    found = return_of(task, lambda mark, cue: choose(1 if mark == cue == 1 else -1))
    assert found == pytest.approx(0.5 * (1 - 1 / 8) + 0.5 * 3 / 8)


def test_random_actions_by_counting():
    """Two steps forward and then a turn, within T: a third of actions is forward."""
    in_time, place = 0.0, np.array([1.0, 0.0, 0.0])
    for _ in range(4):
        in_time += place[2] * 2 / 3
        place = np.array(
            [place[0] * 2 / 3, place[0] / 3 + place[1] * 2 / 3, place[1] / 3 + place[2] / 3]
        )
    uniform = np.full(3, 1 / 3)
    task = cued_maze(0.9, corridor=2, horizon=4)
    assert return_of(task, lambda mark, cue: uniform, uniform) == pytest.approx(in_time / 2)


def test_a_corridor_longer_than_the_horizon_has_no_reward():
    task = cued_maze(1.0, corridor=3, horizon=3)
    assert return_of(task, lambda mark, cue: choose(cue)) == 0.0


@given(cues, st.floats(0, 1), st.floats(0, 1))
def test_the_return_of_the_theory(cue, agree, differ):
    """1/2 + 1/2 [(m + c) (A - 1/2) + (m - c) (B - 1/2)]"""
    task = cued_maze(cue)

    def at_junction(mark, sign):
        to_landmark = agree if mark == sign else differ
        return to_landmark * choose(mark) + (1 - to_landmark) * choose(-mark)

    gains = (STRENGTH + cue) * (agree - 0.5) + (STRENGTH - cue) * (differ - 0.5)
    assert return_of(task, at_junction) == pytest.approx(0.5 + 0.5 * gains)


@given(cues, st.integers(0, 1000))
def test_returns_are_linear_in_the_cue(cue, seed):
    """So that returns at both extremes are all there is to know of a policy."""
    probabilities = np.random.default_rng(seed).dirichlet(np.ones(3), (1, 8))
    wrong, right, here = (expected_return(cued_maze(c), probabilities)[0] for c in (-1, 1, cue))
    assert here == pytest.approx((1 - cue) / 2 * wrong + (1 + cue) / 2 * right)


@given(cues, st.floats(0, 1))
def test_starts_are_what_was_promised(cue, landmark):
    task = cued_maze(cue, landmark)
    at_start = task.progress == 0
    assert task.start[at_start].sum() == pytest.approx(1)
    assert not task.start[~at_start].any()
    # An agent that sees a sign and knows the side: by the states' order, side varies slowest.
    sides = np.repeat([-1, 1], len(task.start) // 2)
    mark, sign, _ = task.images[task.observation].T
    assert task.start @ (mark * sides) == pytest.approx(2 * landmark - 1)
    assert task.start @ (sign * sides) == pytest.approx(cue)


def test_what_is_seen_does_not_tell_the_side():
    task = cued_maze(0.3)
    assert task.images.shape == (8, 3)
    half = len(task.observation) // 2
    assert (task.observation[:half] == task.observation[half:]).all()


def test_walls():
    task = cued_maze(0.0)
    in_corridor = task.progress < task.progress.max()
    states = np.arange(len(task.start))
    assert (task.next_state[in_corridor][:, [LEFT, RIGHT]] == states[in_corridor, None]).all()
    assert (task.next_state[~in_corridor, FORWARD] == states[~in_corridor]).all()
    assert not task.done[in_corridor].any() and not task.done[:, FORWARD].any()


def test_the_maze_needs_no_minigrid():
    script = (
        "import sys; sys.modules['minigrid'] = None\n"
        "from ipo.worlds.cued_maze import cued_maze; cued_maze(0.5)"
    )
    subprocess.run([sys.executable, "-c", script], check=True)
