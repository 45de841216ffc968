"""The chapter on LQR: its cells, from a cell to tidy rows, and its tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from experiments.experiment import Experiment, near_the_end
from experiments.figures import label
from experiments.rows import tidy
from experiments.store import select
from experiments.tables import mean_and_std
from ipo.checks import Count, check_count, checked, one_of
from ipo.lqr import (
    LQR,
    expected_cost,
    invariant_gain,
    minimum_norm_gain,
    project,
    riccati_gain,
    row_space,
    sample_problem,
    simulate,
    training_costs,
)
from ipo.lqr_learners import LQR_METHODS, LQRSettings, published_lqr, train
from ipo.stats import paired_difference, probability_of_improvement

VALIDATION_INTERVAL = 20  # iterations between two looks at the held-out domain


@checked
@dataclass(frozen=True)
class Cell:
    """One configuration of the experiment.

    Attributes:
        label: the method's name in the rows: a method, a control such as
            ``gradient_descent_lr5e-4``, or ``oracle`` and ``minimum_norm``, which are not trained.
        num_domains: training domains n_d.
        dim_distractor: n_y.
        settings: how the method is trained; ``None`` for what is not trained.
        early_stopping: train on all training domains but the last, and keep the controller
            that costs least in that one.
        precision: ``float32`` (as published) or ``float64``.
    """

    label: str
    num_domains: Count
    dim_distractor: Count
    settings: LQRSettings | None
    early_stopping: bool = False
    precision: Annotated[str, one_of(("float32", "float64"))] = "float32"

    @property
    def columns(self) -> dict[str, Any]:
        return {
            "method": self.label,
            "num_domains": self.num_domains,
            "dim_distractor": self.dim_distractor,
            "optimizer": self.settings.optimizer if self.settings else "none",
        }


# ------------------------------------------------------------------- what is asked for


def published_cell(
    method: str, num_domains: int, dim_distractor: int, num_iterations: int = 5000
) -> Cell:
    """A method as published, except for the number of iterations."""
    settings = replace(published_lqr(method), num_iterations=num_iterations)
    return Cell(method, num_domains, dim_distractor, settings)


def published_cells(num_domains: int, dim_distractor: int, num_iterations: int) -> list[Cell]:
    """The four methods."""
    return [published_cell(m, num_domains, dim_distractor, num_iterations) for m in LQR_METHODS]


def table_cells(sizes: Iterable[tuple[int, int]], num_iterations: int) -> list[Cell]:
    """The four methods and the oracle, for pairs of n_d and n_y."""
    return [
        cell
        for size in sizes
        for cell in (
            *published_cells(*size, num_iterations),
            Cell("oracle", *size, settings=None),
        )
    ]


def start_cells(
    num_domains: int, dim_distractor: int, few_distractors: int, num_iterations: int
) -> list[Cell]:
    """Readings of the random starts, which are not published: scales of Phi and of what follows."""

    def started(method: str, phi_scale: float, gain_scale: float, n_y: int) -> Cell:
        cell = published_cell(method, num_domains, n_y, num_iterations)
        settings = replace(cell.settings, phi_scale=phi_scale, gain_scale=gain_scale)
        name = f"{method}_phi{phi_scale:g}_gain{gain_scale:g}"
        return replace(cell, label=name, settings=settings)

    pairs = ((0.001, 0.001), (0.01, 0.01), (0.01, 0), (0.03, 0.001), (0.03, 0), (0.1, 0), (0.3, 0))
    return [
        *(
            started("overparameterized", scale, scale, dim_distractor)
            for scale in (0.0001, 0.001, 0.003, 0.01)
        ),
        *(started("ipo_variable_phi", *scales, dim_distractor) for scales in pairs),
        *(
            started("ipo_variable_phi", scale, 0, few_distractors)
            for scale in (0.001, 0.01, 0.03, 0.1, 0.3, 0.5)
        ),
    ]


def closed_form_cells(domain_counts: Iterable[int], dim_distractor: int) -> list[Cell]:
    """The minimum-norm gain, which is not trained."""
    return [
        Cell("minimum_norm", n_d, dim_distractor, None, precision="float64")
        for n_d in sorted(domain_counts)
    ]


def optimizer_cells(
    domain_counts: Sequence[int], dim_distractor: int, num_iterations: int
) -> list[Cell]:
    """Plain steps and L-BFGS, in double precision, until (nearly) nothing moves any more.

    IPO's average moves by learning_rate / n_d times the mean gradient in a round, so n_d times
    the learning rate makes it comparable with gradient descent.
    """
    scale = num_iterations / 5000
    plain = {"optimizer": "plain", "num_iterations": round(10_000 * scale)}
    lbfgs = {"optimizer": "lbfgs", "num_iterations": round(150 * scale) + 1}

    def converged(method: str, n_d: int, **changes: Any) -> Cell:
        settings = replace(published_lqr(method), **changes)
        return Cell(method, n_d, dim_distractor, settings, precision="float64")

    return [
        cell
        for n in domain_counts
        for cell in (
            converged("gradient_descent", n, learning_rate=0.1, max_gradient_norm=5.0, **plain),
            converged(
                "ipo_fixed_phi", n, learning_rate=0.1 * n, max_gradient_norm=5.0 / n, **plain
            ),
            converged("gradient_descent", n, learning_rate=1.0, **lbfgs),
        )
    ]


def control_cells(
    domain_counts: Sequence[int], dim_distractor: int, num_iterations: int
) -> list[Cell]:
    """One change at a time: learning rate, number of steps, early stopping, weight decay."""

    def control(method: str, n_d: int, suffix: str, early: bool = False, **changes: Any) -> Cell:
        cell = published_cell(method, n_d, dim_distractor, num_iterations)
        settings = replace(cell.settings, **changes)
        return replace(cell, label=f"{method}_{suffix}", settings=settings, early_stopping=early)

    return [
        cell
        for n in domain_counts
        for cell in (
            control("gradient_descent", n, "lr5e-4", learning_rate=5e-4),
            control("gradient_descent", n, "long", num_iterations=n * num_iterations),
            control("gradient_descent", n, "early", early=True),
            control("gradient_descent", n, "wd0.1", weight_decay=0.1),
            control("gradient_descent", n, "wd1", weight_decay=1.0),
            control("ipo_fixed_phi", n, "lr1e-3", learning_rate=1e-3),
            control("ipo_fixed_phi", n, "early", early=True),
            control("ipo_fixed_phi", n, "wd0.1", weight_decay=0.1),
            control("ipo_fixed_phi", n, "wd1", weight_decay=1.0),
        )
    ]


# ------------------------------------------------------------------- from a cell to rows


def run_cell(cell: Cell, seeds: list[int]) -> pd.DataFrame:
    """Train all runs of a cell and evaluate the controllers that they end with.

    The oracle, which sees the state, costs the same in every domain.
    """
    problem = problem_of(cell, seeds)
    if cell.label == "oracle":
        _, cost = riccati_gain(problem)
        return tidy(cell, seeds, {("test", "test_cost"): cost})
    return tidy(cell, seeds, evaluate(final_gain(cell, problem, seeds), problem))


def run_curve(cell: Cell, seeds: list[int], num_points: int = 40) -> pd.DataFrame:
    """The same, evaluated on the way: rows with a column ``iteration``, even in its logarithm."""
    problem = problem_of(cell, seeds)
    last = cell.settings.num_iterations
    checkpoints = {round(last ** (i / num_points)) for i in range(num_points + 1)} | {0}
    parts = []
    for iteration, gain in train(problem, cell.settings, seeds, checkpoints=sorted(checkpoints)):
        parts.append(tidy(cell, seeds, evaluate(gain, problem), iteration=iteration))
    return pd.concat(parts, ignore_index=True)


def run_closed_loops(
    cell: Cell, seeds: list[int], num_starts: int = 200, num_steps: int = 25
) -> pd.DataFrame:
    """How long the state is, ``|s_t|^2``, in a new domain: quantiles over random starts, by step.

    The starts are the same in all runs. The oracle is the invariant controller.
    """
    problem = problem_of(cell, seeds)
    gain = final_gain(cell, problem, seeds)
    starts = torch.randn(
        num_starts, problem.A.shape[-1], generator=torch.Generator().manual_seed(0)
    )
    energies = torch.stack(
        [
            simulate(gain, problem, problem.W_test, start.expand(len(seeds), -1), num_steps)
            for start in starts
        ]
    )
    quantiles = np.quantile(energies.square().sum(-1).numpy(), [0.05, 0.5, 0.95], axis=0)
    names = ("energy_q05", "energy_q50", "energy_q95")
    parts = []
    for step in range(num_steps + 1):
        metrics = {("test", name): q[:, step] for name, q in zip(names, quantiles, strict=True)}
        parts.append(tidy(cell, seeds, metrics, step=step))
    return pd.concat(parts, ignore_index=True)


def run_outside(cell: Cell, seeds: list[int]) -> pd.DataFrame:
    """Where the part of a gain lies that no training domain can show, and what it costs there.

    ``test_cost_random_outside`` is the cost with a random part of the same norm in its place.
    """
    problem = problem_of(cell, seeds)
    gain = final_gain(cell, problem, seeds)
    basis = row_space(problem)
    outside = gain - project(gain, basis)
    other = torch.randn(gain.shape, generator=torch.Generator().manual_seed(0))
    other -= project(other, basis)
    other *= (_norm(outside) / _norm(other))[:, None, None]
    metrics = {
        ("all", "gain_norm_outside"): _norm(outside),
        ("all", "gain_norm_outside_state"): _norm(outside[..., : problem.A.shape[-1]]),
        ("test", "gain_norm_outside_felt"): _norm(outside @ problem.W_test),
        ("test", "test_cost"): expected_cost(gain, problem, problem.W_test),
        ("test", "test_cost_random_outside"): expected_cost(
            gain - outside + other, problem, problem.W_test
        ),
    }
    return tidy(cell, seeds, metrics)


def final_gain(cell: Cell, problem: LQR, seeds: list[int]) -> Tensor:
    """The controllers ``[R, n_u, n_o]`` of a cell."""
    if cell.label == "oracle":
        return invariant_gain(problem)
    if cell.label == "minimum_norm":
        return minimum_norm_gain(problem)
    if cell.early_stopping:
        return _early_stopped_gain(problem, cell.settings, seeds)
    *_, (_, gain) = train(problem, cell.settings, seeds)
    return gain


def evaluate(gain: Tensor, problem: LQR) -> dict[tuple[str, str], Tensor]:
    """Every metric ``[R]`` of gains ``[R, n_u, n_o]``, keyed by domain and metric.

    ``outside`` is the part of a gain that no training domain can show; ``projected`` is the
    gain without it.
    """
    n_x = problem.A.shape[-1]
    basis = row_space(problem)
    inside = project(gain, basis)
    closed_form = minimum_norm_gain(problem)
    costs = training_costs(gain, problem)
    _, oracle = riccati_gain(problem)
    return {
        ("train", "train_cost"): costs.mean(1),
        ("train", "train_cost_projected"): training_costs(inside, problem).mean(1),
        ("test", "test_cost"): expected_cost(gain, problem, problem.W_test),
        ("test", "test_cost_projected"): expected_cost(inside, problem, problem.W_test),
        # Every player's best response costs what the oracle does; without a stable loop: infinite.
        ("train", "nash_gap"): costs.amax(1) - oracle,
        ("all", "gain_norm_state"): _norm(gain[..., :n_x]),
        ("all", "gain_norm_distractor"): _norm(gain[..., n_x:]),
        ("all", "gain_norm_inside"): _norm(inside),
        ("all", "gain_norm_outside"): _norm(gain - inside),
        ("all", "distance_to_minimum_norm"): _norm(gain - closed_form) / _norm(closed_form),
    }


def _early_stopped_gain(problem: LQR, settings: LQRSettings, seeds: list[int]) -> Tensor:
    n_x = problem.A.shape[-1]
    check_count("num_domains", problem.num_domains, minimum=2)
    inner = replace(problem, seen=problem.seen[..., :-n_x])
    held_out = problem.seen[..., -n_x:]
    best = torch.zeros(problem.num_runs, *problem.gain_shape, dtype=problem.A.dtype)
    best_cost = torch.full((problem.num_runs,), torch.inf, dtype=problem.A.dtype)
    looks = range(0, settings.num_iterations + 1, VALIDATION_INTERVAL)
    for _, gain in train(inner, settings, seeds, checkpoints=looks):
        cost = expected_cost(gain, problem, held_out)
        better = cost < best_cost
        best[better], best_cost[better] = gain[better], cost[better]
    return best


def problem_of(cell: Cell, seeds: list[int]) -> LQR:
    """The problems of runs, in a cell's precision."""
    dtype = getattr(torch, cell.precision)
    return sample_problem(seeds, cell.num_domains, cell.dim_distractor, dtype=dtype)


