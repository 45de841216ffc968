"""The rules that decide claims of the paper: pure functions of rows of results.

A rule gets the cells of our results, the paper's numbers and the claim's settings, and returns a
``Finding``. It raises ``NoData`` where a cell that it needs is missing or incomplete.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import pandas as pd
import scipy.stats

from experiments.store import select
from ipo.worlds.pulling import strategy_of_policy

CONFIGURATION = ["num_domains", "dim_distractor"]

REPRODUCED = "reproduced"
IN_PART = "reproduced in part"
NOT_SUPPORTED = "not supported"
NO_DATA = "no data yet"

NAMES = {
    "gradient_descent": "gradient descent",
    "overparameterized": "overparameterised",
    "ipo_fixed_phi": "IPO, fixed Φ",
    "ipo_variable_phi": "IPO, variable Φ",
    "oracle": "oracle",
    "ppo": "PPO",
    "ipo": "IPO",
    "ensemble": "the ensemble with pooled data",
}


class NoData(Exception):
    """A cell that a rule needs is missing."""


@dataclass(frozen=True)
class Finding:
    verdict: str
    evidence: str


@dataclass(frozen=True)
class Cells:
    """Rows of results, and how many runs make a cell complete."""

    rows: pd.DataFrame
    num_runs: int

    def select(self, **where) -> pd.DataFrame:
        """The rows with these values in these columns; domains are words, also those of doors."""
        words = {"domain": str(where["domain"])} if "domain" in where else {}
        return select(self.rows, where | words)

    def runs(self, **where) -> pd.Series:
        """Value of every run of a cell, or the mean of its values, indexed by run."""
        chosen = self.select(**where)
        values = chosen.groupby("run")["value"].agg(lambda own: own.mean(skipna=False))
        if len(values) < self.num_runs or values.isna().any():
            cell = ", ".join(f"{column} {value}" for column, value in where.items())
            raise NoData(f"{cell}: {values.count()} of {self.num_runs} runs")
        return values

    def costs(self, method, num_domains, dim_distractor, optimizer="adam") -> pd.Series:
        """Test costs of linear quadratic control; the oracle needs no optimiser."""
        return self.runs(
            metric="test_cost",
            domain="test",
            method=method,
            num_domains=num_domains,
            dim_distractor=dim_distractor,
            optimizer="none" if method == "oracle" else optimizer,
        )

    def mean(self, method, num_domains, dim_distractor, optimizer="adam") -> float:
        return float(self.costs(method, num_domains, dim_distractor, optimizer).mean())


# --- linear quadratic control ---------------------------------------------------------------------


def cells_come_back(cells: Cells, paper: pd.DataFrame, tolerance: dict[str, float]) -> Finding:
    """Every mean of the paper within the tolerance of its method."""
    inside, parts = [], []
    for method, bound in tolerance.items():
        rows = paper[paper.method == method]
        apart = [
            abs(cells.mean(method, row.num_domains, row.dim_distractor) - row.mean)
            for row in rows.itertuples(index=False, name="PaperCell")
        ]
        good = [distance <= bound for distance in apart]
        inside += good
        parts.append(
            f"{NAMES[method]}: {sum(good)} of {len(good)} within {bound}, largest difference "
            f"{max(apart):.2f}"
        )
    return Finding(all_some_none(inside), "; ".join(parts))


def lower_everywhere(cells: Cells, paper: pd.DataFrame, method: str, baseline: str) -> Finding:
    """The method's mean is below the baseline's in every configuration of the paper."""
    gaps = {
        configuration: cells.mean(baseline, *configuration) - cells.mean(method, *configuration)
        for configuration in configurations(paper)
    }
    smallest, largest = min(gaps, key=gaps.get), max(gaps, key=gaps.get)
    evidence = (
        f"lower in {sum(gap > 0 for gap in gaps.values())} of {len(gaps)} configurations; by "
        f"{gaps[smallest]:.1f} ({describe(*smallest)}) to {gaps[largest]:.1f} "
        f"({describe(*largest)})"
    )
    return Finding(all_some_none([gap > 0 for gap in gaps.values()]), evidence)


def significantly_lower(
    cells: Cells, paper: pd.DataFrame, methods: list[str], baselines: list[str]
) -> Finding:
    """The 95 % interval of the paired difference over runs lies below zero, in every cell."""
    lower, exceptions = [], []
    for method, baseline, configuration in itertools.product(
        methods, baselines, configurations(paper)
    ):
        difference = cells.costs(method, *configuration) - cells.costs(baseline, *configuration)
        lower.append(upper_end(difference) < 0)
        if not lower[-1]:
            exceptions.append(
                f"{NAMES[method]} is {higher_or_lower(difference.mean())} than {NAMES[baseline]} "
                f"at {describe(*configuration)}"
            )
    theirs = paper_means(paper)
    own = [
        theirs[method, *configuration] < theirs[baseline, *configuration]
        for method, baseline, configuration in itertools.product(
            methods, baselines, configurations(paper)
        )
    ]
    evidence = (
        f"significantly lower in {sum(lower)} of {len(lower)} comparisons of a method with a "
        f"baseline (the paper's own means are lower in {sum(own)})"
    )
    if exceptions:
        evidence += "; the others: " + "; ".join(exceptions)
    return Finding(all_some_none(lower), evidence)


def tends_to_oracle(
    cells: Cells,
    paper: pd.DataFrame,
    method: str,
    dim_distractor: int,
    num_domains: list[int],
    remaining_share: float,
) -> Finding:
    """The gap to the oracle shrinks with every step and ends below a share of the first gap."""
    oracle = cells.mean("oracle", num_domains[0], dim_distractor)
    gaps = [cells.mean(method, number, dim_distractor) - oracle for number in num_domains]
    shrinks = all(after < before for before, after in itertools.pairwise(gaps))
    close = gaps[-1] <= remaining_share * gaps[0]
    evidence = f"gap of {NAMES[method]} to the oracle ({oracle:.1f}): " + "; ".join(
        f"{number} domains {gap:.1f}" for number, gap in zip(num_domains, gaps, strict=True)
    )
    if not shrinks:
        return Finding(NOT_SUPPORTED, evidence)
    return Finding(REPRODUCED if close else IN_PART, evidence)


def gap_survives_plain_steps(
    cells: Cells,
    paper: pd.DataFrame,
    method: str,
    baseline: str,
    dim_distractor: int,
    num_domains: list[int],
    survives: float,
    vanishes: float,
) -> Finding:
    """The advantage under Adam is still there when both methods take plain gradient steps."""
    shares, parts = [], []
    for number in num_domains:
        adam, plain = (
            cells.mean(baseline, number, dim_distractor, optimizer)
            - cells.mean(method, number, dim_distractor, optimizer)
            for optimizer in ("adam", "plain")
        )
        shares.append(plain / adam)
        parts.append(
            f"{number} domains {shown(adam)} with Adam, {shown(plain)} with plain gradient steps"
        )
    evidence = f"{NAMES[baseline]} minus {NAMES[method]}: " + "; ".join(parts)
    if all(share >= survives for share in shares):
        return Finding(REPRODUCED, evidence)
    if all(share <= vanishes for share in shares):
        return Finding(NOT_SUPPORTED, evidence)
    return Finding(IN_PART, evidence)


# --- coloured keys --------------------------------------------------------------------------------


def means_come_back(
    cells: Cells,
    paper: pd.DataFrame,
    metric: str,
    num_paper_runs: int,
    digits: int,
    where: dict[str, dict],
) -> Finding:
    """Every mean of the paper is as near to ours as the spread of its runs lets us expect.

    Within two standard errors of the difference, or within the rounding of what is printed.
    ``where`` says which rows of a method are meant.
    """
    good, parts = [], []
    for row in paper.itertuples(index=False, name="PaperCell"):
        ours = cells.runs(method=row.method, domain=row.domain, metric=metric, **where[row.method])
        error = np.hypot(row.std / np.sqrt(num_paper_runs), ours.sem())
        good.append(abs(ours.mean() - row.mean) <= max(2 * error, 0.5 * 10**-digits))
        parts.append(
            f"{NAMES[row.method]} on {row.domain} {ours.mean():.3f} (paper {row.mean:.{digits}f})"
        )
    return Finding(all_some_none(good), "; ".join(parts))


def higher_return(
    cells: Cells, paper: pd.DataFrame, method: str, baseline: str, domain: str, metric: str
) -> Finding:
    """The 95 % interval of the difference of the means lies above zero."""
    ours, theirs = (
        cells.runs(method=name, domain=domain, metric=metric) for name in (method, baseline)
    )
    test = scipy.stats.ttest_ind(ours, theirs, equal_var=False)
    low, high = test.confidence_interval(0.95)
    evidence = (
        f"{NAMES[method]} minus {NAMES[baseline]} on {domain}: {ours.mean() - theirs.mean():+.3f}, "
        f"95 % interval [{low:+.3f}, {high:+.3f}], {len(ours)} runs each"
    )
    return Finding(REPRODUCED if low > 0 else NOT_SUPPORTED, evidence)


def smaller_spread(
    cells: Cells, paper: pd.DataFrame, method: str, baseline: str, domain: str, metric: str
) -> Finding:
    """The method's runs vary less, by the test of Brown and Forsythe at 5 %."""
    ours, theirs = (
        cells.runs(method=name, domain=domain, metric=metric) for name in (method, baseline)
    )
    p = scipy.stats.levene(ours, theirs, center="median").pvalue
    means = paper.set_index(["method", "domain"])["std"]
    evidence = (
        f"standard deviation over runs on {domain}: {NAMES[method]} {ours.std(ddof=0):.3f}, "
        f"{NAMES[baseline]} {theirs.std(ddof=0):.3f} (paper {means[method, domain]:.2f} and "
        f"{means[baseline, domain]:.2f}); p = {p:.3f}"
    )
    smaller = ours.std() < theirs.std() and p < 0.05
    return Finding(REPRODUCED if smaller else NOT_SUPPORTED, evidence)


