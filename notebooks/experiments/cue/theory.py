"""What the votes of domains predict about the cued maze, before any network is trained.

At the junction two things can be seen: landmark and cue agree, or they do not. With m the strength
of the landmark, c_d that of the cue in domain d, and A and B the probabilities of going where the
*landmark* points if they agree and if they do not,

    R_d = 1/2 + 1/2 [(m + c_d) (A - 1/2) + (m - c_d) (B - 1/2)],      m = 2 P(landmark is right) - 1

A policy with a weight for each sign has A = s(a + b) and B = s(a - b), s the logistic function. If
A tends to 1, it follows the landmark where B > 1/2 and the cue where B < 1/2.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd
from torch import Tensor

from ipo.game import Cost
from ipo.worlds.cued_maze import LANDMARK

STRENGTH = 2 * LANDMARK - 1  # m
LANDMARK_WINS, CUE_WINS, NEITHER = FOLLOWS = ("landmark", "cue", "neither")
PENALTIES = (10, 100)  # of V-REx
SPREAD = 0.02  # between returns of training domains that V-REx takes for equal

STRONGER = (0.1, 0.3, 0.5, 0.7, 0.9)
COARSE = (0.1, 0.6, 0.9)
GROUPS = {2: (1, 1), 3: (2, 1), 4: (3, 1)}  # domains with the first and with the second cue

Cues = tuple[float, ...]


def points(num_domains: int, values: Sequence[float]) -> list[Cues]:
    """Cues of the training domains at all points of a phase diagram.

    Cues may be renamed, so the first one is positive. With two domains it is the stronger; with
    more, that of the majority.
    """
    others = [*(-v for v in reversed(values)), *values]
    first, second = GROUPS[num_domains]
    return [
        (c,) * first + (other,) * second
        for c, other in itertools.product(values, others)
        if num_domains > 2 or abs(other) <= c
    ]


def disputed(values: Sequence[float]) -> list[Cues]:
    """Points where each of two domains prefers its cue to the landmark, with opposite signs."""
    return [c for c in points(2, values) if c[0] > STRENGTH and c[1] < -STRENGTH]


def contested(num_domains: int, values: Sequence[float]) -> list[Cues]:
    """Points at which pooled training and the game are predicted to follow different signs."""
    return [cues for cues in points(num_domains, values) if pooled(cues) != game(cues)]


# -------------------------------------------------------------------------------- the rules


def pooled(cues: Sequence[float]) -> str:
    """One player that owns all domains: the mean of the cues decides."""
    return CUE_WINS if np.mean(cues) > STRENGTH else LANDMARK_WINS


def game(cues: Sequence[float]) -> str:
    """A player for each domain, wide bounds: the majority; if there is none, the product decides.

    The proof is in the chapter.
    """
    for_cue = sum(c > STRENGTH for c in cues)
    if 2 * for_cue == len(cues):
        return CUE_WINS if min(cues) * max(cues) > STRENGTH**2 else LANDMARK_WINS
    return CUE_WINS if 2 * for_cue > len(cues) else LANDMARK_WINS


def cue_use(cues: Sequence[float], penalty: float) -> float:
    """A - B at the optimum of V-REx with A = 1, from mean and variance V of the cues.

    maximise 1/2 (c - m) (1 - B) - penalty V (1 - B)^2 / 4:     1 - B = (c - m) / (penalty V)
    """
    excess, weight = np.mean(cues) - STRENGTH, penalty * np.var(cues)
    if excess <= 0:
        return 0.0
    return float(min(1.0, excess / weight)) if weight > 0 else 1.0


def vrex(cues: Sequence[float]) -> str:
    """With the penalty that training domains choose; see :func:`chosen_penalty`."""
    spreads = {p: spread(cues, cue_use(cues, p)) for p in PENALTIES}
    return CUE_WINS if cue_use(cues, chosen_penalty(spreads)) > 0.5 else LANDMARK_WINS


def spread(cues: Sequence[float], use: float) -> float:
    """Largest difference between the returns of training domains: half that of cues, times use."""
    return 0.5 * (max(cues) - min(cues)) * abs(use)


def chosen_penalty(spreads: dict[int, float]) -> int:
    """The smallest penalty that makes training domains alike; the largest if none does."""
    return next((p for p in sorted(spreads) if spreads[p] < SPREAD), max(spreads))


RULES: dict[str, Callable[[Sequence[float]], str]] = {
    "ppo": pooled,
    "in_turn": pooled,  # one Adam adds up what single domains say
    "ensemble": pooled,
    "ipo": game,
    "vrex": vrex,
}


def predicted(encoding: str, cues: str, method: str) -> str:
    """What a method follows.

    Where observations have no signs in common (``one_hot``), each has a vote of its own. At
    disputed points two opposite wishes meet at both observations, and players learn nothing.
    """
    if encoding == "one_hot" and method == "ipo":
        return NEITHER
    return RULES[method]([float(c) for c in cues.split()])


def predictions() -> pd.DataFrame:
    """Of each method at every point, as they were committed before any was trained there."""
    grids = {2: STRONGER, 3: COARSE, 4: COARSE}
    diagrams = [("signs", points(n, grid), RULES) for n, grid in grids.items()]
    control = ("one_hot", disputed(STRONGER), ("ppo", "ipo"))
    lines = [
        (encoding, text(cues), method, predicted(encoding, text(cues), method))
        for encoding, where, methods in (*diagrams, control)
        for cues, method in itertools.product(where, methods)
    ]
    return pd.DataFrame(lines, columns=["encoding", "cues", "method", "follows"])


def text(cues: Sequence[float]) -> str:
    """As in the rows: ``0.9 -0.3``."""
    return " ".join(f"{c:g}" for c in cues)


# ------------------------------------------------------------------- the game, to be played


def cost(cue: Tensor) -> Cost:
    """``- R_d`` of the policies with two weights ``[R, 2]`` in the domain of ``cue [R]``."""

    def negative_return(w: Tensor) -> Tensor:
        a, b = w.unbind(-1)
        agree, differ = (a + b).sigmoid() - 0.5, (a - b).sigmoid() - 0.5
        return -0.5 - 0.5 * ((STRENGTH + cue) * agree + (STRENGTH - cue) * differ)

    return negative_return
