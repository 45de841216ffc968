"""Rules for what the paper says of its background: equilibria, and the games it is inspired by."""

from __future__ import annotations

import numpy as np
import pandas as pd

from experiments.games.relu import NAMES, ends
from experiments.tables import chosen_by
from rules.cells import Cells, NoData, in_brackets, label
from rules.keys import narrower
from rules.verdicts import (
    CONTRADICTED,
    REPRODUCED,
    Finding,
    compare,
    counted,
    decided,
    holds,
    together,
    within,
)


def game_beside(
    cells: Cells,
    paper: pd.DataFrame,
    game: str,
    baseline: str,
    metrics: dict[str, list[str]],
    criterion: str | None,
    margin: float,
    guessing: dict[str, float],
) -> Finding:
    """The game's test error is at most by a share larger than the baseline's, in every problem.

    ``guessing``: the error of who guesses, where there is such a thing. To be as good as a baseline
    that is worse than that is no merit, and the finding says so.
    """
    verdicts, parts = [], []
    for problem, ours, base in pairs(cells, game, baseline, metrics, criterion):
        mean, low, high, _ = compare(ours, base).difference
        verdicts.append(within(low, high, -np.inf, margin * base.mean()))
        by = in_brackets(mean, low, high, "+.2f")
        parts.append(f"{problem} {ours.mean():.2f} and {base.mean():.2f}, by {by}, {verdicts[-1]}")
        if min(ours.mean(), base.mean()) > guessing.get(problem, np.inf):
            parts[-1] += f", though guessing has {guessing[problem]:.2f}"
    counts = counted(verdicts)
    evidence = f"test errors of {label(game)} and {label(baseline)}: {'; '.join(parts)} ({counts})"
    return Finding(together(verdicts), evidence)


def game_varies_less(
    cells: Cells,
    paper: pd.DataFrame,
    game: str,
    baseline: str,
    metrics: dict[str, list[str]],
    criterion: str | None,
) -> Finding:
    """The game's test errors are nearer to their median over runs, in every problem."""
    compared, parts = [], []
    for problem, ours, base in pairs(cells, game, baseline, metrics, criterion):
        compared.append(narrower(ours, base))
        nearer = in_brackets(*compared[-1].difference[:3], "+.3f")
        parts.append(f"{problem} {ours.std():.3f} and {base.std():.3f}, nearer by {nearer}")
    verdicts = decided(compared)
    evidence = (
        f"significantly less in {verdicts.count(REPRODUCED)} of {len(verdicts)} problems, "
        f"significantly more in {verdicts.count(CONTRADICTED)}; standard deviations of the test "
        f"error of {label(game)} and {label(baseline)}, and by how much the game is nearer to its "
        f"median: {'; '.join(parts)}"
    )
    return Finding(together(verdicts), evidence)


def pairs(
    cells: Cells, game: str, baseline: str, metrics: dict[str, list[str]], criterion: str | None
) -> list[tuple[str, pd.Series, pd.Series]]:
    """Test errors of both by problem; each run with the penalty that has the lowest criterion.

    ``None``: all runs with the largest penalty.
    """
    rows = chosen_by(cells.rows, criterion) if criterion else strongest(cells.rows)
    chosen = Cells(rows, cells.num_runs)
    return [
        (
            problem,
            *(
                chosen.runs(problem=problem, method=method, domain="test", metric=metric)
                for method in (game, baseline)
            ),
        )
        for metric, problems in metrics.items()
        for problem in problems
    ]


def strongest(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows of the largest penalty of a method in a problem."""
    own = rows.groupby(["problem", "method"], observed=True)["penalty"]
    return rows[rows["penalty"] == own.transform("max")]


def equilibria_are_invariant(
    cells: Cells, paper: pd.DataFrame, methods: list[str], settled: float, tolerance: float
) -> Finding:
    """At every equilibrium of the control problem the average is optimal in all training domains.

    A game stands at an equilibrium if no player's gradient has a component along which it may move
    that is larger than ``settled``. Gains are optimal in a domain if they are within ``tolerance``
    of what training in that domain alone ends at.
    """
    verdicts, farthest = [], []
    for method in methods:
        for betas in sorted(cells.select(method=method)["betas"].unique()):
            game = {"method": method, "betas": betas}
            if cells.runs(metric="residual", **game).max() > settled:
                continue
            apart = [
                max(
                    float((cells.runs(metric=gain, **game) - alone).abs().max())
                    for gain, alone in optimum(cells, beta).items()
                )
                for beta in betas.split()
            ]
            farthest.append(max(apart))
            verdicts.append(holds(farthest[-1] <= tolerance))
    if not verdicts:
        raise NoData(f"equilibria of {', '.join(methods)}: 0")
    evidence = (
        f"of {len(verdicts)} equilibria, {verdicts.count(REPRODUCED)} are optimal in all their "
        f"training domains; in the others the gains of at least one domain's optimum are "
        f"{min(farthest):.2f} to {max(farthest):.2f} away"
    )
    return Finding(together(verdicts), evidence)


def optimum(cells: Cells, beta: str) -> dict[str, float]:
    """The gains at which training in one domain ends."""
    where = {"method": "pooled", "betas": beta}
    return {gain: cells.runs(metric=gain, **where).mean() for gain in ("k_1", "k_2")}


def relu_equilibria(cells: Cells, paper: pd.DataFrame, scales: list[float]) -> Finding:
    """At every equilibrium of ReLU networks that was found the average is optimal in all domains.

    ``scales`` are the starts that count. Which games are at an equilibrium, and which averages are
    optimal, is for :func:`experiments.games.relu.ends`.
    """
    rows = cells.rows[cells.rows["scale"].isin(scales)]
    if rows.empty:
        raise NoData("equilibria of ReLU networks: 0")
    verdicts, parts = [], []
    for (units, width), own in ends(rows).groupby(["method", "width"], observed=True):
        rest = own[own["rest"]]
        wrong = int((~rest["optimal"]).sum())
        verdicts.append(holds(wrong == 0))
        hidden = "1 unit" if width == 1 else f"{width} units"
        parts.append(f"{hidden}, {NAMES[units]}: {wrong} of {len(rest)}")
    evidence = (
        "equilibria whose average is not optimal in all training domains, by architecture: "
        + "; ".join(parts)
    )
    return Finding(together(verdicts), evidence)
