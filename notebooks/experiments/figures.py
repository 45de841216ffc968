"""Figures from tidy rows. The only module besides ``render`` that imports matplotlib."""

from __future__ import annotations

import itertools
import textwrap
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib.colors
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from IPython import get_ipython
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib_inline.config import InlineBackend

from experiments import narrow
from ipo.causality.scm import SCM
from ipo.networks import Network
from ipo.stats import mean_interval

# Colours of Okabe and Ito, which colour-blind readers can tell apart; markers for print.
STYLES = {
    "gradient_descent": ("gradient descent", "#D55E00", "o"),
    "overparameterized": ("overparameterised", "#E69F00", "s"),
    "ipo_fixed_phi": ("IPO, fixed Φ", "#0072B2", "^"),
    "ipo_variable_phi": ("IPO, variable Φ", "#56B4E9", "v"),
    "minimum_norm": ("minimum norm, closed form", "#009E73", "D"),
    "oracle": ("oracle", "#000000", "_"),
    "ppo": ("PPO", "#D55E00", "o"),
    "ipo": ("IPO", "#0072B2", "^"),
    "ensemble": ("ensemble, pooled data", "#E69F00", "s"),
    "erm": ("ERM", "#D55E00", "o"),
    "icp": ("ICP", "#009E73", "D"),
    "irmv1": ("IRMv1", "#CC79A7", "P"),
    "vrex": ("V-REx", "#E69F00", "s"),
    "irm_game_fixed_phi": ("IRM-Games, fixed Φ", "#0072B2", "^"),
    "irm_game_variable_phi": ("IRM-Games, variable Φ", "#56B4E9", "v"),
}

# Where two methods are compared problem by problem; the same order in legends and tables.
OUTCOMES = {
    "IPO better": "#0072B2",
    "tie": "#B8BBC0",
    "IPO worse": "#D55E00",
    "both unstable": "#30343A",
}

# Letters on a colour: no true greys, which change places on a page in dark mode.
WHITE, BLACK = "#fffffe", "#000001"

# Letters are large for the printed size: a page shows a figure smaller than it is drawn.
STYLE = {
    "figure.dpi": 110,
    "savefig.dpi": 160,
    "font.size": 11.5,
    "xtick.labelsize": 10.5,
    "ytick.labelsize": 10.5,
    "legend.fontsize": 10.5,
    "axes.titlesize": 11.5,
    "svg.hashsalt": "ipo",  # the same figure is the same file
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "legend.frameon": False,
    "figure.constrained_layout.use": True,
    "figure.facecolor": "white",
}


def set_up() -> None:
    """The book's style; in a notebook, figures are vectors, for wide screens and for phones."""
    plt.rcParams.update(STYLE)
    if shell := get_ipython():
        InlineBackend.instance(parent=shell).figure_formats = {"svg"}
        shell.display_formatter.formatters["image/svg+xml"].for_type(Figure, narrow.both)


def label(method: str) -> str:
    """The name of a method in figures and tables."""
    return STYLES[method][0] if method in STYLES else method.replace("_", " ")


def metric_by(rows: pd.DataFrame, metric: str, x: str) -> pd.DataFrame:
    """One row per method and ``x`` with ``mean, low, high``: a 95 % interval over runs."""

    def summary(values: pd.Series) -> pd.Series:
        low, high = mean_interval(values.to_numpy())
        return pd.Series({"mean": values.mean(), "low": low, "high": high})

    chosen = rows[rows["metric"] == metric]
    return chosen.groupby(["method", x])["value"].apply(summary).unstack().reset_index()


def draw_metric(
    ax: Axes, rows: pd.DataFrame, metric: str, x: str, methods: Sequence[str], **options
) -> None:
    """A line per method with its interval over runs as a band."""
    summary = metric_by(rows, metric, x)
    for method in methods:
        line = summary[summary["method"] == method].sort_values(x)
        name, color, marker = STYLES[method]
        ax.plot(line[x], line["mean"], color=color, marker=marker, ms=5, label=name, **options)
        ax.fill_between(line[x], line["low"], line["high"], color=color, alpha=0.2, lw=0)


