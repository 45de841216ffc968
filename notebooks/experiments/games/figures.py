"""Figures of the chapter on the algorithm: small games in the plane, votes, players, Nash gaps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.figures import OUTCOMES, STYLES, draw_metric, draw_outcomes, draw_two_players

COLORS = {
    "pooled": "#D55E00",
    "ipo_plain": "#E69F00",
    "ipo_plain_large": "#E69F00",
    "ipo_bound2": "#0072B2",
    "ipo_adam": "#CC79A7",
}

Point = Sequence[float]


def field(games: Mapping[tuple[float | None, str], tuple[Point, Sequence[np.ndarray]]]) -> Figure:
    """Two players' games: a row for each bound, a column for each name.

    ``games[bound, name]`` holds the domains' wishes and paths ``[time, 2]``.
    """
    bounds, names = (list(dict.fromkeys(keys)) for keys in zip(*games, strict=True))
    fig, axes = plt.subplots(len(bounds), len(names), figsize=(9, 8.6), sharex=True, sharey=True)
    for ax, ((bound, name), (wishes, paths)) in zip(axes.flat, games.items(), strict=True):
        draw_two_players(ax, wishes, bound, paths, limit=3.2)
        ax.set_title(f"{name}, {'no bound' if bound is None else f'bound {bound:g}'}")
    label_outside(axes, "spurious weight of player 1, $u$", "spurious weight of player 2, $v$")
    axes[0, 0].legend(loc="lower left", fontsize="small", frameon=True)
    return fig


def label_outside(axes: np.ndarray, x: str, y: str) -> None:
    """Labels of the axes that several panels share, below and to the left."""
    for ax in axes[-1]:
        ax.set_xlabel(x)
    for ax in axes[:, 0]:
        ax.set_ylabel(y)


def draw_path(ax: Axes, path: np.ndarray, method: str, name: str, size: float = 7) -> None:
    """Where an average went ``[time, 2]``, with a dot at its end."""
    ax.plot(*path.T, color=COLORS[method], lw=1.5, label=name)
    ax.plot(*path[-1], color=COLORS[method], marker="o", ms=size)


def draw_text(ax: Axes, point: Point, text: str, shift: tuple[float, float]) -> None:
    """A small text beside a point."""
    ax.annotate(text, point, xytext=shift, textcoords="offset points", fontsize="x-small")


def draw_references(ax: Axes, pooled: Point, optima: np.ndarray) -> None:
    """Fixed points of a regression: pooled least squares, the domains' optima, the oracle."""
    ax.plot(*pooled, color="#D55E00", marker="X", ms=9, ls="none", label="pooled least squares")
    ax.plot(*optima.T, color="0.3", marker="+", ms=10, ls="none", label="a domain's own optimum")
    ax.plot(1, 0, color="black", marker="*", ms=13, ls="none", label="oracle (invariant)")


def draw_optima(ax: Axes, optima: Mapping[float, Point], invariant: Point) -> None:
    """Crosses at the domains' own optima, where they are in the picture; a star: invariant."""
    for beta, k in optima.items():
        if abs(k[1]) < 1.3:
            ax.plot(*k, color="0.3", marker="+", ms=10)
            draw_text(ax, k, f"β = {beta:g}", (6, 2))
    ax.set_ylim(-0.35, 1.3)
    ax.plot(*invariant, color="black", marker="*", ms=13, ls="none", label="invariant")


def draw_vote(ax: Axes, wishes: Sequence[float], bound: float, average: float) -> None:
    """The staircase of a vote for one weight, and where the rising line crosses it."""
    num, wishes = len(wishes), sorted(wishes)
    heights = [bound * (num - 2 * k) / num for k in range(num + 1)]
    ax.stairs(heights, [-1.5, *wishes, 1.5], baseline=None, color="#0072B2", lw=2)
    ax.vlines(wishes, heights[1:], heights[:-1], color="#0072B2", lw=2)
    ax.plot([-1.5, 1.5], [-1.5, 1.5], color="0.4", ls="--", lw=1)
    ax.plot(average, average, color="#009E73", marker="o", ms=9)
    ax.annotate(f"{average:.2f}", (average, average), xytext=(8, 4), textcoords="offset points")
    ax.set(xlabel="average $p$")


def phase_diagrams(outcomes: Mapping[str, np.ndarray], values: np.ndarray) -> Figure:
    """Four maps of outcomes ``{title: [problems]}`` over two coefficients with these values."""
    fig, axes = plt.subplots(2, 2, figsize=(8.4, 8.6))
    for ax, (title, kinds) in zip(axes.flat, outcomes.items(), strict=True):
        draw_outcomes(ax, kinds.reshape(len(values), -1), values)
        ax.set(title=title, xlabel="$\\beta_2$", ylabel="$\\beta_1$")
    handles = [plt.Rectangle((0, 0), 1, 1, color=color) for color in OUTCOMES.values()]
    fig.legend(handles, OUTCOMES, loc="outside lower center", ncols=4)
    return fig


def players(rows: pd.DataFrame, growth: pd.DataFrame) -> Figure:
    """How far players of networks move, from their start and apart; whether moves agree."""
    methods = ("ipo", "ensemble")
    fig, (left, right) = plt.subplots(1, 2, figsize=(10, 3.8))
    draw_metric(left, rows, "distance_start", "update", methods)
    draw_metric(left, growth, "distance_players", "update", methods, ls="--")
    left.set(xlabel="update", ylabel="distance in weight space")
    names = ("IPO, player from its start", "IPO, growth between players")
    texts = [names[0], "ensemble", names[1], "ensemble"]
    left.legend(left.get_lines(), texts, fontsize="small")
    draw_metric(right, rows, "move_correlation", "update", methods)
    right.axhline(0, color="black", lw=1)
    right.set(xlabel="update", ylabel="correlation of what\nthe two players learnt", ylim=(-1, 1))
    right.legend(fontsize="small")
    return fig


def draw_gap(ax: Axes, part: np.ndarray, gap: np.ndarray, method: str, name: str) -> None:
    """The Nash gap of a small game by the part of training that is over."""
    ax.plot(part, gap, color=COLORS[method], marker="o", ms=4, label=name)


def draw_lqr_gap(ax: Axes, gap: pd.Series, method: str) -> None:
    """The Nash gap of LQR by the part of training that is over."""
    name, color, _ = STYLES[method]
    ax.plot(gap.index, gap, color=color, label=name)


def draw_keys_gaps(ax: Axes, lower: pd.Series, upper: pd.Series) -> None:
    """The two bounds on the Nash gap in coloured keys, by part of training."""
    style = {"color": STYLES["ipo"][1], "marker": "o", "ms": 4}
    ax.plot(lower.index, lower, ls="-", label="what a player gains alone in 5 updates", **style)
    ax.plot(upper.index, upper, ls="--", label="what is missing to the best return", **style)


def finish_gaps(axes: np.ndarray) -> None:
    """Scales, labels and legends that all panels with Nash gaps share."""
    for ax in axes.flat:
        ax.legend(fontsize="small")
        ax.set_yscale("symlog", linthresh=1e-3)
        ax.set_ylim(0, None)
    label_outside(axes, "part of training", "Nash gap, relative")
