"""What door policies are like: how they open doors, what their players do alone, where they fail.

Tables are data frames; numbers are dictionaries for :func:`experiments.chapter.numbers`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import scipy.stats
import torch

from experiments.doors.arms import NAMES, PUBLISHED, of_arm, percent, percent_with_interval, rate
from experiments.doors.pulling import strategy_of_part, strategy_of_policy
from experiments.doors.success import Cell, load_players
from experiments.doors.training import TRAIN_FRICTIONS
from experiments.tables import mean_and_std
from ipo.networks import Weights

STRATEGIES = ("hook", "mixed", "outside")
TRAITS = {
    "lever": "lever arm",
    "hinge_damping": "damping of the hinge",
    "hinge_stiffness": "spring of the hinge",
    "height": "height of the door",
    "density": "density of the door",
    "handle_diameter": "handle: diameter",
    "handle_depth": "handle: depth",
    "handle_half_length": "handle: length",
    "handle_fillet": "handle: bend",
    "shift_z": "handle: shift in height",
}
LEVER_BINS = (0.4, 0.6, 0.7, 0.8, 0.9, 1.0, 1.3)  # m

# -------------------------------------------------------------------------------- ways of opening


def opened_parts(watched: pd.DataFrame) -> pd.DataFrame:
    """The doors that were opened, with the part of the hook's inside and its ``strategy``."""
    parts = watched[watched["metric"] == "inside_part"]
    return parts.assign(strategy=parts["value"].map(strategy_of_part))


def strategy_examples(parts: pd.DataFrame, friction: float, number: int = 3) -> list[pd.Series]:
    """Doors opened in each way, each by another run, drawn without looking."""
    found = parts[parts["domain"] == str(friction)]
    mixed = [
        found[found["strategy"] == kind]
        .sample(frac=1, random_state=0)
        .drop_duplicates(["method", "run"])
        .head(number)
        for kind in STRATEGIES
    ]
    return [row for few in mixed for _, row in few.iterrows()]


def strategies(parts: pd.DataFrame, cell: Cell, friction: float) -> pd.Series:
    """The strategy of every run's policy."""
    return (
        of_arm(parts, cell, friction)
        .groupby("run")["value"]
        .agg(lambda parts: strategy_of_policy(parts.tolist()))
    )


def table_of_strategies(
    parts: pd.DataFrame, arms: Mapping[str, Cell], friction: float, paper: pd.DataFrame
) -> pd.DataFrame:
    """How many policies, and which part of the doors, by strategy; the paper's policies below."""
    rows = []
    for arm, cell in arms.items():
        ways = strategies(parts, cell, friction)
        doors = of_arm(parts, cell, friction)["strategy"].value_counts(normalize=True)
        rows.append(
            {"arm": NAMES[arm]}
            | {f"policies: {kind}": int((ways == kind).sum()) for kind in STRATEGIES}
            | {f"doors: {kind}": f"{doors.get(kind, 0):.0%}" for kind in STRATEGIES}
        )
    for method, found in paper.groupby("method", sort=False):
        runs = found.set_index("strategy")["runs"]
        rows.append(
            {"arm": f"{method.upper()}, the paper"}
            | {f"policies: {kind}": runs[kind] for kind in STRATEGIES}
            | {f"doors: {kind}": "" for kind in STRATEGIES}
        )
    return pd.DataFrame(rows)


def strategy_numbers(
    parts: pd.DataFrame, arms: Mapping[str, Cell], friction: float
) -> dict[str, int]:
    """Policies by strategy, and how many runs have the same strategy in two arms."""
    ways = {arm: strategies(parts, cell, friction) for arm, cell in arms.items()}

    def same(arm: str, other: str) -> int:
        return int((ways[arm] == ways[other].reindex(ways[arm].index)).sum())

    return {
        f"count_{arm}_{kind}": int((ways[arm] == kind).sum())
        for arm in ("ppo", "ipo_half", "ipo")
        for kind in STRATEGIES
    } | {
        "kept_ppo": same("ppo_half", "ppo"),
        "kept_ipo": same("ipo_half", "ipo"),
        "agree": same("ppo", "ipo_half"),
    }


def parts_and_success(
    parts: pd.DataFrame,
    success: pd.DataFrame,
    arms: Mapping[str, Cell],
    watched_at: float,
    tested_at: float,
) -> pd.DataFrame:
    """A row for every policy: ``arm``, its mean ``part`` and the ``success`` at another friction.

    Policies that opened no door have no row.
    """
    found = []
    for arm, cell in arms.items():
        part = of_arm(parts, cell, watched_at).groupby("run")["value"].mean()
        both = {"part": part, "success": rate(success, cell, tested_at).loc[part.index]}
        found.append(pd.DataFrame(both).assign(arm=arm))
    return pd.concat(found, ignore_index=True)


def same_doors(watched: pd.DataFrame, easy: float, hard: float) -> pd.DataFrame:
    """The ``strategy`` of doors opened at one friction, and whether they open at another, ``hard``.

    The index names the policy and the door.
    """
    index = ["method", "steps", "run", "door"]
    parts = opened_parts(watched)
    at_easy = parts[parts["domain"] == str(easy)].set_index(index)[["strategy"]]
    at_hard = watched[(watched["metric"] == "success") & (watched["domain"] == str(hard))]
    return at_easy.join(at_hard.set_index(index)["value"].rename("hard"))