def draw_paper(ax: Axes, paper: pd.DataFrame, x: str, methods: Sequence[str]) -> None:
    """The paper's means as hollow circles."""
    for method in methods:
        points = paper[paper["method"] == method]
        ax.scatter(points[x], points["mean"], s=70, facecolors="none", edgecolors="0.35", zorder=3)
    ax.scatter([], [], s=70, facecolors="none", edgecolors="0.35", label="paper")


def draw_oracle(ax: Axes, cost: float) -> None:
    ax.axhline(cost, color="black", lw=1, ls="--", label="oracle")


def draw_runs(ax: Axes, values: dict[str, np.ndarray], names: dict[str, str]) -> None:
    """Every run of every arm as a point, and the mean with its 95 % interval as a bar.

    An arm has the colour of its method, which its key begins with: ``ppo_lr5e-4``.
    """
    rng = np.random.default_rng(0)
    for column, (arm, runs) in enumerate(values.items()):
        color = STYLES[arm.split("_")[0]][1]
        place = column + rng.uniform(-0.2, 0.2, len(runs))
        ax.scatter(place, runs, s=12, alpha=0.5, lw=0, color=color)
        low, high = mean_interval(runs)
        ax.plot([column + 0.3] * 2, [low, high], color="black", lw=2)
        ax.plot(column + 0.3, runs.mean(), color="black", marker="o", ms=5)
    ax.set_xticks(range(len(values)), [textwrap.fill(names[arm], 13) for arm in values])
    ax.grid(axis="x", visible=False)


def observations(panels: dict[str, np.ndarray], dim_state: int) -> Figure:
    """What the agent sees over time in several domains: ``{title: [time, n_o]}``."""
    fig, axes = plt.subplots(1, len(panels), figsize=(9, 4.2), sharey=True, squeeze=False)
    limit = max(np.abs(panel).max() for panel in panels.values())
    for ax, (title, panel) in zip(axes[0], panels.items(), strict=True):
        picture = ax.imshow(
            panel.T, aspect="auto", cmap="RdBu_r", vmin=-limit, vmax=limit, interpolation="nearest"
        )
        ax.axhline(dim_state - 0.5, color="black", lw=1.5)
        ax.set(title=title, xlabel="time step")
        ax.grid(False)
    axes[0, 0].set_ylabel("observation $o_t$")
    middles = {"$W_c s$: state": dim_state / 2}
    middles["$D_d s$: distractor"] = (dim_state + panel.shape[1]) / 2
    for text, middle in middles.items():
        axes[0, 0].text(
            0.98, middle, text, ha="right", va="center",
            transform=axes[0, 0].get_yaxis_transform(),
            bbox={"facecolor": "white", "alpha": 0.85, "edgecolor": "none", "pad": 2},
        )  # fmt: skip
    fig.colorbar(picture, ax=axes[0], label="value", shrink=0.8)
    return fig


def draw_two_players(
    ax: Axes,
    wishes: Sequence[float],
    bound: float | None,
    paths: Sequence[np.ndarray],
    limit: float,
) -> None:
    """Two players with one weight each: vector field, best responses, bound and trajectories.

    Player d wants the average ``(u + v) / 2`` at ``wishes[d]``; a path is ``[time, 2]``.
    """
    grid = np.linspace(-limit, limit, 13)
    u, v = np.meshgrid(grid, grid)
    push = [wish - (u + v) / 2 for wish in wishes]
    length = np.hypot(*push) + 1e-9
    ax.quiver(u, v, push[0] / length, push[1] / length, color="0.7", width=0.004, scale=26)
    for wish, color, name in zip(wishes, ("#D55E00", "#0072B2"), ("1", "2"), strict=True):
        ax.plot(grid, 2 * wish - grid, color=color, lw=1.5, label=f"best response of player {name}")
    if bound is not None:
        ax.add_patch(plt.Rectangle((-bound, -bound), 2 * bound, 2 * bound, fill=False, lw=1.5))
    for path in paths:
        ax.plot(*path.T, color="black", lw=1)
        ax.plot(*path[0], color="black", marker=".", ms=6)
        inside = np.abs(path[-1]).max() < limit
        ax.plot(*path[-1], color="#009E73", marker="o", ms=8, zorder=3) if inside else None
    ax.set(xlim=(-limit, limit), ylim=(-limit, limit), aspect="equal")
    ax.grid(False)


