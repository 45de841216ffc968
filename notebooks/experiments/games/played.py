"""Small games of the chapter on the algorithm: what is looked at while they are played.

Nothing in them is random but the problems of :func:`run_vote`: a game of which there is one is
run 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from experiments.experiment import Experiment, with_fewer
from experiments.games import scalar_control
from experiments.rows import tidy
from experiments.store import select
from ipo.causality.predictors import PredictorSettings, Regression, irm_objective
from ipo.causality.regressions import correlated_noise, effect_of_target
from ipo.causality.small_games import (
    GameSettings,
    gap,
    last,
    play,
    residual,
    vote,
)
from ipo.checks import check_choice
from ipo.game import Cost, average

REGRESSIONS = {"noise": correlated_noise, "effect": effect_of_target}
PROBLEMS = (*REGRESSIONS, "control")
NUM_RANDOM = 200  # problems of a vote with more than two domains


def _text(numbers: Sequence[float]) -> str:
    return " ".join(f"{number:g}" for number in numbers)


@dataclass(frozen=True)
class Game:
    """The game between the domains of one small problem.

    Attributes:
        problem: ``noise``, ``effect``: regression on a spurious feature that is related to the
            target's noise, or is an effect of the target; ``control``: scalar control.
        domains: the coefficient of each training domain.
        settings: how the players move.
        start: the two weights of all players, or those of each player, one after the other.
        shares: of the data, for each domain; empty: equal ones.
        irm_penalty: with which IRMv1 is trained in place of the domains' own costs.
    """

    problem: str
    domains: tuple[float, ...]
    settings: GameSettings
    start: tuple[float, ...]
    shares: tuple[float, ...] = ()
    irm_penalty: float | None = None

    def __post_init__(self) -> None:
        check_choice("problem", self.problem, PROBLEMS)

    @property
    def costs(self) -> list[Cost]:
        """What the players are paid by; in regression, twice its share weighs a domain's cost."""
        if self.problem == "control":
            return scalar_control.costs(self._coefficients)
        if self.irm_penalty is not None:
            rule = PredictorSettings(penalty=self.irm_penalty)
            return [lambda w: irm_objective(self.regression, rule, w.unsqueeze(-1))]
        if not self.shares:
            return self.regression.costs
        pairs = zip(self.regression.costs, self.shares, strict=True)
        return [lambda w, c=c, s=s: 2 * s * c(w) for c, s in pairs]

    @property
    def regression(self) -> Regression:
        """The regression problem, if it is one."""
        return REGRESSIONS[self.problem](self._coefficients)

    @property
    def _coefficients(self) -> Tensor:
        return torch.tensor([self.domains], dtype=torch.float64)

    @property
    def first(self) -> Tensor:
        """Where the players begin: ``[1, P]``, or ``[1, E, P]`` if each has its own start."""
        weights = torch.tensor(self.start, dtype=torch.float64).reshape(1, -1, 2)
        return weights[:, 0] if weights.shape[1] == 1 else weights

    @property
    def columns(self) -> dict[str, Any]:
        return {
            "problem": self.problem,
            "domains": _text(self.domains),
            "start": _text(self.start),
            "shares": _text(self.shares),
        }


# ------------------------------------------------------------------------- weights over time


@dataclass(frozen=True)
class Trajectory:
    """A game whose players are looked at on their way, densely at the start, and at the end.

    Attributes:
        label: the method's name in the rows.
        game: which game.
        on_the_way: whether they are; if not, only the end counts.
    """

    label: str
    game: Game
    on_the_way: bool = True

    @property
    def columns(self) -> dict[str, Any]:
        return {"method": self.label, **self.game.columns}


def looks(num_rounds: int) -> list[int]:
    """Rounds at which to look at a game, dense at the start."""
    later = (round(num_rounds ** (i / 80)) for i in range(81))
    return sorted({*range(min(num_rounds, 20)), *later})


def run_trajectory(cell: Trajectory, seeds: list[int]) -> pd.DataFrame:
    """The weights ``w_1, w_2`` of every player, which is the row's domain, by ``round``."""
    game = cell.game
    rounds = looks(game.settings.num_rounds) if cell.on_the_way else ()
    parts = []
    for number, players in play(game.costs, game.first, game.settings, rounds):
        weights = {
            (str(d), f"w_{i}"): [float(weight)] * len(seeds)
            for d, player in enumerate(players[0], start=1)
            for i, weight in enumerate(player, start=1)
        }
        parts.append(tidy(cell, seeds, weights, round=number))
    return pd.concat(parts, ignore_index=True)