def robustness_numbers(policies: pd.DataFrame, doors: pd.DataFrame) -> dict[str, float]:
    """Of :func:`parts_and_success` the rank correlation, of :func:`same_doors` means and counts."""
    rho, p = np.nan, np.nan
    if len(policies) > 2:
        rho, p = scipy.stats.spearmanr(policies["part"], policies["success"])
    found = {"rho": float(rho), "rho_p": float(p)}
    for kind in STRATEGIES:
        hard = doors[doors["strategy"] == kind]["hard"]
        found |= {f"hard_{kind}": hard.mean(), f"hard_{kind}_n": len(hard)}
    return found


# ---------------------------------------------------------------------------------------- players


def players_alone(cell: Cell, **options: Any) -> list[Cell]:
    """A cell for each player of an arm, who acts alone."""
    return [replace(cell, player=d, **options) for d in range(cell.num_players)]


def table_of_players(
    alone: pd.DataFrame, success: pd.DataFrame, cell: Cell, players: Sequence[Cell]
) -> pd.DataFrame:
    """Percent of the same doors opened by each player alone and by their average.

    Nothing stands at frictions at which the average was not tested.
    """
    average = success[success["door"] < players[0].num_doors]
    policies = {
        f"player of friction {friction}, alone": (alone, player)
        for friction, player in zip(TRAIN_FRICTIONS, players, strict=True)
    } | {"their average": (average, cell)}

    def opened(rows: pd.DataFrame, who: Cell, friction: float) -> str:
        found = rate(rows, who, friction)
        return percent(found) if len(found) else ""

    return pd.DataFrame(
        {"policy": name} | {f"opened at {f}": opened(rows, who, f) for f in players[0].frictions}
        for name, (rows, who) in policies.items()
    )


def player_numbers(
    alone: pd.DataFrame,
    arms: Mapping[str, Cell],
    players: Sequence[Cell],
    seeds: Sequence[int],
    policies: str | Path,
) -> dict[str, float]:
    """How far the two players of IPO are apart, and what each opens in its own domain."""
    found = {}
    for arm in ("ipo_half", "ipo"):
        pairs = [load_players(arms[arm], seed, policies) for seed in seeds]
        found[f"distance_{arm}"] = np.mean([distance(*pair) for pair in pairs])
    for d, (friction, player) in enumerate(zip(TRAIN_FRICTIONS, players, strict=True)):
        found[f"alone_{d}"] = of_arm(alone, player, friction)["value"].mean()
    return found


def distance(player: Weights, other: Weights) -> float:
    """Between two players' weights, relative to their mean length."""
    first, second = (torch.cat([w.flatten() for w in p.values()]) for p in (player, other))
    return float((first - second).norm() / ((first.norm() + second.norm()) / 2))


def relative_gains(gaps: pd.DataFrame) -> pd.DataFrame:
    """How much a player's return changes when it goes on alone: runs x domains."""
    returns = gaps.pivot(index=["run", "domain"], columns="metric", values="value")
    return ((returns["after"] - returns["before"]) / returns["before"].abs()).unstack()


def table_of_gains(gaps: pd.DataFrame) -> pd.DataFrame:
    """Returns of every player before and after it went on alone."""
    gains = relative_gains(gaps)

    def of(domain: str, metric: str) -> str:
        chosen = gaps[(gaps["domain"] == domain) & (gaps["metric"] == metric)]
        return mean_and_std(chosen["value"], 0)

    return pd.DataFrame(
        {
            "player": f"of friction {domain}",
            "return before": of(domain, "before"),
            "return after": of(domain, "after"),
            "relative change": f"{percent_with_interval(gains[domain])} %",
            "runs that gain": f"{(gains[domain] > 0).sum()} of {len(gains)}",
        }
        for domain in gains
    )


# -------------------------------------------------------------------------------- traits of doors


def success_by_lever(
    success: pd.DataFrame, doors: pd.DataFrame, cell: Cell, friction: float
) -> pd.Series:
    """Part of the doors opened, by the mean lever arm of bins of doors."""
    rows = success.merge(doors[["door", "lever"]], on="door")
    bins = rows.groupby(pd.cut(rows["lever"], LEVER_BINS), observed=True)
    rows["bin"] = bins["lever"].transform("mean")
    return of_arm(rows, cell, friction).groupby("bin")["value"].mean()


def trait_correlations(
    success: pd.DataFrame, doors: pd.DataFrame, cell: Cell, friction: float
) -> pd.Series:
    """Rank correlation over doors between a trait and the part of the runs that open them."""
    by_door = of_arm(success, cell, friction).groupby("door")["value"].mean()
    table = doors.set_index("door").loc[by_door.index]
    return pd.Series({trait: table[trait].rank().corr(by_door.rank()) for trait in TRAITS})


def lever_numbers(
    success: pd.DataFrame, doors: pd.DataFrame, arms: Mapping[str, Cell], friction: float
) -> dict[str, float]:
    """PPO on the shortest and the longest lever arms, and correlations, of the lever and others."""
    heavy = success_by_lever(success, doors, arms["ppo"], friction)
    rho = {arm: trait_correlations(success, doors, arms[arm], friction) for arm in PUBLISHED}
    return {
        "short_levers": heavy.iloc[0],
        "long_levers": heavy.iloc[-1],
        "rho_lever": rho["ppo"]["lever"],
        "rho_others": max(rho[arm].drop("lever").abs().max() for arm in PUBLISHED),
    }
