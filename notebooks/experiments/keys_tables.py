"""What is read off the rows of the coloured keys, and off their saved policies."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import scipy.special
import scipy.stats

from experiments.keys import ARMS, INSIDE, MAIN, TESTED, TRAINED, Keys, in_words, recolor
from experiments.tables import mean_and_std
from experiments.visits import occupancy
from ipo.networks import Weights
from ipo.stats import paired_difference, probability_of_improvement, runs_needed
from ipo.worlds.colored_keys import COLORS
from ipo.worlds.tabular import TabularTask, expected_return


def runs_of(rows: pd.DataFrame, method: str, color: str, metric: str = "return_exact") -> pd.Series:
    """Values of all runs of an arm in a colour's domain, by run."""
    chosen = rows[(rows["method"] == method) & (rows["domain"] == color)]
    return chosen[chosen["metric"] == metric].set_index("run")["value"].sort_index()


def table_by(
    rows: pd.DataFrame,
    names: Mapping[str, str],
    metric: str,
    colors: Sequence[str] = COLORS,
    paper: pd.DataFrame | None = None,
) -> pd.DataFrame:
    """Mean ± standard deviation over runs by arm and colour, and what the paper has for them."""
    chosen = rows[(rows["metric"] == metric) & rows["domain"].isin(colors)]
    table = chosen.groupby(["method", "domain"])["value"].apply(mean_and_std, 3).unstack()
    table = table.loc[list(names), list(colors)]
    if paper is not None:
        theirs = paper.pivot(index="method", columns="domain", values="text")
        for color in colors:
            table[f"{color}, paper"] = theirs[color].reindex(table.index).fillna("")
    return table.rename(index=names).rename_axis("arm").reset_index()


def by_update(both: pd.DataFrame) -> pd.DataFrame:
    """Live rows beside shipped ones, of curves of :data:`MAIN`: by arm and number of frames.

    Means over runs, shipped and live, and the largest difference of any run.
    """
    columns = {}
    groups = both.groupby(["domain", "method", "frames"], sort=False)
    means = groups[["shipped", "live"]].mean()
    for color in both["domain"].unique():
        columns[f"{color}, shipped"] = means.loc[color]["shipped"]
        columns[f"{color}, live"] = means.loc[color]["live"]
    by_arm = both.groupby(["method", "frames"], sort=False)
    columns["largest difference"] = by_arm["difference"].max()
    return pd.DataFrame(columns).rename(index=MAIN).rename_axis(["arm", "frames"]).reset_index()


def gap(rows: pd.DataFrame, method: str, baseline: str) -> str:
    """Difference of the exact returns on grey, paired by run, with its 95 % interval, in words."""
    mean, low, high, _ = paired_difference(*_on_grey(rows, method, baseline))
    return f"{mean:+.3f} [{low:+.3f}, {high:+.3f}]"


def comparison(rows: pd.DataFrame, pairs: Sequence[tuple[str, str]]) -> pd.DataFrame:
    """Exact returns on grey of pairs of arms: a row for each method and its baseline."""

    def row(method: str, baseline: str) -> dict[str, Any]:
        values, base = _on_grey(rows, method, baseline)
        mean, low, high, p = paired_difference(values, base)
        return {
            "difference on grey": f"{ARMS[method]} − {ARMS[baseline]}",
            "mean": mean,
            "95 % interval": f"[{low:+.3f}, {high:+.3f}]",
            # The function is for costs, where less is better.
            "P(improvement)": probability_of_improvement(-values, -base),
            "p": p,
        }

    return pd.DataFrame([row(*pair) for pair in pairs])


def two_by_two(rows: pd.DataFrame) -> pd.DataFrame:
    """Exact return on grey by the number of networks and what each learns from.

    All four arms have IPO's learning rate. Mean ± standard deviation over runs.
    """
    arms = {"one network": ("ppo_lr5e-4", "in_turn"), "two, averaged": ("ensemble", "ipo")}
    data = ("both colours at once", "one colour at a time")
    return pd.DataFrame(
        [
            {"networks": networks}
            | {
                column: mean_and_std(runs_of(rows, method, TESTED), 3)
                for column, method in zip(data, methods, strict=True)
            }
            for networks, methods in arms.items()
        ]
    )


def _on_grey(rows: pd.DataFrame, *methods: str, metric: str = "return_exact") -> list[pd.Series]:
    """Values of all runs of some arms in the test domain."""
    return [runs_of(rows, method, TESTED, metric) for method in methods]


def draws_of_ten(
    rows: pd.DataFrame, rng: np.random.Generator, num_draws: int = 100_000
) -> dict[str, np.ndarray]:
    """Experiments of the paper's size: ten of our runs ``[num_draws, 10]`` of IPO and of PPO.

    Their returns on grey by the published protocol; a run may be drawn more than once.
    """
    drawn = {}
    for method in ("ipo", "ppo"):
        values = runs_of(rows, method, TESTED, "return_published_protocol").to_numpy()
        drawn[method] = values[rng.integers(len(values), size=(num_draws, 10))]
    return drawn


def runs_for(difference: float, rows: pd.DataFrame) -> int:
    """Runs of IPO and of PPO that find such a difference on grey with a power of 80 % at 5 %.

    Runs are not paired: the variances of both arms add up.
    """
    variance = sum(values.var() for values in _on_grey(rows, "ipo", "ppo"))
    return runs_needed(difference, np.sqrt(variance))