def players_of(rows: pd.DataFrame, cell: Trajectory) -> np.ndarray:
    """The players' weights ``[looks, E, P]`` in the rows of a game."""
    own = select(rows, cell.columns)
    wide = own.pivot(index="round", columns=["domain", "metric"], values="value")
    return wide.sort_index(axis=1).to_numpy().reshape(len(wide), -1, 2)


def averages_of(rows: pd.DataFrame, cell: Trajectory) -> np.ndarray:
    """The weights of the players' average ``[looks, P]`` in the rows of a game."""
    return players_of(rows, cell).mean(1)


def shares_table(
    rows: pd.DataFrame, cells: Sequence[Trajectory], names: dict[str, str]
) -> pd.DataFrame:
    """The spurious weight at the end by the share of data that comes from the first domain."""
    lines: dict[float, dict[str, Any]] = {}
    for cell in cells:
        share = cell.game.shares[0]
        pooled = cell.game.regression.pooled(cell.game.shares)
        line = lines.setdefault(share, {"data of domain 1": f"{share:.0%}"})
        line["pooled least squares"] = float(pooled[0, 1])
        line[names[cell.label]] = averages_of(rows, cell)[-1, 1]
    return pd.DataFrame(lines.values())


# ------------------------------------------------------------------------------- the vote


@dataclass(frozen=True)
class Vote:
    """Bounded players on many regression problems, whose end the theorem predicts.

    Attributes:
        num_domains: of each problem; see :func:`voters`.
        settings: how the players move, with their bound.
    """

    num_domains: int
    settings: GameSettings

    @property
    def columns(self) -> dict[str, Any]:
        bound = f"{self.settings.bound:g}"
        return {"method": "ipo", "num_domains": self.num_domains, "bound": bound}


def voters(num_domains: int) -> Tensor:
    """Spurious coefficients ``[problems, E]``: a grid for two domains, random for more."""
    if num_domains == 2:
        axis = torch.linspace(-0.95, 0.95, 20, dtype=torch.float64)
        return torch.cartesian_prod(axis, axis)
    generator = np.random.default_rng(num_domains)
    return torch.tensor(generator.uniform(-1, 1, (NUM_RANDOM, num_domains)))


def run_vote(cell: Vote, seeds: list[int]) -> pd.DataFrame:
    """How far from the vote the players' average ends, and how far they are from standing still.

    Run i is problem i.
    """
    problem = correlated_noise(voters(cell.num_domains)[seeds])
    start = torch.zeros(len(seeds), 2, dtype=torch.float64)
    players = last(problem.costs, start, cell.settings)
    theorem = vote(problem.optima, cell.settings.bound)
    metrics = {
        ("all", "difference"): (average(players) - theorem).abs().amax(1),
        ("train", "residual"): residual(problem.costs, players, cell.settings.bound),
    }
    return tidy(cell, seeds, metrics)


def vote_line(rows: pd.DataFrame, cell: Vote) -> dict[str, Any]:
    """How many games of a cell have settled, and how far from the vote those are at most."""
    wide = select(rows, cell.columns).pivot(index="run", columns="metric", values="value")
    settled = wide["residual"] < 1e-6
    return {
        "domains": cell.num_domains,
        "bound": cell.settings.bound,
        "problems": len(wide),
        "settled": int(settled.sum()),
        "largest difference to the vote": wide["difference"][settled].max(),
    }


# ------------------------------------------------------------------- plain steps and pooling


@dataclass(frozen=True)
class Steps:
    """IPO with plain steps beside pooled gradient descent on the control problem.

    Attributes:
        learning_rate: of pooled gradient descent; players have it times their number.
        num_rounds: of both.
        domains: the training domains.
        start: of all.
    """

    learning_rate: float
    num_rounds: int
    domains: tuple[float, ...]
    start: tuple[float, float]

    @property
    def columns(self) -> dict[str, Any]:
        rate = f"{self.learning_rate:g}"
        return {"method": "ipo_plain", "domains": _text(self.domains), "learning_rate": rate}

    def players(self, method: str, order: str = "in_turn") -> Tensor:
        """All players ``[1, E, P]`` at the end."""
        rate = self.learning_rate * (len(self.domains) if method == "ipo" else 1)
        rule = GameSettings(method, learning_rate=rate, num_rounds=self.num_rounds, order=order)
        game = Game("control", self.domains, rule, self.start)
        return last(game.costs, game.first, rule)


