"""Train policies for doors, each run where it was interrupted.

    python -m experiments.doors.train [--cells ppo ipo] [--seeds 0 1 2]

Runs are trained one after the other, seed by seed; those that are finished are left alone. A run
that ends adds its policies and its learning curve to ``data/``; one that is interrupted loses at
most one update.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from tqdm import tqdm

from experiments.doors.training import CELLS, EXPERIMENT
from experiments.experiment import Places
from experiments.store import Store


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cells", nargs="+", choices=CELLS, default=["ppo", "ipo"])
    parser.add_argument("--seeds", nargs="+", type=int, default=list(range(10)))
    parser.add_argument("--data", type=Path, default=Path("data"), help="folder of the results")
    options = parser.parse_args()

    torch.set_num_threads(1)  # the matrices are small: start the command twice for two cores
    places = Places(
        tables=options.data / "tabulated",
        policies=options.data / "policies" / "door",
        checkpoints=options.data / "checkpoints" / "door",
    )
    store = Store(options.data / "results" / "door", "curves")
    for seed in options.seeds:
        for label in options.cells:
            store.fill(EXPERIMENT.at(places), [CELLS[label]], [seed], num_workers=1)
            tqdm.write(f"{label} {seed} is finished")


if __name__ == "__main__":
    main()
