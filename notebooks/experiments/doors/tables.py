"""Tables and numbers of the chapter on doors: training, doors opened, comparisons, cost.

Numbers are dictionaries for :func:`experiments.chapter.numbers`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import pandas as pd

from experiments.doors.arms import (
    CONTROLS,
    NAMES,
    PUBLISHED,
    mean_rate,
    percent,
    percent_with_interval,
    rate,
)
from experiments.doors.authors_policies import authors_policies
from experiments.doors.success import Cell
from experiments.doors.training import CURVE_FRICTION, EVALUATION_SEED, TRAIN_FRICTIONS, last_info
from experiments.tables import mean_and_std
from experiments.work import parallel
from ipo.ppo import PPOSettings
from ipo.stats import paired_difference, power, probability_of_improvement, runs_needed

PAIRS = {
    "published": ("ipo_half", "ppo"),
    "equal_full": ("ipo", "ppo"),
    "equal_half": ("ipo_half", "ppo_half"),
    "longer_ppo": ("ppo", "ppo_half"),
    "longer_ipo": ("ipo", "ipo_half"),
}


def training_numbers(curves: pd.DataFrame, arms: Mapping[str, Cell]) -> dict[str, float | str]:
    """Steps of a training in millions, the core-minutes it took, and the sizes of minibatches."""
    seconds = curves[curves["metric"] == "cpu_seconds"].groupby(["method", "run"])["value"].max()
    minutes = (seconds / 60).groupby("method").mean()
    return {
        "million": arms["ppo"].columns["steps"] / 1e6,
        "million_half": arms["ppo_half"].columns["steps"] / 1e6,
        "minibatch_ppo": minibatch_sizes(arms["ppo"].trained.settings),
        "minibatch_ipo": minibatch_sizes(arms["ipo"].trained.settings),
    } | {f"minutes_{method}": value for method, value in minutes.items()}


def minibatch_sizes(settings: PPOSettings) -> str:
    """Steps in a minibatch of each player."""
    copies = settings.copies(len(TRAIN_FRICTIONS))
    sizes = [settings.size_of_minibatches(settings.num_steps * sum(own)) for own in copies]
    return " and ".join(map(str, sizes))


def curve_numbers(curves: pd.DataFrame, num_frames: int) -> dict[str, float]:
    """Doors opened after some millions of steps, and deviations in the end, by method."""
    wanted = {
        **{f"train_{m}": (m, "success", TRAIN_FRICTIONS[-1]) for m in (2, 4, 5, 8, 10)},
        **{f"new_{m}": (m, "success_most_likely", CURVE_FRICTION) for m in (10, 25)},
        "deviation": (25, "deviation", "training"),
    }
    return {
        f"{name}_{method}": mean_after(
            curves[curves["method"] == method], metric, domain, min(million * 1e6, num_frames)
        )
        for method in ("ppo", "ipo")
        for name, (million, metric, domain) in wanted.items()
    }


def mean_after(curves: pd.DataFrame, metric: str, domain: float | str, frames: float) -> float:
    """Mean over runs at the first record after so many steps."""
    rows = curves[(curves["metric"] == metric) & (curves["domain"] == str(domain))]
    rows = rows[rows["frames"] >= frames]
    return rows[rows["frames"] == rows["frames"].min()]["value"].mean()


def table_4(
    success: pd.DataFrame,
    arms: Mapping[str, Cell],
    tested: Sequence[float],
    paper: pd.DataFrame,
    by_hand: pd.Series,
) -> pd.DataFrame:
    """Percent of doors opened, mean ± standard deviation over runs; the paper's numbers below."""
    rows = [
        {"arm": NAMES[arm]} | {str(f): percent(rate(success, cell, f)) for f in tested}
        for arm, cell in arms.items()
    ]
    for method in ("ppo", "ipo"):
        theirs = 100 * paper[paper["method"] == method].set_index("domain")[["mean", "std"]]
        rows.append(
            {"arm": f"{method.upper()}, the paper's numbers"}
            | {str(f): "{:.1f} ± {:.1f}".format(*theirs.loc[str(f)]) for f in tested}
        )
    hand = {str(f): f"{100 * by_hand[f]:.1f}" for f in tested}
    return pd.DataFrame([*rows, {"arm": "controller by hand"} | hand])


