"""Rules for linear quadratic control, where lower is better."""

from __future__ import annotations

import itertools

import pandas as pd

from rules.cells import Cells, label, published, shown
from rules.verdicts import (
    CONTRADICTED,
    IN_PART,
    REPRODUCED,
    UNDECIDED,
    Compared,
    Finding,
    compare,
    decided,
    holds,
    together,
    within,
)

CONFIGURATION = ["num_domains", "dim_distractor"]


def costs(cells: Cells, method: str, num_domains: int, dim_distractor: int, domain: str = "test"):
    """Costs of all runs with the published optimiser; the oracle needs none."""
    return cells.runs(
        metric=f"{domain}_cost",
        domain=domain,
        method=method,
        num_domains=num_domains,
        dim_distractor=dim_distractor,
        optimizer="none" if method == "oracle" else "adam",
    )


def cells_come_back(
    cells: Cells, paper: pd.DataFrame, tolerance: dict[str, float], first_run: int
) -> Finding:
    """Every mean of the paper within the tolerance of its method, over the runs from the first."""
    scored = cells.beginning_with(first_run)
    inside, parts = [], []
    for method, bound in tolerance.items():
        apart = [
            abs(costs(scored, **cell).mean() - mean)
            for cell, mean, _ in published(paper[paper["method"] == method])
        ]
        good = [distance <= bound for distance in apart]
        inside += good
        parts.append(
            f"{label(method)}: {sum(good)} of {len(good)} within {bound}, largest difference "
            f"{max(apart):.2f}"
        )
    return Finding(together(map(holds, inside)), "; ".join(parts))


def significantly_lower(
    cells: Cells,
    paper: pd.DataFrame,
    methods: list[str],
    baselines: list[str],
    paired: bool,
    corrected: bool,
) -> Finding:
    """Every method costs less than every baseline, beyond chance, in every configuration."""
    arms = list(itertools.product(methods, baselines, configurations(paper)))
    gains = [
        compare(costs(cells, baseline, *size), costs(cells, method, *size), paired=paired)
        for method, baseline, size in arms
    ]
    verdicts = decided(gains, corrected)
    theirs = paper.set_index(["method", *CONFIGURATION])["mean"]
    own = [theirs[baseline, *size] - theirs[method, *size] for method, baseline, size in arms]
    lower = [gain for gain, found in zip(gains, verdicts, strict=True) if found == REPRODUCED]
    evidence = (
        f"significantly lower in {len(lower)} of {len(arms)} comparisons{span(lower)} (the paper's "
        f"own means are lower in {sum(gain > 0 for gain in own)})"
    )
    exceptions = [
        f"{compared(*arm)} by {shown(gain.difference.mean)}, {found}"
        for arm, gain, found in zip(arms, gains, verdicts, strict=True)
        if found != REPRODUCED
    ]
    opposite = [
        f"{compared(*arm)} by {shown(gain.difference.mean)}, in the paper by {shown(gap)}"
        for arm, gain, gap, found in zip(arms, gains, own, verdicts, strict=True)
        if gap < 0 and found == REPRODUCED
    ]
    if exceptions:
        evidence += "; the others: " + "; ".join(exceptions)
    if opposite:
        evidence += "; of the other sign than in the paper: " + "; ".join(opposite)
    return Finding(together(verdicts), evidence)


def span(gains: list[Compared]) -> str:
    """By how much, from the smallest to the largest mean difference."""
    return f", by {shown(min(means(gains)))} to {shown(max(means(gains)))}" if gains else ""


