"""All experiments by chapter and name, as in ``data/results/lqr/tables.csv``."""

from __future__ import annotations

from pathlib import Path

from experiments import algorithm, causality, door, keys, lqr, own_domains
from experiments.experiment import Experiment, Places
from experiments.origin import ROOT

DATA = ROOT / "data"
CHAPTERS: dict[str, dict[str, Experiment]] = {
    "lqr": lqr.EXPERIMENTS,
    "keys": keys.EXPERIMENTS,
    "causality": causality.EXPERIMENTS,
    "algorithm": algorithm.EXPERIMENTS,
    "door": door.EXPERIMENTS,
    "your_own_domains": own_domains.EXPERIMENTS,
}


def again(chapter: str, name: str, scratch: Path) -> Experiment:
    """An experiment that is computed again: it reads what is shipped and writes to ``scratch``."""
    experiment = CHAPTERS[chapter][name]
    places = Places(
        tables=scratch / "tables",
        policies=DATA / "policies" / chapter if experiment.reads else scratch / "policies",
        checkpoints=scratch / "checkpoints",
    )
    return experiment.at(places)