def _norm(gain: Tensor) -> Tensor:
    return torch.linalg.matrix_norm(gain)


def short(cell: Cell) -> Cell:
    """Some dozens of iterations."""
    if cell.settings is None:
        return cell
    few = 3 if cell.settings.optimizer == "lbfgs" else 30
    return replace(cell, settings=replace(cell.settings, num_iterations=few))


def short_if_small(cell: Cell) -> Cell | None:
    """The same, of few domains and distractors: larger cells cost more and are of no other kind."""
    return short(cell) if cell.num_domains * cell.dim_distractor <= 2500 else None


EXPERIMENTS = {
    name: Experiment(run_cell, Cell, short_if_small, near_the_end=near_the_end)
    for name in (
        "tables",
        "starts",
        "more_domains",
        "closed_form",
        "optimizers",
        "controls",
        "turns",
    )
} | {
    "curves": Experiment(run_curve, Cell, short),
    "closed_loops": Experiment(run_closed_loops, Cell, short),
    "outside": Experiment(run_outside, Cell, short),
}


# ------------------------------------------------------------------- from rows to tables

CONTROLS = {
    "gradient_descent": "gradient descent, as published",
    "gradient_descent_lr5e-4": "… IPO's learning rate",
    "gradient_descent_long": "… as many steps as IPO's players",
    "gradient_descent_early": "… early stopping",
    "gradient_descent_wd0.1": "… weight decay 0.1",
    "gradient_descent_wd1": "… weight decay 1",
    "ipo_fixed_phi": "IPO, fixed Φ, as published",
    "ipo_fixed_phi_lr1e-3": "… gradient descent's learning rate",
    "ipo_fixed_phi_early": "… early stopping",
    "ipo_fixed_phi_wd0.1": "… weight decay 0.1",
    "ipo_fixed_phi_wd1": "… weight decay 1",
}
PAIRS = {
    ("ipo_fixed_phi", "gradient_descent"): "IPO − gradient descent",
    ("ipo_fixed_phi", "gradient_descent_lr5e-4"): "IPO − gradient descent, 5e-4",
    ("ipo_fixed_phi", "gradient_descent_early"): "IPO − gradient descent, early stopping",
    ("ipo_fixed_phi_lr1e-3", "gradient_descent"): "IPO, 1e-3 − gradient descent",
    ("ipo_fixed_phi_early", "gradient_descent_early"): (
        "IPO, early stopping − gradient descent, early stopping"
    ),
}
OPTIMIZERS = {"adam": "Adam", "plain": "plain", "lbfgs": "L-BFGS", "none": "–"}


