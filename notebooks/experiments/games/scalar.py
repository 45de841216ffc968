"""From a family of scalar control problems to tidy rows, one per problem and metric; to tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from experiments.experiment import Experiment, near_the_end
from experiments.figures import OUTCOMES
from experiments.games import played as games_played
from experiments.games import players, relu
from experiments.games.scalar_control import costs, stationary_cost, unseen_cost
from experiments.origin import ROOT
from experiments.rows import tidy
from experiments.store import Store, select
from ipo.causality.small_games import GameSettings, last, residual
from ipo.checks import check_choice
from ipo.game import average
from ipo.lqr import oracle_cost

FAMILIES = ("given", "grid", "random")
GRID = np.linspace(-1, 1, 21)
START = (0.3, 0.0)
UNSEEN = torch.tensor(np.random.default_rng(0).uniform(-1, 1, 200))  # betas that score a controller
MARGIN = 0.01  # by which a method's score must differ to be better or worse

NAMES = {
    "pooled": "pooled gradient descent",
    "ipo_plain": "IPO, plain steps",
    "ipo_plain_large": "IPO, plain steps",
    "ipo_bound0.5": "IPO, bound 0.5",
    "ipo_bound1": "IPO, bound 1",
    "ipo_bound2": "IPO, bound 2",
    "ipo_bound5": "IPO, bound 5",
    "ipo_adam": "IPO, one Adam per player",
}


@dataclass(frozen=True)
class Cell:
    """Scalar control problems that are trained in one way.

    Attributes:
        label: the method's name in the rows, such as ``pooled`` or ``ipo_bound2``.
        settings: how it is trained.
        betas: of the training domains. ``None`` is filled in run by run.
        family: ``given``: all betas are; ``grid``: the first two run over :data:`GRID`, run i at
            row ``i // 21`` and column ``i % 21``; ``random``: those of run i are uniform on
            [-1, 1], from a stream of i.
        start: of all players.
    """

    label: str
    settings: GameSettings
    betas: tuple[float | None, ...]
    family: str = "given"
    start: tuple[float, float] = START

    def __post_init__(self) -> None:
        check_choice("family", self.family, FAMILIES)

    @property
    def columns(self) -> dict[str, Any]:
        betas = " ".join("*" if beta is None else f"{beta:g}" for beta in self.betas)
        start = " ".join(f"{weight:g}" for weight in self.start)
        return {"method": self.label, "family": self.family, "betas": betas, "start": start}


def standard(num_domains: int) -> dict[str, GameSettings]:
    """The ways of training that the chapter compares, by their label in the rows.

    With plain steps, IPO's average moves by learning_rate / E times the mean gradient in a
    round; its players have E times the learning rate, so that it is comparable with pooling.
    The bound on the gradients' norm acts only next to instability.
    """
    plain = {"learning_rate": 0.2 * num_domains, "num_rounds": 2000, "max_gradient_norm": 1.0}
    adam = {"optimizer": "adam", "learning_rate": 2e-3, "num_rounds": 4000}
    bounded = {
        f"ipo_bound{bound:g}": GameSettings("ipo", bound=bound, **plain) for bound in (0.5, 1, 2, 5)
    }
    return bounded | {
        "pooled": GameSettings("pooled", **(plain | {"learning_rate": 0.05})),
        "pooled_adam": GameSettings("pooled", **adam),
        "ipo_plain": GameSettings(
            "ipo", **(plain | {"learning_rate": 0.002 * num_domains, "num_rounds": 10_000})
        ),
        "ipo_plain_large": GameSettings("ipo", **(plain | {"learning_rate": 0.05 * num_domains})),
        "ipo_plain_together": GameSettings(
            "ipo", order="together", **(plain | {"learning_rate": 0.05 * num_domains})
        ),
        "ipo_adam": GameSettings("ipo", **adam),
        "ipo_adam_together": GameSettings("ipo", order="together", **adam),
        "ipo_adam_large": GameSettings("ipo", **(adam | {"learning_rate": 2e-2})),
        "ensemble_adam": GameSettings("ensemble", **adam),
        "separate_adam": GameSettings("separate", **adam),
        "in_turn_adam": GameSettings("in_turn", **adam),
    }


def problems(cell: Cell, runs: Sequence[int]) -> Tensor:
    """The betas ``[R, E]`` of a cell's runs."""
    rows = []
    for run in runs:
        free = {
            "given": lambda run: iter(()),
            "grid": lambda run: iter((GRID[run // len(GRID)], GRID[run % len(GRID)])),
            "random": lambda run: iter(np.random.default_rng(run).uniform(-1, 1, len(cell.betas))),
        }[cell.family](run)
        rows.append([next(free) if beta is None else beta for beta in cell.betas])
    return torch.tensor(rows, dtype=torch.float64)


def run_cell(cell: Cell, seeds: list[int]) -> pd.DataFrame:
    """The average's gains, the players' largest weight, and how far from an equilibrium it is."""
    training = costs(problems(cell, seeds))
    start = torch.tensor([cell.start] * len(seeds), dtype=torch.float64)
    players = last(training, start, cell.settings)
    gains = average(players)
    metrics = {
        ("all", "k_1"): gains[:, 0],
        ("all", "k_2"): gains[:, 1],
        ("all", "largest_weight"): players.abs().flatten(1).amax(1),
        ("train", "residual"): residual(training, players, cell.settings.bound),
    }
    return tidy(cell, seeds, metrics)


def problem_cell(
    label: str,
    betas: tuple[float | None, ...],
    family: str = "given",
    start: tuple[float, float] = START,
    num_rounds: int | None = None,
) -> Cell:
    """A cell that is trained in a standard way, for another number of rounds where one is given."""
    settings = standard(len(betas))[label]
    if num_rounds is not None:
        settings = replace(settings, num_rounds=num_rounds)
    return Cell(label, settings, betas, family, start)


# ------------------------------------------------------------------------ tables of gains


def gains_of(rows: pd.DataFrame) -> Tensor:
    """The gains ``[R, 2]`` in the rows of one cell, in the order of their runs."""
    wide = rows.pivot(index="run", columns="metric", values="value").sort_index()
    return torch.tensor(wide[["k_1", "k_2"]].to_numpy())


def gains(rows: pd.DataFrame, cell: Cell) -> Tensor:
    """The gains ``[R, 2]`` of a cell's problems."""
    return gains_of(select(rows, cell.columns))


def gains_text(gains: Tensor) -> str:
    return f"({gains[0]:.3f}, {gains[1]:.3f})"


def control_line(rows: pd.DataFrame, cell: Cell, elsewhere: Sequence[float]) -> dict[str, str]:
    """Gains of a cell with one problem, what they cost in training and at betas ``elsewhere``."""
    own = select(rows, cell.columns)
    (k,) = gains_of(own)

    def cost(*betas: float) -> str:
        """The mean of what it costs, as text: it may be unstable for one of the betas."""
        costs = stationary_cost(k, torch.tensor(betas, dtype=torch.float64))
        return f"{costs.mean():.2f}" if bool(costs.isfinite().all()) else "unstable"

    largest = own.loc[own["metric"] == "largest_weight", "value"].iloc[0]
    return {
        "training β": ", ".join(f"{beta:g}" for beta in cell.betas),
        "method": NAMES[cell.label],
        "k₁": f"{k[0]:.3f}",
        "k₂": f"{k[1] + 0:.3f}".replace("-0.000", "0.000"),
        "largest weight of a player": f"{largest:.1f}",
        "training cost": cost(*cell.betas),
    } | {f"β = {beta:g}": cost(beta) for beta in elsewhere}


def starts_table(rows: pd.DataFrame, cells: Sequence[Cell]) -> pd.DataFrame:
    """A line for each start, with the gains at which each method ends."""
    lines: dict[tuple[float, float], dict[str, Any]] = {}
    for cell in cells:
        line = lines.setdefault(cell.start, {"start": f"({cell.start[0]:g}, {cell.start[1]:g})"})
        (k,) = gains(rows, cell).tolist()
        line[f"{NAMES[cell.label]}: k₁"], line[f"{NAMES[cell.label]}: k₂"] = k
    return pd.DataFrame(lines.values())


# --------------------------------------------------------------- where IPO wins, ties, loses


def outcome(ipo: np.ndarray, pooled: np.ndarray) -> np.ndarray:
    """Which of :data:`experiments.figures.OUTCOMES` it is, from costs of the same shape."""
    with np.errstate(invalid="ignore"):
        ratio = np.where(np.isinf(ipo), np.inf, ipo / pooled)  # 0 where only pooling is unstable
    kinds = np.select([ratio < 1 - MARGIN, ratio > 1 + MARGIN], ["IPO better", "IPO worse"], "tie")
    return np.where(np.isinf(ipo) & np.isinf(pooled), "both unstable", kinds)


def score(rows: pd.DataFrame, cell: Cell) -> np.ndarray:
    """Mean cost over unseen betas of every problem ``[R]``."""
    return unseen_cost(gains(rows, cell), UNSEEN).numpy()


def outcomes(rows: pd.DataFrame, ipo: Cell, pooled: Cell) -> np.ndarray:
    """Problem by problem, ``[R]``, by their scores."""
    return outcome(score(rows, ipo), score(rows, pooled))


def shares_of_outcomes(rows: pd.DataFrame, ipo: Cell, pooled: Cell) -> dict[str, float]:
    """The share of problems with each outcome."""
    kinds = outcomes(rows, ipo, pooled)
    return {kind: float((kinds == kind).mean()) for kind in OUTCOMES}


def shares_beta_by_beta(rows: pd.DataFrame, ipo: Cell, pooled: Cell) -> dict[str, float]:
    """Of all pairs of a problem and an unseen beta."""
    costs = (
        stationary_cost(gains(rows, cell).unsqueeze(1), UNSEEN).numpy() for cell in (ipo, pooled)
    )
    kinds = outcome(*costs)
    return {
        "β by β: better": float((kinds == "IPO better").mean()),
        "worse": float((kinds == "IPO worse").mean()),
    }


def ablation_line(
    rows: pd.DataFrame, cells: Mapping[tuple[int, str], Cell], label: str
) -> dict[str, float]:
    """How a method compares with pooling on random problems, by their number of domains."""
    line = {}
    for n in (2, 3):
        kinds = outcomes(rows, cells[n, label], cells[n, "pooled"])
        line[f"{n} domains: better"] = float((kinds == "IPO better").mean())
        line[f"{n}: worse"] = float((kinds == "IPO worse").mean())
        line[f"{n}: unstable"] = float(np.isinf(score(rows, cells[n, label])).mean())
    return line


# -------------------------------------------------------------------- players of networks


def growth(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows of the distance between players, less what it was at the start of the run."""
    distance = rows[rows["metric"] == "distance_players"].copy()
    start = distance[distance["update"] == 0].set_index(["method", "run"])["value"]
    of_row = pd.MultiIndex.from_frame(distance[["method", "run"]])
    distance["value"] -= start.loc[of_row].to_numpy()
    return distance


def mean_of_players(rows: pd.DataFrame, update: int) -> pd.Series:
    """Mean over runs after an update, by method and metric."""
    return rows[rows["update"] == update].groupby(["method", "metric"])["value"].mean()


# ------------------------------------------------------------------ Nash gaps of other kinds


def lqr_gap(method: str) -> pd.Series:
    """The Nash gap of a method in the shipped runs of LQR, relative to the oracle's cost.

    Mean over runs, by the part of the training that is over.
    """
    rows = Store(ROOT / "data" / "results" / "lqr", "curves").rows()
    own = rows[(rows["metric"] == "nash_gap") & (rows["method"] == method)]
    gap = own.groupby("iteration")["value"].mean() / oracle_cost()
    return gap.set_axis(gap.index / gap.index.max())


def keys_gap(rows: pd.DataFrame, kind: str) -> pd.Series:
    """The ``lower`` or ``upper`` bound on IPO's gap in coloured keys, relative to the best return.

    Mean over runs, by the part of the training that is over.
    """
    ipo = rows[rows["method"] == "ipo"]
    begun = ipo[(ipo["update"] == 0) & (ipo["run"] == 0)]
    values = begun.set_index("metric")["value"]
    best_return = values["gap_upper"] + values["return_exact"].min()
    gap = ipo[ipo["metric"] == f"gap_{kind}"].groupby("update")["value"].mean() / best_return
    return gap.set_axis(gap.index / ipo["update"].max())


def short(cell: Cell) -> Cell:
    """Thirty rounds."""
    return replace(cell, settings=replace(cell.settings, num_rounds=30))


rounds_near_the_end = partial(near_the_end, steps="num_rounds")
EXPERIMENTS = (
    {
        name: Experiment(run_cell, Cell, short, (0,), near_the_end=rounds_near_the_end)
        for name in ("table", "optima", "starts")
    }
    | {
        name: Experiment(run_cell, Cell, short, (0, 1, 200), near_the_end=rounds_near_the_end)
        for name in ("grid", "random", "ablation")
    }
    | {"players": players.EXPERIMENT, "relu": relu.EXPERIMENT}
    | games_played.EXPERIMENTS
)