def p_of_spreads(rows: pd.DataFrame, metric: str) -> float:
    """Brown-Forsythe test of whether IPO and PPO vary equally on grey, paired by run."""
    apart = [np.abs(own - np.median(own)) for own in _on_grey(rows, "ipo", "ppo", metric=metric)]
    return paired_difference(*apart).p


def encodings(
    main: pd.DataFrame, variants: pd.DataFrame, train_colors: Sequence[str] = TRAINED
) -> dict[str, tuple[str, pd.DataFrame, Sequence[str]]]:
    """What networks see of colours: title, rows and training colours by encoding.

    The rows have the ``code`` of their domain's colour, and arms go by their plain names.
    """

    def by_code(rows: pd.DataFrame) -> pd.DataFrame:
        code = [COLORS.index(color) for color in rows["domain"]]
        return rows.assign(code=code, method=rows["method"].str.replace("_inside", ""))

    def encoded(name: str) -> pd.DataFrame:
        return by_code(variants[variants["color_encoding"] == name])

    inside = variants[variants["method"].str.endswith("_inside")]
    panels = {
        "integer": ("integer", by_code(main), train_colors),
        "inside": ("integer", by_code(inside), INSIDE),
        "one_hot": ("one-hot", encoded("one_hot"), train_colors),
        "none": ("no colour", encoded("none"), train_colors),
    }
    return {
        name: (f"{seen}, {in_words(colors)}", rows, colors)
        for name, (seen, rows, colors) in panels.items()
    }


STEPS = {
    "reaches_key": "holds the key",
    "unlocks_door": "unlocks the door",
    "success": "reaches the goal",
}


def subtasks(rows: pd.DataFrame, color: str) -> pd.DataFrame:
    """Probability of each step of the task on a colour and on grey, by arm: the mean over runs."""
    colors = (color, TESTED)
    chosen = rows[rows["metric"].isin(STEPS) & rows["domain"].isin(colors)]
    means = chosen.groupby(["method", "domain", "metric"])["value"].mean().unstack()
    order = list(itertools.product(MAIN, colors))
    return means.loc[order, list(STEPS)].rename(columns=STEPS)


# --------------------------------------------------------------------- read off saved policies


def beyond_codes(
    task: Keys,
    saved: Mapping[str, Sequence[Weights]],
    walls: Sequence[int],
    codes: Sequence[int],
) -> pd.DataFrame:
    """Exact returns in the grey domain where key and door, and walls, are seen in other codes."""
    table = task.tasks[TESTED]

    def policy(players: Sequence[Weights], **kinds: int) -> np.ndarray:
        return task.logits(players, recolor(table.images, kinds)).softmax(-1).numpy()

    parts = []
    for (method, players), wall in itertools.product(saved.items(), walls):
        policies = [policy(players, key=code, door=code, wall=wall) for code in codes]
        for code, values in zip(codes, _returns_of(table, policies), strict=True):
            parts.append(_by_run(values, method=method, wall=wall, code=code))
    return pd.concat(parts)


def by_temperature(
    task: Keys,
    saved: Mapping[str, Sequence[Weights]],
    colors: Sequence[str],
    temperatures: Sequence[float],
) -> pd.DataFrame:
    """Exact returns where scores are divided by a temperature; at 0 the best action is taken."""

    def policy(logits: np.ndarray, temperature: float) -> np.ndarray:
        if temperature == 0:
            return np.eye(logits.shape[-1])[logits.argmax(-1)]
        return scipy.special.softmax(logits / temperature, axis=-1)

    parts = []
    for (method, players), color in itertools.product(saved.items(), colors):
        table = task.tasks[color]
        logits = task.seen_in(color, task.logits_in_all_colors(players)).numpy()
        policies = [policy(logits, temperature) for temperature in temperatures]
        for temperature, values in zip(temperatures, _returns_of(table, policies), strict=True):
            parts.append(_by_run(values, method=method, domain=color, temperature=temperature))
    return pd.concat(parts)


def _returns_of(table: TabularTask, policies: Sequence[np.ndarray]) -> np.ndarray:
    """Exact returns ``[len(policies), R]`` of policies ``[R, K, A]``, all at once."""
    return expected_return(table, np.concatenate(policies))[0].reshape(len(policies), -1)


def _by_run(values: np.ndarray, **columns: Any) -> pd.DataFrame:
    """Exact returns ``[R]`` as rows."""
    runs = range(len(values))
    return pd.DataFrame({**columns, "run": runs, "metric": "return_exact", "value": values})


PHASES = ("searching for the key", "with the key", "door unlocked")


def visits(task: Keys, players: Sequence[Weights], color: str) -> np.ndarray:
    """Expected steps ``[phase, row, column]`` in each cell of the grid, mean over runs."""
    table = task.tasks[color]
    spent = occupancy(table, task.policies(players, [color])[color]).mean(0)
    size = table.position.max() + 2  # the outer wall is not stood on
    grid = np.zeros((len(PHASES), size, size))
    np.add.at(grid, (table.progress, table.position[:, 1], table.position[:, 0]), spent)
    return grid
