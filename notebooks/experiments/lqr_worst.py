"""LQR beyond one new domain: the worst of many, and one chosen against the controller (equation 1).

Costs can be infinite here, so what counts is the *efficiency*: the oracle's cost over the
controller's. It is 1 for the oracle, and 0 where the closed loop is unstable.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import pandas as pd
import torch
from torch import Tensor

from experiments.experiment import Experiment, near_the_end
from experiments.lqr import Cell, final_gain, problem_of, published_cell, short_if_small
from experiments.lqr_turns import ARMS, arms
from experiments.rows import tidy
from experiments.store import select
from ipo.lqr import LQR, riccati_gain, sample_problem, training_costs

CONFIGURATION = ["num_domains", "dim_distractor"]
NUM_NEW = 100  # domains in which every controller is tried
WANTED = {  # by metric: what it is called, and how it is shown
    "efficiency_mean": ("efficiency, mean over new domains", ".0%"),
    "efficiency_worst": ("… in the worst of them", ".0%"),
    "share_unstable": ("new domains with an unstable loop", ".1%"),
    "opposed_radius": ("spectral radius in the domain chosen against it", ".2f"),
}


def worst_cells(sizes: Iterable[tuple[int, int]], num_iterations: int) -> list[Cell]:
    """Gradient descent, one controller on one domain at a time, and IPO, by n_d and n_y."""
    cells = []
    for size in sizes:
        in_turn = next(arm for arm in arms(*size, num_iterations) if arm.label == "in_turn")
        descent, ipo = (
            published_cell(method, *size, num_iterations)
            for method in ("gradient_descent", "ipo_fixed_phi")
        )
        cells += [descent, in_turn, ipo]
    return cells


def run_worst(cell: Cell, seeds: list[int], num_new: int = NUM_NEW) -> pd.DataFrame:
    """Train all runs of a cell and try their controllers in domains that they have not seen."""
    problem = problem_of(cell, seeds)
    gain = final_gain(cell, problem, seeds)
    _, oracle = riccati_gain(problem)
    costs = training_costs(gain, new_domains(cell, seeds, num_new))
    efficiency = oracle[:, None] / costs
    loop = problem.A - problem.B @ gain @ opposed_domain(gain, problem)
    metrics = {
        ("new", "efficiency_mean"): efficiency.mean(1),
        ("new", "efficiency_worst"): efficiency.amin(1),
        ("new", "share_unstable"): costs.isinf().to(costs).mean(1),
        ("opposed", "opposed_radius"): torch.linalg.eigvals(loop).abs().amax(1),
    }
    return tidy(cell, seeds, metrics)


def new_domains(cell: Cell, seeds: list[int], num_new: int) -> LQR:
    """The runs' problems with the domains that come after those of training in their place.

    The first of them is the test domain of the tables.
    """
    trained = cell.num_domains
    problem = sample_problem(
        seeds, trained + num_new, cell.dim_distractor, dtype=getattr(torch, cell.precision)
    )
    return replace(problem, seen=problem.seen[..., trained * problem.A.shape[-1] :])


def opposed_domain(gain: Tensor, problem: LQR) -> Tensor:
    """A domain ``[R, n_o, n_x]`` of the same kind whose distractors are chosen against a gain.

    What acts on the state by itself leaves the loop M = A - B K_c W_c; with distractors D it is
    M - B K_y D. Of all D with orthonormal columns the polar factor -U V' of K_y' B' M = U S V' adds
    most in the direction of M. So the worst of all domains is at least as bad as this one.
    """
    n_x = problem.A.shape[-1]
    seen_by_all = problem.W_test[:, :n_x]
    remaining = problem.A - problem.B @ gain[..., :n_x] @ seen_by_all
    U, _, Vh = torch.linalg.svd(gain[..., n_x:].mT @ problem.B.mT @ remaining, full_matrices=False)
    return torch.cat([seen_by_all, -U @ Vh], dim=1)


EXPERIMENTS = {"worst": Experiment(run_worst, Cell, short_if_small, near_the_end=near_the_end)}


def worst_table(rows: pd.DataFrame, dim_distractor: int) -> pd.DataFrame:
    """Means over runs: a row per arm and metric, a column per number of training domains."""
    chosen = select(rows, {"dim_distractor": dim_distractor})
    mean = chosen.groupby(["method", "metric", "num_domains"])["value"].mean().unstack()
    table = pd.DataFrame(
        {"arm": name, "": words, **mean.loc[method, metric].map(f"{{:{spec}}}".format)}
        for method, name in ARMS.items()
        if method in mean.index
        for metric, (words, spec) in WANTED.items()
    )
    return table.rename(columns={n: f"{n} domains" for n in mean.columns})


def worst_numbers(rows: pd.DataFrame, dim_distractor: int) -> dict[str, float | str]:
    """Numbers for the prose, by arm.

    Efficiency in the worst new domain with the fewest and the most training domains, mean over
    runs; the largest share of unstable loops in any configuration; and how many controllers are
    unstable in the domain that is chosen against them.
    """
    mean = rows.groupby(["metric", "method", *CONFIGURATION])["value"].mean()
    worst = select(rows, {"metric": "efficiency_worst", "dim_distractor": dim_distractor})
    by_number = worst.groupby(["num_domains", "method"])["value"].mean().unstack()
    unstable = select(rows, {"metric": "opposed_radius"}).set_index("method")["value"] >= 1
    opposed = unstable.groupby("method").agg(lambda own: f"{own.sum()} of {len(own)}")
    return {
        **by_number.iloc[0].add_prefix("few_"),
        **by_number.iloc[-1].add_prefix("most_"),
        **mean["share_unstable"].groupby("method").max().add_prefix("unstable_"),
        **opposed.add_prefix("opposed_"),
    }