def beside_paper(rows: pd.DataFrame, paper: pd.DataFrame, by: str, **fixed: int) -> pd.DataFrame:
    """Cost in a new domain by ``by``, the other size ``fixed``: ours, the paper's, the difference.

    Mean and standard deviation over runs; nothing where the paper has no number.
    """
    keys = ["method", by]
    ours = select(rows, {"metric": "test_cost", **fixed}).groupby(keys)["value"]
    theirs = select(paper, fixed).drop_duplicates(keys).set_index(keys)
    theirs = theirs.reindex(ours.mean().index)
    text = pd.DataFrame(
        {
            "ours": ours.agg(mean_and_std),
            "paper": [_published(*row) for row in theirs[["mean", "std"]].to_numpy()],
            "difference": (ours.mean() - theirs["mean"]).map("{:+.2f}".format, na_action="ignore"),
        }
    )
    wide = text.fillna("").stack().unstack(by)
    order = [(method, row) for method in (*LQR_METHODS, "oracle") for row in text.columns]
    wide = wide.loc[order]
    wide.index = pd.MultiIndex.from_tuples([(label(method), row) for method, row in order])
    unit = "domains" if by == "num_domains" else "distractors"
    wide.columns = [f"{n} {unit}" for n in wide.columns]
    return wide