def table_of_authors(
    repository: str | Path, tested: Sequence[float], num_doors: int, num_workers: int
) -> pd.DataFrame:
    """Percent of our doors that the authors' own policies open."""
    saved = authors_policies(repository)
    jobs = [(m, str(f), players) for m in saved for f in tested for players in saved[m]]
    found = parallel(num_workers)(
        joblib.delayed(last_info)(players, float(f), num_doors, EVALUATION_SEED)
        for _, f, players in jobs
    )
    parts = [info["opened"].mean() for info in found]
    rates = pd.Series(parts, pd.MultiIndex.from_tuples([job[:2] for job in jobs]))
    return pd.DataFrame(
        {"arm": f"{m.upper()}, the paper's policies, here"}
        | {str(f): percent(rates[m, str(f)]) for f in tested}
        for m in saved
    )


def table_with_intervals(
    success: pd.DataFrame, arms: Mapping[str, Cell], frictions: Sequence[float]
) -> pd.DataFrame:
    """Percent of doors opened, mean and 95 % interval over runs."""
    return pd.DataFrame(
        {"arm": NAMES[arm]}
        | {str(f): percent_with_interval(rate(success, cell, f)) for f in frictions}
        for arm, cell in arms.items()
    )


def comparisons(
    success: pd.DataFrame,
    arms: Mapping[str, Cell],
    tested: Sequence[float],
) -> pd.DataFrame:
    """How many points more an arm opens than another, over all test frictions and at the hardest.

    A row for every pair of :data:`PAIRS` and both places; ``key`` is the name of its numbers.
    """
    hardest = max(tested)
    places = {"all": (tested, "1.1 to 1.5"), "hardest": ([hardest], str(hardest))}
    rows = []
    for pair, (arm, other) in PAIRS.items():
        for place, (frictions, text) in places.items():
            values, base = (mean_rate(success, arms[name], frictions) for name in (arm, other))
            found = paired_difference(100 * values, 100 * base)
            rows.append(
                {
                    "key": f"{pair}_{place}",
                    "difference": f"{NAMES[arm]} − {NAMES[other]}",
                    "frictions": text,
                    "mean": found.mean,
                    "95 %": f"[{found.low:+.1f}, {found.high:+.1f}]",
                    # The statistic is for costs, of which less is better.
                    "P(better)": probability_of_improvement(-values, -base),
                    "p": found.p,
                }
            )
    return pd.DataFrame(rows)


def comparison_numbers(compared: pd.DataFrame) -> dict[str, Any]:
    """Mean, interval and probability of every comparison."""
    columns = {"": "mean", "_interval": "95 %", "_better": "P(better)"}
    return {
        f"{row['key']}{end}": row[column]
        for _, row in compared.iterrows()
        for end, column in columns.items()
    }


def controlled(
    success: pd.DataFrame, arms: Mapping[str, Cell], tested: Sequence[float], effect: float
) -> pd.DataFrame:
    """How many points more IPO, as published, opens than what was trained as long.

    Paired over the runs that both have. ``power``: with which so many pairs, spread as they are,
    would find ``effect`` points; ``needed``: how many pairs find them with 80 %.
    """
    ipo = mean_rate(success, arms["ipo_half"], tested)
    rows = []
    for arm, name in CONTROLS.items():
        other = mean_rate(success, arms[arm], tested)
        runs = ipo.index.intersection(other.index)
        own, base = 100 * ipo[runs], 100 * other[runs]
        found, spread = paired_difference(own, base), (own - base).std()
        rows.append(
            {
                "key": arm,
                "IPO minus": name,
                "pairs": len(runs),
                "it opens": mean_and_std(base),
                "difference": found.mean,
                "95 %": f"[{found.low:+.1f}, {found.high:+.1f}]",
                "p": found.p,
                "power": power(effect, spread, len(runs)) if spread else 1.0,
                "needed": pairs_needed(effect, spread),
            }
        )
    return pd.DataFrame(rows)


def pairs_needed(effect: float, spread: float) -> int:
    """How many pairs find an effect with a power of 80 %; two, if they do not differ at all."""
    return runs_needed(effect, spread) if spread else 2


def control_numbers(controlled: pd.DataFrame) -> dict[str, Any]:
    """Difference, interval, power and pairs needed of every control."""
    columns = {"": "difference", "_interval": "95 %", "_power": "power", "_needed": "needed"}
    rows = controlled.set_index("key")
    return {
        f"control_{arm}{suffix}": rows.loc[arm, column]
        for arm in rows.index
        for suffix, column in columns.items()
    }


