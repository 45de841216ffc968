"""Figures of the cued maze: the task, who waits for whom, and the phase diagram."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from experiments.cue.outcomes import NAMES
from experiments.cue.theory import STRENGTH, Cues, text
from experiments.figures import STYLES, draw_metric
from ipo.worlds.cued_maze import LANDMARK

OUTLINED = [withStroke(linewidth=3.5, foreground="black")]  # white on yellow can be seen


def maze() -> Figure:
    """The maze from above, with the two signs on the wall behind the junction."""
    fig, ax = plt.subplots(figsize=(5.2, 3))
    walls = [(-0.5, 0), (-0.5, 2), (-2.5, 2), (-2.5, 3), (2.5, 3), (2.5, 2), (0.5, 2), (0.5, 0)]
    ax.plot(*zip(*walls, walls[0], strict=True), color="0.2", lw=2)
    ax.plot(0, 0.5, marker="^", ms=14, color="#D55E00")
    for x, name in ((-2, "reward\nhere?"), (2, "or\nhere?")):
        ax.text(x, 2.5, name, ha="center", va="center", fontsize="small")
    for x, arrow, name, color in (
        (-0.6, "→", "landmark", "#009E73"),
        (0.6, "←", "cue", "#CC79A7"),
    ):
        ax.text(x, 3.05, arrow, ha="center", va="bottom", fontsize="xx-large", color=color)
        ax.text(x, 3.65, name, ha="center", va="bottom", fontsize="small")
    ax.text(0.75, 0.5, "start", va="center", fontsize="small")
    ax.set(xlim=(-3, 3), ylim=(-0.2, 4.1), aspect="equal")
    ax.axis("off")
    return fig


def waiting(runs: pd.DataFrame) -> Figure:
    """Return in the worst domain by the number of steps that a player makes before an answer."""
    rows = runs["worst"].rename("value").reset_index().assign(metric="worst")
    least = rows["frames"] == rows["frames"].min()
    fig, ax = plt.subplots(figsize=(7, 3.8))
    draw_metric(ax, rows[least], "worst", "steps", ("ppo", "ipo"))
    for method, own in rows[~least].groupby("method"):
        _, color, marker = STYLES[method]
        ax.plot(0.85, own["value"].mean(), color=color, marker=marker, ms=8, mfc="none")
    ax.axhline(LANDMARK, color="0.5", lw=1, ls=":")
    ax.set_xscale("log", base=2)
    steps = sorted(rows["steps"].unique())
    ax.set_xticks(steps, steps)
    ax.set(xlabel="gradient steps on each rollout", ylabel="return in the worst domain")
    ax.legend(fontsize="small")
    return fig


def phases(worst: pd.Series, missed: pd.Series, points: Mapping[int, Sequence[Cues]]) -> Figure:
    """Mean return in the worst domain, a map for each number of domains and each method.

    Args:
        worst: by ``cues, method``.
        missed: by the same, whether something else was predicted; a cross stands there.
        points: of the diagram of each number of domains.
    """
    fig, axes = plt.subplots(len(points), len(NAMES), figsize=(11, 2.6 * len(points)))
    for row, (num, own) in zip(np.atleast_2d(axes), points.items(), strict=True):
        for ax, (method, name) in zip(row, NAMES.items(), strict=True):
            picture = _draw(ax, own, worst.xs(method, level="method"))
            _mark(ax, own, [cues for cues in own if missed[text(cues), method]])
            if method != "vrex":
                _draw_border(ax, own, method)
            ax.set_title(f"{num}: {name}".replace(", ", ",\n"), fontsize="small")
            ax.set_xlabel(" = ".join(f"$c_{d}$" for d in range(1, max(num, 2))))
        row[0].set_ylabel(f"$c_{num}$")
    fig.colorbar(picture, ax=axes, label="return in the worst domain", shrink=0.8 / len(points))
    return fig


def _draw(ax: Axes, points: Sequence[Cues], worst: pd.Series):
    """A square for each point, whose axes are the ranks of its cues."""
    columns, rows = _ranks(points)
    values = np.full((len(rows), len(columns)), np.nan)
    for cues in points:
        values[rows.index(cues[-1]), columns.index(cues[0])] = worst[text(cues)]
    ax.grid(False)
    ax.set_xticks(range(len(columns)), [f"{c:g}" for c in columns], fontsize="small")
    ax.set_yticks(range(len(rows)), [f"{c:g}".replace("-", "−") for c in rows], fontsize="small")
    return ax.imshow(values, cmap="cividis", vmin=0, vmax=LANDMARK, origin="lower", aspect="auto")


def _mark(ax: Axes, points: Sequence[Cues], wrong: Sequence[Cues]) -> None:
    columns, rows = _ranks(points)
    for cues in wrong:
        place = columns.index(cues[0]), rows.index(cues[-1])
        ax.plot(*place, marker="x", color="white", ms=7, mew=2, path_effects=OUTLINED)


def _ranks(points: Sequence[Cues]) -> tuple[list[float], list[float]]:
    return sorted({cues[0] for cues in points}), sorted({cues[-1] for cues in points})


def _draw_border(ax: Axes, points: Sequence[Cues], method: str) -> None:
    """Where the rule of a method changes its mind, as far as it is in the diagram."""
    columns, rows = _ranks(points)
    num = len(points[0])
    first = np.linspace(columns[0], columns[-1], 500)
    if method == "ipo" and num > 2:  # the majority decides, whatever the last cue is
        first, second = np.full(2, STRENGTH), np.array([rows[0], rows[-1]])
    elif method == "ipo":
        second = STRENGTH**2 / first
    else:
        second = num * STRENGTH - (num - 1) * first
    inside = (second >= rows[0]) & (second <= (first if num == 2 else rows[-1]))
    inside &= (first >= columns[0]) & (first <= columns[-1])
    places = (
        np.interp(values[inside], ranks, range(len(ranks)))
        for values, ranks in ((first, columns), (second, rows))
    )
    ax.plot(*places, color="white", ls="--", lw=1.5, path_effects=OUTLINED)