def draw_outcomes(ax: Axes, outcomes: np.ndarray, values: np.ndarray) -> None:
    """A phase diagram: ``outcomes [rows, columns]`` are keys of :data:`OUTCOMES`."""
    names = list(OUTCOMES)
    numbers = np.vectorize(names.index)(outcomes)
    half = (values[1] - values[0]) / 2
    extent = (values[0] - half, values[-1] + half) * 2
    colors = matplotlib.colors.ListedColormap(OUTCOMES.values())
    ax.imshow(numbers, cmap=colors, vmin=-0.5, vmax=len(names) - 0.5, origin="lower", extent=extent)
    ax.grid(False)


def draw_network(ax: Axes, network: Network) -> None:
    """The layers of an actor-critic as boxes, with their sizes, and what goes where: downwards."""
    nodes, edges = network_graph(network)
    nodes = {name: (height, -depth) for name, (depth, height) in nodes.items()}
    for start, end in edges:
        ax.annotate(
            "", xy=nodes[end], xytext=nodes[start],
            arrowprops={"arrowstyle": "->", "shrinkA": 20, "shrinkB": 20, "color": "0.3"},
        )  # fmt: skip
    for name, (x, y) in nodes.items():
        color = "#D55E00" if "actor" in name else "#0072B2" if "critic" in name else "#009E73"
        shape = network.shapes.get(name)
        text = f"{name}\n{shape[0]} → {shape[1]}" if shape else name
        ax.text(
            x, y, text, ha="center", va="center", fontsize="medium",
            bbox={"boxstyle": "round,pad=0.4", "facecolor": "white", "edgecolor": color, "lw": 1.5},
        )  # fmt: skip
    ax.set(xlim=(-1.6, 1.6), ylim=(min(y for _, y in nodes.values()) - 0.5, 0.5))
    ax.axis("off")


def network_graph(
    network: Network,
) -> tuple[dict[str, tuple[float, float]], list[tuple[str, str]]]:
    """Nodes ``{layer: place}`` and edges of an actor-critic, from the names of its layers.

    Layers that belong to neither actor nor critic come first, one after the other; the actor's
    and the critic's layers follow, each in their own chain.
    """
    parts = {"actor": [], "critic": [], "trunk": []}
    for name in network.shapes:
        part = next((part for part in ("actor", "critic") if name.startswith(part)), "trunk")
        parts[part].append(name)
    trunk = ["observation", *parts["trunk"]]
    nodes = {name: (float(x), 0.0) for x, name in enumerate(trunk)}
    edges = list(itertools.pairwise(trunk))
    for height, part, output in ((1.0, "actor", "scores"), (-1.0, "critic", "value")):
        chain = [*parts[part], output]
        nodes |= {name: (len(trunk) + float(x), height) for x, name in enumerate(chain)}
        edges += itertools.pairwise([trunk[-1], *chain])
    return nodes, edges


def trajectories(rows: pd.DataFrame, oracle: str) -> Figure:
    """``|s_t|^2`` over time by method: quantiles ``energy_q05, _q50, _q95`` over starts."""
    fig, ax = plt.subplots(figsize=(7, 3.8))
    for method, energy in rows.groupby("method", sort=False):
        name, color, _ = STYLES[method]
        low, middle, high = energy.pivot(index="metric", columns="step", values="value").to_numpy()
        steps = np.arange(len(middle))
        ax.plot(steps, middle, color=color, label=name, ls="--" if method == oracle else "-")
        ax.fill_between(steps, low, high, color=color, alpha=0.15, lw=0)
    ax.set(yscale="log", xlabel="time step", ylabel="$|s_t|^2$", ylim=(1e-6, None))
    ax.legend()
    return fig