def gaps_of_draws(
    success: pd.DataFrame,
    arms: Mapping[str, Cell],
    tested: Sequence[float],
    rng: np.random.Generator,
    num_draws: int = 20_000,
    runs_per_arm: int = 5,
) -> np.ndarray:
    """IPO minus PPO, both as published, of some runs drawn again and again.

    Returns:
        percentage points ``[frictions, draws]``; a draw has the same runs at every friction.
    """
    means = {}
    for arm in ("ipo_half", "ppo"):
        by_run = np.stack([rate(success, arms[arm], f).to_numpy() for f in tested])
        chosen = rng.integers(by_run.shape[1], size=(num_draws, runs_per_arm))
        means[arm] = by_run[:, chosen].mean(-1)
    return 100 * (means["ipo_half"] - means["ppo"])


def verdict_numbers(
    success: pd.DataFrame,
    arms: Mapping[str, Cell],
    tested: Sequence[float],
    paper: pd.DataFrame,
) -> dict[str, float]:
    """Rates as published at the lowest and the highest test friction, worst runs, and effort."""
    means = paper.set_index(["method", "domain"])["mean"]
    found = {}
    for arm in PUBLISHED:
        by_run = mean_rate(success, arms[arm], tested)
        found |= {f"worst_{arm}": by_run.idxmin(), f"worst_rate_{arm}": by_run.min()}
        method = arms[arm].trained.label
        for friction, place in ((min(tested), "low"), (max(tested), "high")):
            found[f"rate_{arm}_{place}"] = 100 * rate(success, arms[arm], friction).mean()
            found[f"paper_{method}_{place}"] = 100 * means[method, str(friction)]
    steps = {arm: gradient_steps(arms[arm]) for arm in ("ppo", "ipo")}
    gap = paper_gap(paper, tested)
    ppo = mean_rate(success, arms["ppo"], tested)
    for name, arm in (("published", "ipo_half"), ("equal", "ipo")):
        spread = 100 * float((mean_rate(success, arms[arm], tested) - ppo).std())
        found[f"needed_{name}"] = pairs_needed(gap, spread)
    return found | {
        "paper_gap": gap,
        "tolerance": 100 * max(tolerances(success, arms, tested, paper)),
        "gradient_steps": steps["ppo"],
        "gradient_ratio": steps["ipo"] / steps["ppo"],
        "num_minibatches": arms["ipo"].trained.settings.num_minibatches,
    }


def tolerances(
    success: pd.DataFrame,
    arms: Mapping[str, Cell],
    tested: Sequence[float],
    paper: pd.DataFrame,
    num_paper_runs: int = 5,
) -> list[float]:
    """Two standard errors of the difference between our means and the paper's, as published."""
    spreads = paper.set_index(["method", "domain"])["std"]
    return [
        2
        * np.hypot(
            spreads[arms[arm].trained.label, str(friction)] / np.sqrt(num_paper_runs),
            rate(success, arms[arm], friction).sem(),
        )
        for arm in PUBLISHED
        for friction in tested
    ]


def paper_gap(paper: pd.DataFrame, tested: Sequence[float]) -> float:
    """How many points more the paper's IPO opens, mean over the test frictions."""
    means = paper.set_index(["method", "domain"])["mean"]
    return 100 * np.mean([means["ipo", str(f)] - means["ppo", str(f)] for f in tested])


def gradient_steps(cell: Cell) -> float:
    """Of all players in a training, in thousands."""
    settings = cell.trained.settings
    of_a_player = cell.updates * settings.num_epochs * settings.num_minibatches
    return of_a_player * cell.num_players / 1000


def table_of_choices(
    success: pd.DataFrame, last: pd.DataFrame, arms: Mapping[str, Cell], frictions: Sequence[float]
) -> pd.DataFrame:
    """Percent of doors opened by the best policy of a run and by its last."""
    return pd.DataFrame(
        {"arm": NAMES[arm]}
        | {f"best, {f}": percent(rate(success, cell, f)) for f in frictions}
        | {f"last, {f}": percent(rate(last, replace(cell, choice="last"), f)) for f in frictions}
        for arm, cell in arms.items()
    )


def bench_numbers(bench: Mapping[str, Any], num_updates: int = 190) -> dict[str, Any]:
    """Speeds and core-minutes of a training, from the record of the benchmark."""
    speeds = bench["speeds"]
    return {
        "speed": speeds["0.004 s, 32 doors"],
        "speed_fine": speeds["ratio to 0.001 s, 32 doors"],
        "speed_plain": speeds["ratio to 0.001 s, one by one"],
        "memory": bench["memory_gib"],
        "machine": bench["machine"],
        "runs_at_once": bench["runs_at_once"],
    } | {
        f"core_{method}_{way}": sum(parts.values()) * num_updates / 60
        for method, ways in bench["update_cpu_seconds"].items()
        for way, parts in ways.items()
    }