def run_steps(cell: Steps, seeds: list[int]) -> pd.DataFrame:
    """How far from pooled training the average ends, and how far apart the first two players."""
    pooled = average(cell.players("pooled"))
    in_turn, together = cell.players("ipo"), cell.players("ipo", "together")
    apart = {
        "in turn": average(in_turn)[0] - pooled[0],
        "together": average(together)[0] - pooled[0],
        "players are apart by": in_turn[0, 0] - in_turn[0, 1],
    }
    lengths = {("all", name): [float(way.norm())] * len(seeds) for name, way in apart.items()}
    return tidy(cell, seeds, lengths)


def steps_table(rows: pd.DataFrame, cells: Sequence[Steps]) -> pd.DataFrame:
    """A line for each learning rate."""
    lines = []
    for cell in cells:
        values = select(rows, cell.columns).set_index("metric")["value"]
        names = ("in turn", "together", "players are apart by")
        lines.append({"η / n": cell.learning_rate} | {name: values[name] for name in names})
    return pd.DataFrame(lines)


def order_of(errors: pd.Series, steps: pd.Series) -> float:
    """The power of the step with which an error falls, from the two smallest steps."""
    return float((np.diff(np.log(errors)) / np.diff(np.log(steps)))[-1])


# ---------------------------------------------------------------------------- the Nash gap


@dataclass(frozen=True)
class Gap:
    """A game whose Nash gap is measured on the way.

    Attributes:
        label: the method's name in the rows.
        game: which game.
        learning_rate: with which a player goes down alone, within its bound.
        num_rounds: for so many rounds.
    """

    label: str
    game: Game
    learning_rate: float
    num_rounds: int = 500

    @property
    def columns(self) -> dict[str, Any]:
        return {"method": self.label, **self.game.columns}


def run_gap(cell: Gap, seeds: list[int]) -> pd.DataFrame:
    """The gap relative to the larger of the domains' best costs, by ``round``."""
    game = cell.game
    alone = GameSettings(
        "pooled",
        learning_rate=cell.learning_rate,
        num_rounds=cell.num_rounds,
        bound=game.settings.bound,
        max_gradient_norm=1.0,
    )
    free = replace(alone, bound=None, learning_rate=cell.learning_rate / 4)
    best = max(float(cost(last([cost], game.first, free)[:, 0])) for cost in game.costs)
    num_rounds = game.settings.num_rounds
    rounds = [round(num_rounds * part) for part in (0, 0.02, 0.1, 0.3)]
    parts = []
    for number, players in play(game.costs, game.first, game.settings, rounds):
        relative = float(gap(game.costs, players, alone)[0]) / best
        metrics = {("train", "nash_gap_relative"): [relative] * len(seeds)}
        parts.append(tidy(cell, seeds, metrics, round=number))
    return pd.concat(parts, ignore_index=True)


def gaps_of(rows: pd.DataFrame, cell: Gap) -> tuple[np.ndarray, np.ndarray]:
    """The gaps in the rows of a game, by the part of the training that is over."""
    own = select(rows, cell.columns).sort_values("round")
    return own["round"].to_numpy() / cell.game.settings.num_rounds, own["value"].to_numpy()


# ------------------------------------------------------------------------------ experiments


def _few_rounds(cell: Trajectory | Gap) -> Trajectory | Gap:
    settings = replace(cell.game.settings, num_rounds=30)
    return replace(cell, game=replace(cell.game, settings=settings))


def short(cell: Trajectory | Vote | Steps | Gap) -> Trajectory | Vote | Steps | Gap:
    """Thirty rounds, of players alone, too."""
    if isinstance(cell, Steps):
        return replace(cell, num_rounds=30)
    if isinstance(cell, Vote):
        return replace(cell, settings=replace(cell.settings, num_rounds=30))
    cell = _few_rounds(cell)
    return replace(cell, num_rounds=30) if isinstance(cell, Gap) else cell


def near_the_end(cell: Trajectory) -> list[Trajectory]:
    """At moments of the last fiftieth of the rounds, where only the end counts."""
    if cell.on_the_way:
        return []
    fewer = with_fewer(cell.game.settings, "num_rounds")
    return [replace(cell, game=replace(cell.game, settings=settings)) for settings in fewer]


EXPERIMENTS = {
    name: Experiment(run_trajectory, Trajectory, short, (0,), near_the_end=near_the_end)
    for name in ("field", "averages", "shares", "paths")
} | {
    "vote": Experiment(run_vote, Vote, short, (0, 1, 190)),
    "steps": Experiment(run_steps, Steps, short, (0,)),
    "gaps": Experiment(run_gap, Gap, short, (0,)),
}