# --- door opening ---------------------------------------------------------------------------------


def higher_success(
    cells: Cells, paper: pd.DataFrame, domains: list[float], comparisons: dict[str, list[dict]]
) -> Finding:
    """The 95 % interval of the difference lies above zero, in every comparison of two arms.

    Of a run, the mean over the domains counts.
    """
    good, parts = [], []
    for name, arms in comparisons.items():
        ours, theirs = (
            sum(cells.runs(metric="success", domain=domain, **arm) for domain in domains)
            / len(domains)
            for arm in arms
        )
        low, high = scipy.stats.ttest_ind(ours, theirs, equal_var=False).confidence_interval(0.95)
        good.append(low > 0)
        parts.append(
            f"{name}: {ours.mean():.3f} and {theirs.mean():.3f}, difference "
            f"{ours.mean() - theirs.mean():+.3f}, 95 % interval [{low:+.3f}, {high:+.3f}]"
        )
    return Finding(all_some_none(good), "; ".join(parts))


def strategies_come_back(
    cells: Cells, paper: pd.DataFrame, domain: float, hooking: dict, outside: dict
) -> Finding:
    """All policies of one arm hook, and most of the other's pull with the outside."""
    counts = {}
    for role, arm in (("hook", hooking), ("outside", outside)):
        where = {"metric": "inside_part", "domain": domain, **arm}
        cells.runs(**where)  # complete, or no verdict
        names = (
            cells.select(**where)
            .groupby("run")["value"]
            .agg(lambda parts: strategy_of_policy(parts.tolist()))
        )
        counts[role] = names.value_counts().reindex(["hook", "mixed", "outside"], fill_value=0)
    evidence = "; ".join(
        f"{NAMES[arm['method']]}: " + ", ".join(f"{n} {name}" for name, n in counts[role].items())
        for role, arm in (("hook", hooking), ("outside", outside))
    )
    all_hook = counts["hook"]["hook"] == counts["hook"].sum()
    most_outside = counts["outside"]["outside"] > counts["outside"].sum() / 2
    return Finding(all_some_none([bool(all_hook), bool(most_outside)]), evidence)


