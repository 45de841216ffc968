"""Figures and films of the chapter on doors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from experiments import figures, pictures
from experiments.doors.arms import NAMES, PUBLISHED, cell_of, rate
from experiments.doors.success import (
    TEST_FRICTIONS,
    Cell,
    door_seeds,
    load_players,
    most_likely,
    scripted,
)
from experiments.doors.training import CURVE_FRICTION, TRAIN_FRICTIONS
from experiments.doors.ways import STRATEGIES, TRAITS, success_by_lever, trait_correlations
from ipo.worlds.door import GEAR
from ipo.worlds.one_door import DoorEnv


def color(cell: Cell) -> str:
    """Of the method that was trained."""
    return figures.STYLES[cell.trained.label][1]


# ------------------------------------------------------------------------------- episodes


@dataclass(frozen=True)
class Episode:
    """The joints ``[7]`` after every step until the door is open, or the time is up."""

    joints: list[np.ndarray]
    handle_shift: np.ndarray
    opened: bool

    def drawn(
        self, picture: pictures.DoorPicture | pictures.Blank, steps: Sequence[int]
    ) -> list[np.ndarray]:
        """Frames of some of the steps."""
        return [picture.frame(self.joints[step], self.handle_shift) for step in steps]


def play(
    env: DoorEnv,
    door_seed: int,
    act: Callable[[np.ndarray], np.ndarray] | None = None,
) -> Episode:
    """An episode at the door of a seed; without ``act``, of the controller by hand."""
    observation, _ = env.reset(seed=door_seed)
    act = act or scripted(env)
    joints = [env.data.qpos.copy()]
    while True:
        observation, _, _, truncated, info = env.step(act(observation))
        joints.append(env.data.qpos.copy())
        if info["opened"] or truncated:
            return Episode(joints, env.handle_shift, info["opened"])


def task(door_seed: int) -> Figure:
    """A door before and after the controller by hand has opened it, and how it holds on."""
    env = DoorEnv(friction=0.1)
    episode = play(env, door_seed)
    room = pictures.camera(env.params, "room", 480, 360)
    near = pictures.camera(env.params, "handle", 480, 360)
    before, after = episode.drawn(room, (0, -1))
    (held,) = episode.drawn(near, (-1,))
    views = [("before", before), ("the hook behind the handle", held), ("opened", after)]
    return pictures.titled(views, 1, (10, 2.7))


def some_doors(seeds: Sequence[int]) -> Figure:
    """Doors at the beginning of their episodes, with their lever arms."""
    views = []
    for seed in seeds:
        env = DoorEnv(friction=0.0)
        env.reset(seed=seed)
        title = f"lever arm {env.params.lever_arm - env.handle_shift[0]:.2f} m"
        picture = pictures.camera(env.params, "room")
        views.append((title, picture.frame(env.data.qpos, env.handle_shift)))
    return pictures.titled(views, 2, (10, 4.2))


def strategy_sheet(
    examples: Sequence[pd.Series],
    arms: Mapping[str, Cell],
    policies: str | Path,
    num_frames: int = 6,
    num_steps: int = 60,
) -> Figure:
    """Film strips of how doors are opened: the last steps until the door is open.

    An example is a row of :func:`experiments.doors.ways.opened_parts`.
    """
    num_rows = max(len(examples), 1)
    fig, axes = plt.subplots(num_rows, num_frames, figsize=(9, 1.15 * num_rows), squeeze=False)
    for ax in axes.flat:
        ax.axis("off")
    for line, row in zip(axes, examples, strict=False):
        act = most_likely(load_players(cell_of(row, arms), row["run"], policies))
        env = DoorEnv(friction=float(row["domain"]))
        episode = play(env, door_seeds(row["door"] + 1)[-1], act)
        length = len(episode.joints)
        steps = np.linspace(max(length - num_steps, 0), length - 1, num_frames).round().astype(int)
        for ax, frame in zip(line, episode.drawn(pictures.camera(env.params), steps), strict=True):
            ax.imshow(frame)
        line[0].text(
            -0.06, 0.5,
            f"{row['strategy']}\n{row['value']:.0%} inside\n{row['method'].upper()} {row['run']}",
            transform=line[0].transAxes, ha="right", va="center", fontsize="small",
        )  # fmt: skip
    fig.get_layout_engine().set(w_pad=0.01, h_pad=0.01, wspace=0, hspace=0)
    return fig


@dataclass(frozen=True)
class Film:
    """The frames of one run's episode.

    Attributes:
        place: of the run among all runs of its arm.
    """

    place: str
    run: int
    opened: bool
    frames: list[np.ndarray]


def ranked(by_run: pd.Series) -> dict[str, int]:
    """The best, the median and the worst run."""
    order = by_run.sort_values(ascending=False, kind="stable").index
    return {"best": order[0], "median": order[len(order) // 2], "worst": order[-1]}


def filmed(
    cell: Cell,
    runs: Mapping[str, int],
    friction: float,
    door_seed: int,
    policies: str | Path,
    every: int,
) -> list[Film]:
    """Films of some runs of an arm at the same door; ``runs`` by their places."""
    env = DoorEnv(friction=friction)
    env.reset(seed=door_seed)
    picture = pictures.camera(env.params)
    films = []
    for place, run in runs.items():
        episode = play(env, door_seed, most_likely(load_players(cell, run, policies)))
        end = len(episode.joints) - 1
        frames = episode.drawn(picture, [*range(0, end, every), end])
        films.append(Film(place, run, episode.opened, frames))
    return films


def film_page(films: Mapping[tuple[str, float], Sequence[Film]], every: int) -> str:
    """HTML of films, by arm and friction: those of an arm's runs side by side."""
    page = []
    for (arm, friction), row in films.items():
        ends = ", ".join(
            f"{film.place} run {film.run} {'opens it' if film.opened else 'does not'}"
            for film in row
        )
        frames = pictures.side_by_side([film.frames for film in row])
        text = f"{NAMES[arm]}, friction {friction}: {ends}."
        page.append(pictures.video(frames, text, fps=50 / every))
    return "".join(page)