def _published(mean: float, std: float) -> str:
    if np.isnan(mean):
        return ""
    return f"{mean:.1f}" if np.isnan(std) else f"{mean:.1f} ± {std}"


TABLE_KEYS = ["method", "num_domains", "dim_distractor"]


def mean_costs(rows: pd.DataFrame) -> pd.Series:
    """Cost in a new domain, mean over runs, per cell of the two tables."""
    return rows[rows["metric"] == "test_cost"].groupby(TABLE_KEYS)["value"].mean()


def paper_costs(paper: pd.DataFrame) -> pd.Series:
    """The paper's :func:`mean_costs`."""
    return paper.drop_duplicates(TABLE_KEYS).set_index(TABLE_KEYS)["mean"]


def difference_to_paper(rows: pd.DataFrame, paper: pd.DataFrame) -> pd.Series:
    """Mean cost in a new domain minus the paper's, per cell of the two tables."""
    return (mean_costs(rows) - paper_costs(paper)).dropna()


def num_lower(costs: pd.Series, baseline: str) -> str:
    """In how many cells of the tables IPO, fixed Phi, costs less than a baseline, in words."""
    lower = costs["ipo_fixed_phi"].lt(costs[baseline])
    return f"{lower.sum()} of {len(lower)}"


def in_words(differences: pd.Series) -> str:
    """Which cells of the tables differ from the paper's, and by how much."""
    parts = [
        f"{label(method)} with {n_d} domains and {n_y} distractors, by {difference:+.1f}"
        for (method, n_d, n_y), difference in differences.items()
    ]
    return "; ".join(parts) or "none"


