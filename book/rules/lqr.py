"""Rules for linear quadratic control, where lower is better."""

from __future__ import annotations

import itertools

import numpy as np
import pandas as pd

from rules.cells import Cells, in_brackets, label, published, shown, welch_of_tables
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
    holm,
    together,
    within,
)

CONFIGURATION = ["num_domains", "dim_distractor"]
Size = tuple[int, int]


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
    scored = cells.between(first_run, cells.num_runs - 1)
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
        f"{compared(*arm)} by {text(gain)}, {found}"
        for arm, gain, found in zip(arms, gains, verdicts, strict=True)
        if found != REPRODUCED
    ]
    opposite = [
        f"{compared(*arm)} by {text(gain)}, in the paper by {shown(gap)}"
        for arm, gain, gap, found in zip(arms, gains, own, verdicts, strict=True)
        if gap < 0 and found == REPRODUCED
    ]
    if exceptions:
        evidence += "; the others: " + "; ".join(exceptions)
    if opposite:
        evidence += "; of the other sign than in the paper: " + "; ".join(opposite)
    return Finding(together(verdicts), evidence)


def span(gains: list[Compared]) -> str:
    """By how much, from the smallest to the largest mean difference, with their intervals."""
    ends = [pick(gains, key=lambda own: own.difference.mean) for pick in (min, max) if gains]
    return f", by {' to '.join(map(text, ends))}" if ends else ""


def no_benefit(
    cells: Cells,
    paper: pd.DataFrame,
    method: str,
    baseline: str,
    corrected: bool,
    num_paper_runs: int,
    sizes: list[Size] | None,
) -> Finding:
    """The method is nowhere lower than the baseline beyond chance; ``None``: in both tables."""
    at = sizes or configurations(paper)
    gains = [compare(costs(cells, baseline, *s), costs(cells, method, *s)) for s in at]
    lower = [found == REPRODUCED for found in decided(gains, corrected)]
    evidence = (
        f"{label(method)} is significantly lower than {label(baseline)} in {sum(lower)} of "
        f"{len(lower)} configurations: by "
        + "; ".join(f"{text(gain)} at {describe(*s)}" for s, gain in zip(at, gains, strict=True))
    )
    verdict = together(holds(not is_lower) for is_lower in lower)
    return Finding(verdict, evidence, lower_in_tables(paper, method, baseline, num_paper_runs))


def lower_in_tables(paper: pd.DataFrame, method: str, baseline: str, num_runs: int) -> str:
    """In how many columns of the paper's own tables a method is lower beyond chance (Holm)."""
    if not {method, baseline} <= set(paper["method"]):
        return ""
    mean = paper.set_index(["method", *CONFIGURATION])["mean"].sort_index()
    gains = (mean[baseline] - mean[method]).to_numpy()
    zero, one = (
        sum(gain > 0 and p < 0.05 for gain, p in zip(gains, holm(own.tolist()), strict=True))
        for own in welch_of_tables(paper, method, baseline, num_runs)
    )
    return (
        f"by Welch's test {label(method)} is significantly lower in {zero} of its {len(gains)} "
        f"columns where its ± has ddof 0, in {one} where it has 1 (Holm)"
    )