def median_strips(
    films: Mapping[tuple[str, float], Sequence[Film]], arms: Mapping[str, Cell], every: int
) -> Figure:
    """The median runs of both methods as published, as film strips."""
    rows = {
        f"{arms[arm].trained.label.upper()}, {friction}": film.frames
        for (arm, friction), row in films.items()
        for film in row
        if arm in PUBLISHED and film.place == "median"
    }
    return pictures.film_strip(rows, steps_per_frame=every)


# ------------------------------------------------------------------------------- rows


def torque(doors: pd.DataFrame, by_hand: pd.Series) -> Figure:
    """Lever arms, and the share of the doors that one motor and the controller by hand open."""
    fig, (left, right) = plt.subplots(1, 2, figsize=(9.5, 3.4))
    left.hist(doors["lever"], bins=np.arange(0.4, 1.25, 0.05), color="0.75")
    for friction, shade in zip((1.1, 1.5, 2.0), ("#56B4E9", "#0072B2", "black"), strict=True):
        left.axvline(friction / GEAR, color=shade, label=f"{friction} N m / {GEAR:g} N")
    left.set(xlabel="lever arm [m]", ylabel="doors")
    left.legend(title="needed", fontsize="small")
    grid = np.linspace(0, 3, 200)
    enough = [(doors["lever"] * GEAR > friction).mean() for friction in grid]
    right.plot(grid, enough, color="0.5", label="one motor is strong enough")
    right.plot(by_hand.index, by_hand, color="black", marker="o", ms=4, label="controller by hand")
    right.axvspan(min(TEST_FRICTIONS), max(TEST_FRICTIONS), color="0.93", zorder=0)
    right.set(xlabel="friction [N m]", ylabel="share of the doors")
    right.legend(fontsize="small")
    return fig


def every_run(
    success: pd.DataFrame,
    arms: Mapping[str, Cell],
    tested: Sequence[float],
    paper: pd.DataFrame,
    by_hand: pd.Series,
) -> Figure:
    """Doors opened by every run, a panel for each friction."""
    fig, axes = plt.subplots(1, len(tested), figsize=(11, 3.8), sharey=True, squeeze=False)
    for ax, f in zip(axes[0], tested, strict=True):
        runs = {arm: 100 * rate(success, cell, f).to_numpy() for arm, cell in arms.items()}
        figures.draw_runs(ax, runs, NAMES)
        ax.axhline(100 * by_hand[f], color="0.5", lw=1, ls=":")
        for arm in PUBLISHED:
            method, place = arms[arm].trained.label, list(arms).index(arm) - 0.35
            point = paper[(paper["method"] == method) & (paper["domain"] == str(f))]
            ax.scatter(place, 100 * point["mean"], s=60, facecolors="none", edgecolors="0.35")
        ax.set_title(f"friction {f}", fontsize="medium")
        ax.tick_params(axis="x", labelsize="small", rotation=90)
    axes[0, 0].set_ylabel("doors opened [%]")
    return fig