def draw_optimizers(ax: Axes, points: pd.DataFrame, x: str, y: str) -> None:
    """Every run as a point: a colour per method, a mark per optimiser.

    Runs with plain steps and L-BFGS have large hollow marks and crosses, for they may coincide.
    """
    for (method, optimizer), runs in points.groupby(["method", "optimizer"]):
        name, color, marker = STYLES[method]
        hollow = {"marker": marker, "facecolors": "none", "edgecolors": color}
        look = {
            "adam": {"s": 22, "marker": marker, "facecolors": color, "alpha": 0.8},
            "none": {"s": 18, "marker": marker, "facecolors": color},
            "plain": {"s": 110, **hollow},
            "lbfgs": {"s": 110, "marker": "x", "color": color, "lw": 1},
        }[optimizer]
        suffix = {"adam": ", Adam", "none": "", "plain": ", plain", "lbfgs": ", L-BFGS"}[optimizer]
        ax.scatter(runs[x], runs[y], label=name + suffix, **look)


class Advantage(NamedTuple):
    """How much better one method is than another, with its 95 % interval; the paper's is 1."""

    label: str
    mean: float
    low: float
    high: float


def draw_advantages(rows: Sequence[Advantage]) -> Figure:
    """Advantages below each other, beside none and the paper's: as wide as a phone is."""
    with plt.rc_context(STYLE):
        fig, ax = plt.subplots(figsize=(6.4, 0.36 * len(rows) + 0.8))
    for place, row in enumerate(reversed(rows)):
        ax.plot([row.low, row.high], [place, place], color="#0072B2", lw=3, alpha=0.45)
        ax.plot(row.mean, place, color="#0072B2", marker="o", ms=8)
    ax.axvline(0, color="0.35", lw=1)
    ax.axvline(1, color="0.35", lw=1, ls="--")
    ax.set_yticks(range(len(rows)), [row.label for row in reversed(rows)])
    ax.set_ylim(-0.6, len(rows) - 0.4)
    top = ax.secondary_xaxis("top")
    top.set_xticks([0, 1], ["none", "the paper's"])
    top.tick_params(length=0)
    top.spines["top"].set_visible(False)
    ax.set_xlabel("advantage of IPO, in multiples of the paper's")
    ax.grid(axis="y", visible=False)
    return fig


def save(fig: Figure, path: Path) -> None:
    """The same figure gives the same file."""
    with plt.rc_context(STYLE):
        fig.savefig(path, metadata={"Date": None}, bbox_inches="tight")
    plt.close(fig)


def causal_graph(
    ax: Axes,
    model: SCM,
    positions: Mapping[str, tuple[float, float]],
    labels: Mapping[str, str] | None = None,
    hidden: Collection[str] = (),
    changed: Collection[str] = (),
) -> None:
    """The graph of a structural causal model: a circle for each variable, an arrow to each effect.

    Nodes and edges come from the model; only where they stand is given. Hidden variables have
    dashed circles, those intervened on are filled.

    Raises:
        ValueError: a variable without a position.
    """
    missing = [name for name in model.assignments if name not in positions]
    if missing:
        raise ValueError(f"positions: has none for {missing[0]!r}, must have one for each variable")
    for cause, effect in model.edges:
        ax.annotate(
            "",
            xy=positions[effect],
            xytext=positions[cause],
            arrowprops={"arrowstyle": "-|>", "color": "0.25", "shrinkA": 17, "shrinkB": 17},
            gid=f"{cause}->{effect}",
        )
    for name in model.assignments:
        x, y = positions[name]
        face = "#F0E442" if name in changed else "white"
        line = "--" if name in hidden else "-"
        # Drawn as a marker, so that it stays round and as large as the letters in it.
        ax.scatter(
            x, y, s=900, facecolor=face, edgecolor="black", linestyle=line, zorder=2, gid=name
        )
        text = (labels or {}).get(name, f"${name}$")
        ink = BLACK if name in changed else "black"
        ax.text(x, y, text, ha="center", va="center", zorder=3, color=ink)
    ax.margins(0.25)
    ax.axis("off")


