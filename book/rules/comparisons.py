"""Rules for tables and comparisons of any chapter: their numbers, which arm is better, and why."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import scipy.stats

from rules.cells import Cells, label, paper_effect, paper_tests, published, shown
from rules.verdicts import (
    EXPLAINED,
    IN_PART,
    REPRODUCED,
    UNDECIDED,
    Compared,
    Finding,
    compare,
    counted,
    holds,
    holm,
    together,
)


def means_come_back(
    cells: Cells,
    paper: pd.DataFrame,
    metric: str,
    num_paper_runs: int,
    digits: int,
    num_errors: float,
    where: dict[str, dict],
) -> Finding:
    """Every mean of the paper is as near to ours as the spread of its runs lets us expect.

    Within ``num_errors`` standard errors of the difference, or within the rounding of what is
    printed. ``where`` says which rows of a method are meant.
    """
    good, bounds, parts, missed = [], [], [], []
    for cell, mean, std in published(paper):
        ours = cells.runs(metric=metric, **cell, **where[cell["method"]])
        error = np.hypot(std / np.sqrt(num_paper_runs), ours.sem())
        bounds.append(max(num_errors * error, 0.5 * 10**-digits))
        good.append(abs(ours.mean() - mean) <= bounds[-1])
        name = f"{label(cell['method'])} on {cell['domain']}"
        parts.append(f"{name} {ours.mean():.3f} (paper {mean:.{digits}f})")
        if not good[-1]:
            missed.append(name)
    counts = f"{sum(good)} of {len(good)} are reproduced"
    counts += f", not {', '.join(missed)}" if missed else ""
    allowed = f"by tolerances from {min(bounds):.3f} to {max(bounds):.3f}"
    return Finding(together(map(holds, good)), f"{counts}, {allowed}: {'; '.join(parts)}")


def spreads_come_back(
    cells: Cells,
    paper: pd.DataFrame,
    metric: str,
    num_paper_runs: int,
    ddof: int,
    common: dict[str, Any],
    where: dict[str, dict],
) -> Finding:
    """No standard deviation of the paper differs from ours by the F test at 5 %, by Holm's method.

    ``ddof`` is how the paper's are read: 0, the deviation of its runs; 1, the estimate of that of
    all runs there could be.
    """
    ratios, p = [], []
    for cell, _, std in published(paper[paper["std"].notna()]):
        ours = cells.runs(metric=metric, **common, **cell, **where.get(cell["method"], {}))
        theirs = std * np.sqrt(num_paper_runs / (num_paper_runs - 1)) if ddof == 0 else std
        ratios.append(ours.std(ddof=1) / theirs)
        smaller = scipy.stats.f.cdf(ratios[-1] ** 2, len(ours) - 1, num_paper_runs - 1)
        p.append(2 * min(smaller, 1 - smaller))
    same = [adjusted >= 0.05 for adjusted in holm(p)]
    near = sum(0.9 <= ratio <= 1.1 for ratio in ratios)
    least, most = np.sqrt(scipy.stats.f.ppf([0.025, 0.975], len(ours) - 1, num_paper_runs - 1))
    return Finding(
        together(map(holds, same)),
        f"{sum(same)} of {len(same)} do not differ beyond chance; ours are {min(ratios):.2f} to "
        f"{max(ratios):.2f} times the paper's, with median {np.median(ratios):.2f}; {near} within "
        f"a tenth of the paper's; by itself, a test of so few runs calls only what is below "
        f"{least:.2f} or above {most:.2f} times the paper's different",
    )


def better(
    cells: Cells,
    paper: pd.DataFrame,
    metric: str,
    domains: list,
    over: str,
    paired: bool,
    num_paper_runs: int,
    comparisons: dict[str, list[dict]],
) -> Finding:
    """One arm has a higher value than another, in every comparison of two.

    Of a run, the ``mean`` or the worst value (``min``) over the domains counts.
    """
    verdicts, parts, tests = [], [], []
    tested = paper[paper["domain"].isin(map(str, domains))]
    for name, arms in comparisons.items():
        ours, theirs = (cells.over(domains, over, metric=metric, **arm) for arm in arms)
        methods = [arm["method"] for arm in arms]
        effect = paper_effect(paper, *methods, domains, over)
        if effect is not None:
            tests.append(paper_tests(tested, *methods, num_paper_runs))
        found = compare(ours, theirs, effect, paired)
        verdicts.append(found.verdict)
        parts.append(f"{name}: {ours.mean():.3f} and {theirs.mean():.3f}, {found.text()}")
        if over == "min":
            where = (worst_places(cells, domains, metric=metric, **arm) for arm in arms)
            parts[-1] += f"; the worst is {' and '.join(where)} runs"
    return Finding(together(verdicts), "; ".join(parts), "; ".join(dict.fromkeys(tests)))


def worst_places(cells: Cells, domains: list, **where: Any) -> str:
    """In how many runs each domain is the worst, the most frequent first."""
    by_domain = {str(domain): cells.runs(domain=domain, **where) for domain in domains}
    counts = pd.DataFrame(by_domain).idxmin(axis=1).value_counts()
    return ", ".join(f"{domain} in {number}" for domain, number in counts.items())


def because_of_the_game(
    cells: Cells,
    paper: pd.DataFrame,
    common: dict[str, Any],
    places: list[dict[str, Any]],
    each: bool,
    method: dict[str, Any],
    baseline: dict[str, Any],
    control: list[dict[str, Any]],
    lower_is_better: bool,
    share: float,
) -> Finding:
    """What a control leaves of the method's advantage over its baseline.

    What is left is the difference of two arms: the method and a control without the game, or the
    method and its baseline where both are controlled for something else.

        explained otherwise   its 95 % interval ends below ``share`` of the advantage
        reproduced            it begins above 1 - ``share`` of it
        reproduced in part    it lies above zero, but neither
        undecided             it does not

    Where there is no advantage, there is nothing to explain, and the verdict is that on it. Of a
    run, the mean over the places counts, or, where ``each`` is asked for, every place by itself.
    """

    def at(group: list[dict[str, Any]]) -> tuple[Compared, Compared]:
        arms = [method, baseline, *control]
        return advantage_and_left(cells, paper, common, group, arms, lower_is_better)

    single = [[place] for place in places]
    compared = [at(group) for group in (single if each else [places])]
    verdicts = [remaining(*own, share) for own in compared]
    ours, theirs, controlled, left_over = (
        f"{label(arm['method'])}{suffix(arm)}" for arm in (method, baseline, *control)
    )
    parts = [
        f"{ours} minus {theirs}: {advantage.text()}; what is left of it, {controlled} minus "
        f"{left_over}: {left.text()} (positive where the first does better)"
        for advantage, left in compared
    ]
    if each:
        parts = [f"{words(place)}: {part}" for place, part in zip(places, parts, strict=True)]
        parts[0] = f"{counted(verdicts)}; {parts[0]}"
    elif len(places) > 1:
        by_place = [at(group)[1].difference.mean for group in single]
        parts = [
            f"in the mean over {len(places)} configurations {parts[0]}; by configuration, from "
            f"{shown(min(by_place), '+.1f')} to {shown(max(by_place), '+.1f')} is left"
        ]
    return Finding(together(verdicts), "; ".join(parts))


def advantage_and_left(
    cells: Cells,
    paper: pd.DataFrame,
    common: dict[str, Any],
    places: list[dict[str, Any]],
    arms: list[dict[str, Any]],
    lower_is_better: bool,
) -> tuple[Compared, Compared]:
    """The difference of the first two arms, beside the paper's, and that of the last two."""
    sign = -1 if lower_is_better else 1
    values = [
        sign * sum(cells.runs(**common, **place, **arm) for place in places) / len(places)
        for arm in arms
    ]
    effect = None
    if all("domain" in place for place in places):
        domains = [place["domain"] for place in places]
        effect = paper_effect(paper, arms[0]["method"], arms[1]["method"], domains)
    return compare(*values[:2], effect), compare(*values[2:])


def remaining(advantage: Compared, left: Compared, share: float) -> str:
    """The verdict on a cause of an advantage, by what is left of it without that cause."""
    low, high = left.difference.low, left.difference.high
    gained = advantage.difference.mean
    if advantage.difference.low <= 0:
        return advantage.verdict
    if high < share * gained:
        return EXPLAINED
    if low > (1 - share) * gained:
        return REPRODUCED
    return IN_PART if low > 0 else UNDECIDED


def suffix(arm: dict[str, Any]) -> str:
    """What an arm has besides its method."""
    others = [str(value) for column, value in arm.items() if column != "method"]
    return f" ({', '.join(others)})" if others else ""


def words(place: dict[str, Any]) -> str:
    """A place by its columns."""
    return ", ".join(
        f"{column.removeprefix('num_').replace('_', ' ')} {value}"
        for column, value in place.items()
    )