def power(gaps: np.ndarray, tested: Sequence[float], paper: pd.DataFrame) -> Figure:
    """Gaps ``[frictions, draws]`` as bands over friction, beside the paper's."""
    means = paper.set_index(["method", "domain"])["mean"]
    theirs = [100 * (means["ipo", str(f)] - means["ppo", str(f)]) for f in tested]
    fig, ax = plt.subplots(figsize=(7.5, 3.6))
    blue = figures.STYLES["ipo"][1]
    for share, shade in ((95, 0.2), (50, 0.3)):
        low, high = np.percentile(gaps, [50 - share / 2, 50 + share / 2], axis=1)
        text = f"{share} % of draws"
        ax.fill_between(tested, low, high, color=blue, alpha=shade, lw=0, label=text)
    ax.plot(tested, gaps.mean(1), color=blue, label="mean")
    ax.plot(tested, theirs, "o", mfc="none", mec="0.3", ms=8, label="paper")
    ax.axhline(0, color="0.6", lw=1)
    ax.set(xlabel="friction", ylabel="IPO − PPO [points]", xticks=tested)
    ax.legend(fontsize="small", ncols=2)
    return fig


def robustness(
    policies: pd.DataFrame,
    doors: pd.DataFrame,
    arms: Mapping[str, Cell],
    easy: str,
    hard: str,
    hardest: float,
) -> Figure:
    """Success against the way of opening, over policies and door by door.

    Args:
        policies: :func:`experiments.doors.ways.parts_and_success`, at ``hard`` and ``hardest``.
        doors: :func:`experiments.doors.ways.same_doors`, at ``easy`` and ``hard``.
    """
    fig, (left, right) = plt.subplots(1, 2, figsize=(9.5, 3.7))
    for arm, cell in arms.items():
        found = policies[policies["arm"] == arm]
        filled = "none" if arm.endswith("half") else color(cell)
        left.scatter(
            found["part"], 100 * found["success"], s=36, facecolors=filled,
            edgecolors=color(cell), label=NAMES[arm],
        )  # fmt: skip
    left.set(
        xlabel=f"share of the pull by the hook's inside, friction {hard}",
        ylabel=f"opened at {hardest} [%]",
    )
    left.legend(fontsize="small")
    for column, kind in enumerate(STRATEGIES):
        opened = doors[doors["strategy"] == kind]["hard"]
        by_policy = 100 * opened.groupby(["method", "steps", "run"]).mean()
        place = column + np.random.default_rng(0).uniform(-0.2, 0.2, len(by_policy))
        right.scatter(place, by_policy, s=14, alpha=0.5, color="0.3", lw=0)
        mean = 100 * opened.mean()
        right.plot([column - 0.3, column + 0.3], [mean, mean], color="black", lw=2)
    right.set_xticks(range(len(STRATEGIES)), STRATEGIES)
    right.set(
        xlabel=f"how the door was opened at {easy}", ylabel=f"the same door opened at {hard} [%]"
    )
    return fig


def learning(curves: pd.DataFrame) -> Figure:
    """Return and success in training, and success at a friction that is not trained on."""
    trained = TRAIN_FRICTIONS[-1]
    fig, axes = plt.subplots(1, 3, figsize=(11, 3.3))
    panels = (
        ("return", trained, f"return, friction {trained}"),
        ("success", trained, f"training doors opened, friction {trained}"),
        ("success_most_likely", CURVE_FRICTION, f"new doors opened, friction {CURVE_FRICTION}"),
    )
    for ax, (metric, friction, title) in zip(axes, panels, strict=True):
        rows = curves[curves["domain"] == str(friction)]
        rows = rows.assign(million=rows["frames"] / 1e6)
        figures.draw_metric(ax, rows, metric, "million", ("ppo", "ipo"), markevery=10_000)
        ax.set(title=title, xlabel="million steps")
    for ax in axes[1:]:
        ax.set_ylim(0, 1.02)
    axes[2].legend(fontsize="small", loc="lower right")
    return fig


def levers(
    success: pd.DataFrame, doors: pd.DataFrame, arms: Mapping[str, Cell], tested: Sequence[float]
) -> Figure:
    """Doors opened by lever arm, and which traits of a door go with success at the hardest."""
    fig, (left, right) = plt.subplots(1, 2, figsize=(10, 3.7))
    hardest, place = max(tested), np.arange(len(TRAITS))
    for arm, style, shift in zip(PUBLISHED, ("-", "--"), (-0.2, 0.2), strict=True):
        cell = arms[arm]
        for friction, width in zip((min(tested), hardest), (1, 2), strict=True):
            by_bin = success_by_lever(success, doors, cell, friction)
            left.plot(
                by_bin.index, 100 * by_bin, color=color(cell), ls=style, lw=width, marker="o",
                ms=4, label=f"{NAMES[arm]}, {friction}",
            )  # fmt: skip
        rho = trait_correlations(success, doors, cell, hardest)
        right.barh(place + shift, rho, 0.38, color=color(cell), label=NAMES[arm])
    left.set(xlabel="lever arm [m]", ylabel="doors opened [%]")
    left.legend(fontsize="small")
    right.set_yticks(place, TRAITS.values(), fontsize="small")
    right.invert_yaxis()
    right.set_xlabel(f"rank correlation with success at {hardest}")
    right.legend(fontsize="small")
    return fig
