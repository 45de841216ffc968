"""All experiments by chapter and name, as in ``data/results/lqr/tables.csv``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from experiments import causality, keys, keys_labels, lqr, lqr_worst, own_domains
from experiments.cue import training as cue
from experiments.doors import success as door
from experiments.experiment import Experiment, Places
from experiments.games import scalar as algorithm
from experiments.origin import ROOT
from experiments.regularized import linear, trials
from ipo.checks import check_choice

DATA = ROOT / "data"
CHAPTERS: dict[str, dict[str, Experiment]] = {
    "lqr": lqr.EXPERIMENTS | lqr_worst.EXPERIMENTS | linear.EXPERIMENTS,
    "keys": keys.EXPERIMENTS | trials.EXPERIMENTS | keys_labels.EXPERIMENTS,
    "cue": cue.EXPERIMENTS,
    "causality": causality.EXPERIMENTS,
    "algorithm": algorithm.EXPERIMENTS,
    "door": door.EXPERIMENTS,
    "your_own_domains": own_domains.EXPERIMENTS,
}


def chosen(names: Sequence[str]) -> list[tuple[str, str]]:
    """Chapter and name of every experiment that ``lqr`` or ``lqr/tables`` names; of none: all.

    Raises:
        ValueError: a name that is none of them.
    """
    every = [(chapter, name) for chapter, own in CHAPTERS.items() for name in own]
    known = {*CHAPTERS, *map("/".join, every)}
    for name in names:
        check_choice("experiment", name, sorted(known))
    return [pair for pair in every if not names or pair[0] in names or "/".join(pair) in names]


def again(chapter: str, name: str, scratch: Path) -> Experiment:
    """An experiment that is computed again: it reads what is shipped and writes to ``scratch``."""
    experiment = CHAPTERS[chapter][name]
    places = Places(
        tables=scratch / "tables",
        policies=DATA / "policies" / chapter if experiment.reads else scratch / "policies",
        checkpoints=scratch / "checkpoints",
    )
    return experiment.at(places)
