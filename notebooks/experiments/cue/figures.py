"""Figures of the cued maze: the task, and how long players wait for an answer."""

from __future__ import annotations

import matplotlib.pyplot as plt
import pandas as pd
from matplotlib.figure import Figure

from experiments.figures import STYLES, draw_metric
from ipo.worlds.cued_maze import LANDMARK


def maze() -> Figure:
    """The maze from above, with the two signs on the wall behind the junction."""
    fig, ax = plt.subplots(figsize=(5.2, 3))
    walls = [(-0.5, 0), (-0.5, 2), (-2.5, 2), (-2.5, 3), (2.5, 3), (2.5, 2), (0.5, 2), (0.5, 0)]
    ax.plot(*zip(*walls, walls[0], strict=True), color="0.2", lw=2)
    ax.plot(0, 0.5, marker="^", ms=14, color="#D55E00")
    for x, name in ((-2, "reward\nhere?"), (2, "or\nhere?")):
        ax.text(x, 2.5, name, ha="center", va="center", fontsize=9)
    for x, arrow, name, color in (
        (-0.6, "→", "landmark", "#009E73"),
        (0.6, "←", "cue", "#CC79A7"),
    ):
        ax.text(x, 3.05, arrow, ha="center", va="bottom", fontsize=20, color=color)
        ax.text(x, 3.65, name, ha="center", va="bottom", fontsize=9)
    ax.text(0.75, 0.5, "start", va="center", fontsize=9)
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
    ax.legend(fontsize=8)
    return fig