def no_benefit(
    cells: Cells, paper: pd.DataFrame, method: str, baseline: str, corrected: bool
) -> Finding:
    """The method is nowhere lower than the baseline beyond chance."""
    sizes = configurations(paper)
    gains = [compare(costs(cells, baseline, *s), costs(cells, method, *s)) for s in sizes]
    lower = [found == REPRODUCED for found in decided(gains, corrected)]
    where = [
        f"{describe(*size)} by {shown(gain.difference.mean)}"
        for size, gain, is_lower in zip(sizes, gains, lower, strict=True)
        if is_lower
    ]
    evidence = (
        f"{label(method)} is significantly lower than {label(baseline)} in {sum(lower)} of "
        f"{len(lower)} configurations"
    )
    evidence += ": " + "; ".join(where) if where else ""
    return Finding(together(holds(not is_lower) for is_lower in lower), evidence)


def largely_similar(
    cells: Cells, paper: pd.DataFrame, method: str, baseline: str, margin: float
) -> Finding:
    """The interval of the difference lies within a share of the baseline's cost, everywhere."""
    verdicts, relative, gains = [], [], []
    for size in configurations(paper):
        ours, base = costs(cells, method, *size), costs(cells, baseline, *size)
        gains.append(compare(ours, base))
        bound = margin * base.mean()
        verdicts.append(within(gains[-1].difference.low, gains[-1].difference.high, -bound, bound))
        relative.append(gains[-1].difference.mean / base.mean())
    apart = sum(own.difference.p < 0.05 for own in gains)
    corrected = sum(found != UNDECIDED for found in decided(gains))
    evidence = (
        f"within {margin:.0%} in {verdicts.count(REPRODUCED)} of {len(verdicts)} configurations, "
        f"beyond in {verdicts.count(CONTRADICTED)}; {label(method)} differs by "
        f"{shown(min(relative), '+.1%')} to {shown(max(relative), '+.1%')}, beyond chance in "
        f"{apart} ({corrected} by Holm's method)"
    )
    return Finding(together(verdicts), evidence)


def overfits(cells: Cells, paper: pd.DataFrame, method: str, corrected: bool) -> Finding:
    """The cost in a new domain is higher than in training, in every configuration."""
    gaps = [
        compare(costs(cells, method, *size), costs(cells, method, *size, domain="train"))
        for size in configurations(paper)
    ]
    verdicts = decided(gaps, corrected)
    higher = [gap for gap, found in zip(gaps, verdicts, strict=True) if found == REPRODUCED]
    evidence = (
        f"{label(method)} costs significantly more in a new domain than in training in "
        f"{len(higher)} of {len(verdicts)} configurations{span(higher)}"
    )
    return Finding(together(verdicts), evidence)


def tends_to_oracle(
    cells: Cells,
    paper: pd.DataFrame,
    method: str,
    dim_distractor: int,
    num_domains: list[int],
    remaining_share: float,
) -> Finding:
    """The cost falls with every step, and at most a share of the gap to the oracle is left."""
    by_number = [costs(cells, method, number, dim_distractor) for number in num_domains]
    oracle = costs(cells, "oracle", num_domains[0], dim_distractor).mean()
    falls = together(decided([compare(*pair) for pair in itertools.pairwise(by_number)]))
    gaps = [values.mean() - oracle for values in by_number]
    close = gaps[-1] <= remaining_share * gaps[0]
    evidence = f"gap of {label(method)} to the oracle ({oracle:.1f}): " + "; ".join(
        f"{number} domains {gap:.1f}" for number, gap in zip(num_domains, gaps, strict=True)
    )
    return Finding(falls if close or falls != REPRODUCED else IN_PART, evidence)


def configurations(paper: pd.DataFrame) -> list[tuple[int, int]]:
    """The paper's pairs of number of domains and distractor dimension."""
    return list(paper[CONFIGURATION].drop_duplicates().itertuples(index=False, name=None))


def means(compared: list[Compared]) -> list[float]:
    return [own.difference.mean for own in compared]


def compared(method: str, baseline: str, size: tuple[int, int]) -> str:
    return f"{label(method)} under {label(baseline)} at {describe(*size)}"


def describe(num_domains: int, dim_distractor: int) -> str:
    return f"{num_domains} domains, {dim_distractor} distractors"
