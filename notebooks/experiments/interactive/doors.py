"""Which doors a run opens at a friction, by their lever arms, and a film of one of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from experiments import pictures
from experiments.doors.arms import NAMES, PUBLISHED, of_arm
from experiments.doors.figures import play
from experiments.doors.success import Cell, door_seeds, load_players, most_likely
from experiments.doors.ways import LEVER_BINS
from ipo.worlds.door import GEAR, MAX_STEPS
from ipo.worlds.one_door import DoorEnv

NUM_RUNS = 3  # the first ones of both arms, whatever came out


def doors_and_films(
    success: pd.DataFrame,
    doors: pd.DataFrame,
    arms: Mapping[str, Cell],
    frictions: Sequence[float],
    policies: str | Path,
    film_every: int,
) -> dict[str, Any]:
    """The data: per arm as published, run and friction, every door's end and a film of one door.

    The film is of the door that most divides the runs at the highest friction: the part of them
    that opens it is nearest to a half.

    Args:
        success: rows of the evaluation.
        doors: :func:`experiments.doors.success.evaluation_doors`.
        arms: by their names.
        frictions: that are shown.
        policies: folder of the saved policies.
        film_every: steps between two frames.
    """
    heavy = success[success["domain"] == str(max(frictions))].groupby("door")["value"].mean()
    filmed = int((heavy - 0.5).abs().idxmin())
    door_seed = door_seeds(len(doors))[filmed]
    films = {f: _Films(f, door_seed, film_every) for f in dict.fromkeys(frictions)}
    return {
        "arms": {arm: NAMES[arm] for arm in PUBLISHED},
        "levers": doors["lever"].round(4).tolist(),
        "filmed": filmed,
        "bins": list(LEVER_BINS),
        "gear": GEAR,
        "max_steps": MAX_STEPS,
        "cases": [
            {
                "arm": arm,
                "run": run,
                "friction": friction,
                "opened": _ends(success, arms[arm], run, friction),
                **films[friction].of(arms[arm], run, policies),
            }
            for arm in PUBLISHED
            for run in range(success["run"].nunique())[:NUM_RUNS]
            for friction in films
        ],
    }


def _ends(success: pd.DataFrame, cell: Cell, run: int, friction: float) -> str:
    """A digit for every door: 1, it was opened."""
    rows = of_arm(success, cell, friction)
    return "".join(
        f"{value:.0f}" for value in rows[rows["run"] == run].sort_values("door")["value"]
    )


class _Films:
    """Films of runs at one door and friction."""

    def __init__(self, friction: float, door_seed: int, every: int) -> None:
        self.env, self.door_seed, self.every = DoorEnv(friction=friction), door_seed, every
        self.env.reset(seed=door_seed)
        self.picture = pictures.camera(self.env.params, width=176, height=132)

    def of(self, cell: Cell, run: int, policies: str | Path) -> dict[str, Any]:
        act = most_likely(load_players(cell, run, policies))
        episode = play(self.env, self.door_seed, act)
        end = len(episode.joints) - 1
        frames = episode.drawn(self.picture, [*range(0, end, self.every), end])
        film = pictures.film_address(frames, fps=50 / self.every)
        return {"film": film, "steps": end, "film_opened": episode.opened}


def picture(data: Mapping[str, Any]) -> Figure:
    """Both arms' first runs at the last friction: doors opened by lever arm."""
    hardest = data["cases"][-1]["friction"]
    levers = np.array(data["levers"])
    fig, ax = plt.subplots(figsize=(6, 3))
    shown = [c for c in data["cases"] if (c["run"], c["friction"]) == (0, hardest)]
    for shift, case in enumerate(shown):
        opened = np.array([int(end) for end in case["opened"]])
        ax.plot(levers, opened + 0.07 * shift, "|", ms=9, label=data["arms"][case["arm"]])
    ax.axvline(hardest / data["gear"], color="black", ls="--", lw=1)
    ax.set_yticks([0, 1], ["not opened", "opened"])
    ax.set(xlabel="lever arm [m]", title=f"run 0, friction {hardest}", ylim=(-0.3, 1.5))
    ax.legend(loc="upper left", ncols=2, fontsize="small")
    return fig