def start_table(rows: pd.DataFrame, cells: Sequence[Cell], paper: pd.DataFrame) -> pd.DataFrame:
    """Cost in a new domain by the start of Phi, and which start the tables have."""
    keys = ["method", "dim_distractor"]
    costs = rows[rows["metric"] == "test_cost"].groupby(keys)["value"].agg(mean_and_std)

    def row(cell: Cell) -> dict[str, Any]:
        start, n_d, n_y = cell.settings, cell.num_domains, cell.dim_distractor
        chosen = published_cell(start.method, n_d, n_y, start.num_iterations).settings
        place = {"method": start.method, "num_domains": n_d, "dim_distractor": n_y}
        theirs = select(paper, place)["mean"]
        return {
            "method": label(start.method),
            "distractors": n_y,
            "scale of Φ or K₁": f"{start.phi_scale:g}",
            "scale of Kᵈ or K₂": f"{start.gain_scale:g}",
            "cost in a new domain": costs[cell.label, n_y],
            "paper": f"{theirs.iloc[0]:.1f}" if len(theirs) else "",
            "in the tables": "✓" if start == chosen else "",
        }

    return pd.DataFrame(map(row, cells))


def means(rows: pd.DataFrame, metric: str) -> pd.DataFrame:
    """Means over runs: a row per method, a column per number of domains."""
    return (
        rows[rows["metric"] == metric].groupby(["method", "num_domains"])["value"].mean().unstack()
    )