def hooks_are_robust(
    cells: Cells, paper: pd.DataFrame, watched: float, tested: float, arms: list[dict]
) -> Finding:
    """Over policies, the part of the pull by the inside of the hook goes with success."""
    part, success = (
        pd.concat([cells.runs(metric=metric, domain=domain, **arm) for arm in arms])
        for metric, domain in (("inside_part", watched), ("success", tested))
    )
    found = scipy.stats.spearmanr(part, success)
    evidence = (
        f"rank correlation over {len(part)} policies between the part at friction {watched} and "
        f"success at {tested}: {found.statistic:+.2f}, p = {found.pvalue:.2f}"
    )
    supported = found.statistic > 0 and found.pvalue < 0.05
    return Finding(REPRODUCED if supported else NOT_SUPPORTED, evidence)


# --- what rules share -----------------------------------------------------------------------------


def all_some_none(outcomes: list[bool]) -> str:
    if all(outcomes):
        return REPRODUCED
    return IN_PART if any(outcomes) else NOT_SUPPORTED


def configurations(paper: pd.DataFrame) -> list[tuple[int, int]]:
    """The paper's pairs of number of domains and distractor dimension."""
    return list(paper[CONFIGURATION].drop_duplicates().itertuples(index=False, name=None))


def paper_means(paper: pd.DataFrame) -> dict[tuple, float]:
    """Mean by (method, number of domains, distractor dimension)."""
    return paper.set_index(["method", *CONFIGURATION])["mean"].to_dict()


def upper_end(difference: pd.Series) -> float:
    """Upper end of the 95 % Student interval of the mean."""
    error = difference.std(ddof=1) / np.sqrt(len(difference))
    return float(difference.mean() + scipy.stats.t.ppf(0.975, len(difference) - 1) * error)


def shown(number: float) -> str:
    """One decimal, a true minus sign, and no negative zero."""
    return f"{number:z.1f}".replace("-", "−")


def higher_or_lower(difference: float) -> str:
    return f"{abs(difference):.1f} {'higher' if difference > 0 else 'lower'}"


def describe(num_domains: int, dim_distractor: int) -> str:
    return f"{num_domains} domains, {dim_distractor} distractors"


RULES = {
    rule.__name__: rule
    for rule in (
        cells_come_back,
        lower_everywhere,
        significantly_lower,
        tends_to_oracle,
        gap_survives_plain_steps,
        means_come_back,
        higher_return,
        smaller_spread,
        higher_success,
        strategies_come_back,
        hooks_are_robust,
    )
}