def interval_lines(
    ax: Axes, rows: pd.DataFrame, metric: str, x: str, methods: Sequence[str], baseline: float
) -> None:
    """:func:`draw_metric` with a dashed line for a predictor from the causes."""
    draw_metric(ax, rows, metric, x, [m for m in methods if m in set(rows["method"])])
    ax.axhline(baseline, color="black", lw=1, ls="--", label="from the causes")


def write_numbers(
    ax: Axes, cells: np.ndarray, light: np.ndarray, form: str = "{}", fontsize: str = "small"
) -> None:
    """The numbers of a picture ``[rows, columns]`` in its cells, white where it is dark.

    ``light`` says where to write in white; nothing is written where a number is NaN.
    """
    for (y, x), value in np.ndenumerate(cells):
        if not np.isnan(value):
            ink = WHITE if light[y, x] else BLACK
            text = form.format(value)
            ax.text(x, y, text, ha="center", va="center", fontsize=fontsize, color=ink)


def agents_view(picture: np.ndarray, image: np.ndarray) -> Figure:
    """A grid, and the three channels of MiniGrid's ``image [7, 7, 3]`` that is seen of it."""
    fig, axes = plt.subplots(1, 4, figsize=(10, 2.9))
    axes[0].imshow(picture)
    axes[0].set_title("grid, view highlighted", fontsize="medium")
    for ax, codes, name in zip(axes[1:], image.T, ("object", "colour", "state"), strict=True):
        ax.imshow(codes, cmap="viridis", vmin=0, vmax=10)
        write_numbers(ax, codes, light=codes < 7, fontsize="small")
        ax.set_title(name, fontsize="medium")
    for ax in axes:
        ax.axis("off")
    return fig


def draw_gaps(ax: Axes, gaps: np.ndarray, paper: float) -> None:
    """How differences of two arms are distributed, with the paper's in either direction."""
    ax.hist(gaps, bins=120, color="#0072B2", alpha=0.75)
    for gap, style in ((paper, "-"), (-paper, "--")):
        ax.axvline(gap, color="black", ls=style, label=f"{gap:+.2f}")
    ax.axvline(0, color="0.6", lw=1)
    ax.set(yticks=[])
    ax.legend(title="the paper's gap")


def time_in_cells(panels: Mapping[str, np.ndarray], phases: Sequence[str]) -> Figure:
    """Expected steps in each cell of a grid: ``{title: [phase, row, column]}``, a column each."""
    fig, axes = plt.subplots(len(phases), len(panels), figsize=(9, 6.6), sharex=True, sharey=True)
    top = max(grid.max() for grid in panels.values())
    for column, (title, grid) in zip(axes.T, panels.items(), strict=True):
        column[0].set_title(f"{title}: {grid.sum():.1f} steps", fontsize="medium")
        for ax, cells in zip(column, grid, strict=True):
            ax.set_facecolor("0.93")
            visited = np.where(cells > 0, cells, np.nan)
            picture = ax.imshow(visited, cmap="magma_r", norm="symlog", vmin=0, vmax=top)
            write_numbers(ax, np.where(cells >= 0.05, cells, np.nan), cells > 3, "{:.1f}")
            ax.set(xticks=[], yticks=[])
            ax.grid(False)
    for ax, phase in zip(axes[:, 0], phases, strict=True):
        ax.set_ylabel(phase)
    fig.colorbar(picture, ax=axes, label="expected steps", shrink=0.7)


def decision_process(process: SCM, policy: SCM) -> Figure:
    """Fig. 3 of the paper: two time steps of a decision process, and a policy in its two parts."""
    places = {"s_t": (0, 1), "z_t": (1, 2), "o_t": (1, 0), "a_t": (2, 0)}
    places |= {"r_t": (2, 2), "s_{t+1}": (3, 1)}
    fig, (left, right) = plt.subplots(1, 2, figsize=(7.5, 3.4), width_ratios=[3, 1])
    labels = {"z_t": r"$\tilde{s}_t$", "s_{t+1}": "$s_{t+1}$"}
    causal_graph(left, process, places, labels, changed={"o_t"})
    causal_graph(right, policy, {"o_t": (0, 0), "h_t": (0, 1), "a_t": (0, 2)})
    left.set_title("(a) the decision process")
    right.set_title("(b) the policy")
    right.set_xlim(-1, 1)
    right.text(0.15, 0.45, r"$\Phi$")
    right.text(0.15, 1.45, r"$\pi$")
    return fig