def optimizer_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Means over runs by optimiser, method and number of domains."""
    wanted = {
        "test_cost": "cost in a new domain",
        "test_cost_projected": "… projected onto the row space",
        "gain_norm_inside": "norm inside",
        "gain_norm_outside": "norm outside",
        "distance_to_minimum_norm": "distance to minimum norm",
    }
    keys = ["optimizer", "method", "num_domains"]
    table = rows.groupby([*keys, "metric"])["value"].mean().unstack()
    order = {name: place for place, name in enumerate([*OPTIMIZERS, *LQR_METHODS, "minimum_norm"])}
    table = table.sort_index(key=lambda level: level.map(lambda name: order.get(name, name)))
    table = table[list(wanted)].rename(columns=wanted).rename_axis(columns=None)
    table = table.rename(index=OPTIMIZERS, level="optimizer").rename(index=label, level="method")
    return table.reset_index(names=["optimiser", "method", "domains"])


def optimizer_numbers(rows: pd.DataFrame, num_domains: int) -> dict[str, float | str]:
    """Numbers for the prose: means over runs with ``num_domains``.

    ``plain_vs_closed`` is the largest relative difference in cost, with any number of domains,
    between a run that converged and the closed form.
    """
    keys = ["optimizer", "method"]
    mean = select(rows, {"num_domains": num_domains}).groupby([*keys, "metric"])["value"].mean()
    values = {
        "lbfgs": mean["lbfgs", "gradient_descent", "test_cost"],
        "closed": mean["none", "minimum_norm", "test_cost"],
    }
    for method in ("gradient_descent", "ipo_fixed_phi"):
        values[f"adam_{method}"] = mean["adam", method, "test_cost"]
        values[f"plain_{method}"] = mean["plain", method, "test_cost"]
        values[f"projected_{method}"] = mean["adam", method, "test_cost_projected"]
        values[f"outside_{method}"] = mean["adam", method, "gain_norm_outside"]
    costs = rows[rows["metric"] == "test_cost"].set_index(["num_domains", "run"])
    closed = costs.loc[costs["method"] == "minimum_norm", "value"]
    converged = costs.loc[costs["optimizer"].isin(["plain", "lbfgs"]), "value"]
    return values | {"plain_vs_closed": f"{(converged / closed - 1).abs().max():.0e}"}


def outside_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Means over runs: where the part outside the row space lies, and what it costs."""
    names = {
        "gain_norm_outside": "norm outside",
        "gain_norm_outside_state": "… in columns of the state",
        "gain_norm_outside_felt": "… as a new domain feels it",
        "test_cost": "cost in a new domain",
        "test_cost_random_outside": "… with a random outside part",
    }
    table = rows.groupby(["method", "metric"])["value"].mean().unstack()
    table = table.loc[list(LQR_METHODS), list(names)].rename(index=label, columns=names)
    return table.rename_axis(columns=None).reset_index()


def control_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Cost in a new domain of every control, by the number of training domains."""
    chosen = rows[rows["metric"] == "test_cost"].groupby(["method", "num_domains"])["value"]
    table = chosen.agg(mean_and_std).unstack().loc[list(CONTROLS)].rename(index=CONTROLS)
    table.columns = [f"{n} domains" for n in table.columns]
    return table.rename_axis(index=None)


def control_differences(rows: pd.DataFrame) -> pd.DataFrame:
    """Paired differences of cost in a new domain, run by run."""
    by_run = rows[rows["metric"] == "test_cost"].pivot_table(
        index=["num_domains", "run"], columns="method", values="value"
    )

    def row(n: int, block: pd.DataFrame, method: str, baseline: str) -> dict[str, Any]:
        mean, low, high, _ = paired_difference(block[method], block[baseline])
        better = probability_of_improvement(block[method], block[baseline])
        return {
            "difference": PAIRS[method, baseline],
            "domains": n,
            "mean and 95 % interval": f"{mean:+.1f} [{low:+.1f}, {high:+.1f}]",
            "P(improvement)": f"{better:.2f}",
        }

    blocks = by_run.groupby(level=0)
    table = pd.DataFrame([row(n, block, *pair) for n, block in blocks for pair in PAIRS])
    return table.sort_values(["difference", "domains"], kind="stable")
