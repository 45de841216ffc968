"""What a claim can come to, and the decision table that every comparison goes through."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
import pandas as pd
import scipy.optimize
import scipy.stats

from ipo.stats import Difference, holm, paired_difference, power
from rules.cells import shown, with_interval

REPRODUCED = "reproduced"
IN_PART = "reproduced in part"
UNDECIDED = "undecided"
CONTRADICTED = "contradicted"
EXPLAINED = "explained otherwise"
NO_DATA = "no data yet"


@dataclass(frozen=True)
class Finding:
    """A verdict and what it rests on.

    Attributes:
        theirs: what the paper's own numbers say by the same question, if they can be tested.
        variants: the findings that other choices of the rule's settings lead to.
    """

    verdict: str
    evidence: str
    theirs: str = ""
    variants: dict[str, Finding] = field(default_factory=dict)


def verdict(low: float, high: float, effect: float | None = None) -> str:
    """The verdict on an effect that is claimed to be positive, from its 95 % interval.

    ==================  ==============================================================
    interval            verdict
    ==================  ==============================================================
    above zero          reproduced; in part, if it ends below the paper's ``effect``
    below zero          contradicted
    contains zero       undecided if it contains the paper's effect or there is none to
                        compare with, contradicted if it excludes it
    ==================  ==============================================================
    """
    smaller = effect is not None and high < effect
    if low > 0:
        return IN_PART if smaller else REPRODUCED
    return CONTRADICTED if high < 0 or smaller else UNDECIDED


def within(low: float, high: float, least: float, most: float) -> str:
    """The verdict on an effect that is claimed to lie between two bounds, from its interval."""
    if least <= low and high <= most:
        return REPRODUCED
    return CONTRADICTED if high < least or low > most else UNDECIDED


def holds(outcome: bool) -> str:
    return REPRODUCED if outcome else CONTRADICTED


def together(verdicts: Iterable[str]) -> str:
    """The verdict on a claim of several parts: theirs, if it is the same for all.

    Otherwise it is reproduced in part if any part is, and undecided if none is.
    """
    kinds = set(verdicts)
    if len(kinds) == 1:
        return kinds.pop()
    return IN_PART if kinds & {REPRODUCED, IN_PART} else UNDECIDED


def counted(verdicts: Sequence[str]) -> str:
    """How often each verdict fell."""
    return ", ".join(f"{verdicts.count(kind)} {kind}" for kind in dict.fromkeys(verdicts))


# --- differences ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Compared:
    """Values minus baseline over runs, beside the paper's effect, if it has one.

    Attributes:
        spread: the standard deviation of the difference of two runs.
    """

    difference: Difference
    spread: float
    num_runs: int
    effect: float | None = None

    @property
    def verdict(self) -> str:
        return verdict(self.difference.low, self.difference.high, self.effect)

    def text(self) -> str:
        """The difference with its interval, the paper's effect, and the power to find that one."""
        mean, low, high, p = self.difference
        digits = 1 if self.spread > 1 else 3
        chance = "p < 0.001" if p < 0.001 else f"p = {p:.3f}"
        found = f"{with_interval(mean, low, high, digits)}, {chance}"
        if max(-low, high) < 0.5 * 10**-digits:  # then the digits say nothing
            found = f"less than {10**-digits:g}, as at both ends of its 95 % interval, {chance}"
        if self.effect is None or not self.spread:
            return found
        theirs = shown(self.effect, f"+.{digits}f")
        there = power(self.effect, self.spread, self.num_runs)
        return (
            f"{found} (the paper's difference is {theirs}; the power to tell that from zero is "
            f"{there:.0%})"
        )


def compare(
    values: pd.Series, baseline: pd.Series, effect: float | None = None, paired: bool = True
) -> Compared:
    """Values minus baseline over runs: paired by run, or by Welch's test."""
    if paired:
        spread = (values - baseline).std()
        return Compared(paired_difference(values, baseline), spread, len(values), effect)
    test = scipy.stats.ttest_ind(values, baseline, equal_var=False)
    mean = float(values.mean() - baseline.mean())
    found = Difference(mean, *test.confidence_interval(0.95), float(test.pvalue))
    return Compared(found, np.hypot(values.std(), baseline.std()), len(values), effect)


def detectable(spread: float, num_runs: int) -> float:
    """The smallest effect that so many runs find with a power of 80 %."""
    in_spreads = scipy.optimize.brentq(lambda e: power(e, 1.0, num_runs) - 0.8, 1e-6, 100.0)
    return float(in_spreads * spread)


def decided(compared: Sequence[Compared], corrected: bool = True) -> list[str]:
    """Verdicts on differences that are claimed to be positive, whatever their size.

    ``corrected`` by Holm's method: the chance that any of them is decided wrongly is 5 %.
    """
    p = [own.difference.p for own in compared]
    return [
        holds(own.difference.mean > 0) if own_p < 0.05 else UNDECIDED
        for own, own_p in zip(compared, holm(p) if corrected else p, strict=True)
    ]