def largely_similar(
    cells: Cells,
    paper: pd.DataFrame,
    method: str,
    baseline: str,
    margin: float,
    sizes: list[Size] | None,
) -> Finding:
    """The interval of the difference lies within a share of the baseline's cost, everywhere."""
    verdicts, relative, gains = [], [], []
    for size in sizes or configurations(paper):
        ours, base = costs(cells, method, *size), costs(cells, baseline, *size)
        gains.append(compare(ours, base))
        mean, low, high, _ = gains[-1].difference
        relative.append((mean / base.mean(), low / base.mean(), high / base.mean()))
        verdicts.append(within(*relative[-1][1:], -margin, margin))
    apart = sum(own.difference.p < 0.05 for own in gains)
    corrected = sum(found != UNDECIDED for found in decided(gains))
    ends = " to ".join(in_brackets(*own, "+.1%") for own in sorted({min(relative), max(relative)}))
    evidence = (
        f"within {margin:.0%} in {verdicts.count(REPRODUCED)} of {len(verdicts)} configurations, "
        f"beyond in {verdicts.count(CONTRADICTED)}; {label(method)} differs by {ends}, beyond "
        f"chance in {apart} ({corrected} by Holm's method)"
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


def ignores(
    cells: Cells, paper: pd.DataFrame, method: str, baseline: str, remaining_share: float
) -> Finding:
    """At most a share of the baseline's gain on distractors is left, in every configuration.

    By the Frobenius norm of the gain's columns for distractors, zero in the invariant controller.
    """
    verdicts, left = [], []
    for size in configurations(paper):
        ours, base = (
            adam_runs(cells, "gain_norm_distractor", name, *size) for name in (method, baseline)
        )
        mean, low, high, _ = compare(ours, base).difference
        share = [1 + own / base.mean() for own in (mean, low, high)]
        verdicts.append(within(*share[1:], -np.inf, remaining_share))
        left.append(f"{in_brackets(*share, '.0%')} at {describe(*size)}")
    evidence = (
        f"of {label(baseline)}'s gain on distractors, {label(method)} has left {'; '.join(left)}"
    )
    return Finding(together(verdicts), evidence)


def ahead_in_the_worst(
    cells: Cells,
    paper: pd.DataFrame,
    method: str,
    baseline: str,
    metric: str,
    corrected: bool,
    opposed: bool,
) -> Finding:
    """More efficient in new domains than the baseline, beyond chance, in every configuration.

    And, if ``opposed`` counts, with a stable loop in the domain that is chosen against the method.
    """
    sizes = configurations(paper)

    def values(name: str, of: str) -> list[pd.Series]:
        return [adam_runs(cells, of, name, *size) for size in sizes]

    gains = [
        compare(100 * ours, 100 * theirs)
        for ours, theirs in zip(values(method, metric), values(baseline, metric), strict=True)
    ]
    verdicts = decided(gains, corrected)
    ahead, behind = (verdicts.count(kind) for kind in (REPRODUCED, CONTRADICTED))
    parts = [
        f"{label(method)} is ahead of {label(baseline)} in {ahead} of {len(gains)} configurations "
        f"and behind in {behind}{span(gains)} points"
    ]
    for name in (method, baseline):
        efficiency = [own.mean() for own in values(name, metric)]
        unstable = [own.mean() for own in values(name, "share_unstable")]
        radii = pd.concat(values(name, "opposed_radius"))
        parts.append(
            f"{label(name)} has an efficiency of {min(efficiency):.0%} to {max(efficiency):.0%}, "
            f"an unstable loop in up to {max(unstable):.1%} of the new domains, and in the domain "
            f"chosen against it in {(radii >= 1).sum()} of {len(radii)} runs"
        )
    if opposed:
        stable = pd.concat(values(method, "opposed_radius")) < 1
        verdicts.append(holds(bool(stable.all())))
    return Finding(together(verdicts), "; ".join(parts))


def adam_runs(
    cells: Cells, metric: str, method: str, num_domains: int, dim_distractor: int
) -> pd.Series:
    """A metric of all runs with the published optimiser."""
    return cells.runs(
        metric=metric,
        method=method,
        num_domains=num_domains,
        dim_distractor=dim_distractor,
        optimizer="adam",
    )


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
    oracle = costs(cells, "oracle", num_domains[0], dim_distractor)
    falls = together(decided([compare(*pair) for pair in itertools.pairwise(by_number)]))
    gaps = [compare(values, oracle) for values in by_number]
    first, last = (gaps[i].difference.mean for i in (0, -1))
    close = last <= remaining_share * first
    evidence = f"gap of {label(method)} to the oracle ({oracle.mean():.1f}): " + "; ".join(
        f"{number} domains {text(gap)}" for number, gap in zip(num_domains, gaps, strict=True)
    )
    return Finding(falls if close or falls != REPRODUCED else IN_PART, evidence)


def configurations(paper: pd.DataFrame) -> list[Size]:
    """The paper's pairs of number of domains and distractor dimension."""
    return list(paper[CONFIGURATION].drop_duplicates().itertuples(index=False, name=None))


def text(own: Compared) -> str:
    """A difference of costs with its interval."""
    return in_brackets(*own.difference[:3], "z.1f")


def compared(method: str, baseline: str, size: Size) -> str:
    return f"{label(method)} under {label(baseline)} at {describe(*size)}"


def describe(num_domains: int, dim_distractor: int) -> str:
    return f"{num_domains} domains, {dim_distractor} distractors"