def draw_selected(ax: Axes, data: pd.DataFrame, x: str, y: str, kept: str) -> None:
    """Samples that ``kept`` keeps and others, in two colours, and a line fitted to the kept."""
    few = data.iloc[:1500]
    for value, color, name in ((0, "0.75", "failed"), (1, "#0072B2", "succeeded")):
        part = few[few[kept] == value]
        ax.scatter(part[x], part[y], s=8, color=color, label=name)
    slope, start = np.polyfit(*data[data[kept] == 1][[x, y]].to_numpy().T, 1)
    line = np.array([-1.5, 3])
    ax.plot(line, start + slope * line, color="black", label="fit to the successful")
    ax.legend(loc="lower left", fontsize="small")


def errors_by_strength(errors: Mapping[str, pd.DataFrame]) -> Figure:
    """A panel for each kind of intervention: a line per predictor, over the index ``strength``."""
    fig, axes = plt.subplots(1, len(errors), figsize=(10, 3.4), sharey=True)
    for ax, (title, table) in zip(axes, errors.items(), strict=True):
        for name, color in zip(table.columns, ("#0072B2", "#D55E00", "#009E73"), strict=True):
            ax.plot(table.index, table[name], color=color, label=name)
        ax.set(title=title, xlabel="strength of the intervention", ylim=(0, 6))
    axes[0].set_ylabel("mean squared error")
    axes[0].legend()
    return fig


def colored_digits(domains: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> Figure:
    """Ten digits of each domain and their labels: of 8x8 orange, then 8x8 blue pixels."""
    orange, blue = (0.84, 0.37, 0.0), (0.0, 0.45, 0.70)
    fig, axes = plt.subplots(len(domains), 10, figsize=(8, 3))
    for row, (name, (x, y)) in zip(axes, domains.items(), strict=True):
        for ax, features, label in zip(row, x, y, strict=False):
            inks = features[:128].reshape(2, 8, 8, 1) * (1 - np.array([[[orange]], [[blue]]]))
            ax.imshow(1 - inks.sum(0))
            ax.set_title(f"y = {label:.0f}", fontsize="small")
            ax.set(xticks=[], yticks=[])
            ax.grid(False)
        row[0].set_ylabel(name, fontsize="small")
    return fig


def errors_by_level(
    rows: pd.DataFrame, methods: Sequence[str], xlabel: str, ticks: Sequence[float] = ()
) -> Figure:
    """Test errors by what a problem varies; with ``ticks`` the axis is logarithmic."""
    fig, ax = plt.subplots(figsize=(6.5, 3.8))
    interval_lines(ax, rows, "test_risk", "level", methods, baseline=1.0)
    ax.set(xlabel=xlabel, ylabel="mean squared error, test domain", ylim=(0, None))
    ax.legend(fontsize="small", ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1))
    if ticks:
        ax.set_xscale("log")
        ax.set_xticks(ticks, ticks)
        ax.minorticks_off()
    return fig


def errors_by_penalty(rows: pd.DataFrame, oracle: float) -> Figure:
    """Errors of IRMv1 and V-REx, in the test domain and held out, by the weight of the penalty."""
    fig, axes = plt.subplots(1, 2, figsize=(8.5, 3.8), sharey=True)
    for ax, method in zip(axes, ("irmv1", "vrex"), strict=True):
        for metric, style in (("test_error", "-"), ("validation_error", ":")):
            draw_metric(ax, rows, metric, "penalty", [method], ls=style)
        ax.axhline(oracle, color="black", lw=1, ls="--")
        ax.set(xscale="log", title=label(method), xlabel="weight of the penalty λ", ylim=(0, 1))
    axes[0].set_ylabel("share of wrong labels")
    lines = ["test domain", "held out, training domains", "grey images, test domain"]
    axes[0].legend(axes[0].get_lines(), lines, fontsize="small")
    return fig
