"""The game between small ReLU networks, whose best responses can be found exactly.

A player is a network with one hidden layer of ``width`` ReLU units. Observations are a few numbers,
so that networks are vectors of outputs ``[n]``, and those of one architecture are the sums of some
units of a dictionary: the best response is the best of all projections on so many of them.

    no_bias     observations -1 and 1; units relu(x) and relu(-x)
    biases      six observations; units that switch at one of them, and a bias of the output

The policy that is wanted, the same in all domains, needs a single unit. Domains differ in how often
they show each observation; all of them show all.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, NamedTuple

import numpy as np
import pandas as pd

from experiments.experiment import Experiment, with_fewer
from experiments.rows import tidy
from ipo.checks import Count, Positive, checked, one_of

FAMILIES = ("no_bias", "biases")
NUM_DOMAINS = 2
NUM_OBSERVATIONS = 6
ROUNDING = 1e-12  # gains that are none
SETTLED, OPTIMAL = 1e-9, 0.01  # gaps and costs, relative to those of doing nothing
NAMES = {"no_bias": "no biases", "biases": "biases"}


@checked
@dataclass(frozen=True)
class Cell:
    """Games between networks of one architecture.

    Attributes:
        family: of units; one of ``FAMILIES``.
        width: hidden units of a player.
        scale: standard deviation of the players' first output weights; those of the wanted policy
            have 1.
        num_rounds: of best responses in turn, at most.
    """

    family: Annotated[str, one_of(FAMILIES)]
    width: Count
    scale: Positive
    num_rounds: Count = 200

    @property
    def columns(self) -> dict[str, Any]:
        return {"method": self.family, "width": self.width, "scale": self.scale}


def relu_cells(scales: Sequence[float] = (1.0, 10.0)) -> list[Cell]:
    """All widths up to the first whose networks can be any function of the observations."""
    widths = {"no_bias": (1, 2), "biases": range(1, NUM_OBSERVATIONS)}
    return [
        Cell(family, width, scale)
        for family, own in widths.items()
        for width in own
        for scale in scales
    ]


class Problem(NamedTuple):
    """What is seen, how often, and what is wanted there.

    Attributes:
        shares: of the observations in each domain, ``[E, n]``.
        networks: a basis ``[S, n, B]`` of the outputs of each choice of units.
        wanted: ``[n]``.
    """

    shares: np.ndarray
    networks: np.ndarray
    wanted: np.ndarray


def problem(family: str, width: int, rng: np.random.Generator) -> Problem:
    """Random observations, shares and a wanted policy with one unit."""
    if family == "no_bias":
        x, constant = np.array([-1.0, 1.0]), np.zeros((2, 0))
        units = relu(np.stack([x, -x], 1))
    else:
        x = np.sort(rng.uniform(-1, 1, NUM_OBSERVATIONS))
        constant = np.ones((NUM_OBSERVATIONS, 1))
        units = np.concatenate([relu(x[:, None] - x[:-1]), relu(x[1:] - x[:, None])], 1)
    choices = itertools.combinations(range(units.shape[1]), width)
    networks = [np.concatenate([constant, units[:, own]], 1) for own in choices]
    one = np.concatenate([constant, units[:, [rng.integers(units.shape[1])]]], 1)
    shares = rng.dirichlet(np.ones(len(x)), NUM_DOMAINS)
    return Problem(shares, np.stack(networks), one @ rng.standard_normal(one.shape[1]))


def relu(x: np.ndarray) -> np.ndarray:
    return np.maximum(x, 0)


class Game:
    """Players whose outputs ``[E, n]`` are those of networks; each pays for the average's errors.

    J_d = sum_o shares_d(o) (average(o) - wanted(o))^2
    """

    def __init__(self, own: Problem, players: np.ndarray) -> None:
        self.shares, self.wanted, self.players = own.shares, own.wanted, players.copy()
        # The nearest outputs of each choice of units in each domain, as maps [E, S, n, n].
        roots = np.sqrt(own.shares)[:, None]  # [E, 1, n]
        inverses = np.linalg.pinv(roots[..., None] * own.networks)
        self.nearest = own.networks @ inverses * roots[..., None, :]

    def cost(self, d: int) -> float:
        return float((self.players.mean(0) - self.wanted) ** 2 @ self.shares[d])

    def response(self, d: int) -> tuple[float, np.ndarray]:
        """How much player d can gain alone, and the outputs ``[n]`` by which it does."""
        num_players = len(self.players)
        target = num_players * self.wanted - (self.players.sum(0) - self.players[d])
        each = self.nearest[d] @ target  # [S, n]
        costs = (each - target) ** 2 @ self.shares[d] / num_players**2
        return self.cost(d) - costs.min(), each[costs.argmin()]

    def play(self, num_rounds: int) -> None:
        """Best responses in turn, until nobody gains."""
        for _ in range(num_rounds):
            at_rest = True
            for d in range(len(self.players)):
                gain, response = self.response(d)
                if gain > ROUNDING:
                    self.players[d], at_rest = response, False
            if at_rest:
                return


def run_relu(cell: Cell, seeds: list[int]) -> pd.DataFrame:
    """A random game for each seed.

    ``gap`` is the Nash gap, ``cost`` that of the average where it is highest; both relative to what
    outputs of zero cost in the domain.
    """
    values = np.array([_end(cell, np.random.default_rng(seed)) for seed in seeds])
    return tidy(
        cell, seeds, dict(zip([("train", "gap"), ("train", "cost")], values.T, strict=True))
    )


def _end(cell: Cell, rng: np.random.Generator) -> tuple[float, float]:
    own = problem(cell.family, cell.width, rng)
    networks = own.networks[rng.integers(len(own.networks), size=NUM_DOMAINS)]
    weights = cell.scale * rng.standard_normal((NUM_DOMAINS, networks.shape[-1]))
    game = Game(own, (networks @ weights[..., None])[..., 0])
    game.play(cell.num_rounds)
    zero = own.shares @ own.wanted**2
    gaps = [game.response(d)[0] / zero[d] for d in range(NUM_DOMAINS)]
    return max(gaps), max(game.cost(d) / zero[d] for d in range(NUM_DOMAINS))


def ends(rows: pd.DataFrame) -> pd.DataFrame:
    """How games end, a row for each: at ``rest``, so that nobody gains, and with an ``optimal``
    average."""
    keys = ["method", "width", "scale", "run"]
    wide = rows.pivot_table("value", keys, "metric", observed=True).reset_index()
    return wide.assign(rest=wide["gap"] <= SETTLED, optimal=wide["cost"] <= OPTIMAL)


def table(rows: pd.DataFrame) -> pd.DataFrame:
    """Shares of the games that end in each way, by architecture and start."""
    found = ends(rows)
    kinds = {
        "an equilibrium, optimal": found["rest"] & found["optimal"],
        "an equilibrium, not optimal": found["rest"] & ~found["optimal"],
        "none reached": ~found["rest"],
    }
    by = [
        found["method"].map(NAMES).rename("units"),
        found["width"],
        found["scale"].rename("start"),
    ]
    return pd.DataFrame(kinds).groupby(by, sort=False).mean().reset_index()


def short(cell: Cell) -> Cell:
    """Ten rounds."""
    return replace(cell, num_rounds=10)


def near_the_end(cell: Cell) -> list[Cell]:
    """At moments of the last fiftieth of the rounds."""
    return with_fewer(cell, "num_rounds")


EXPERIMENT = Experiment(run_relu, Cell, short, tuple(range(5)), near_the_end=near_the_end)
