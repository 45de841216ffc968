"""Train policies for doors, each run where it was interrupted.

    python -m experiments.doors.train [--cells ppo ipo] [--seeds 0 1 2] [--scheduler tcp://...]

Runs are trained side by side, one on each core or each worker of a dask scheduler; those that are
finished are left alone. A run that ends adds its policies and its learning curve to ``data/``; one
that is interrupted loses at most one update, and may go on with more or fewer workers.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from experiments.doors.training import CELLS, EXPERIMENT
from experiments.experiment import Places
from experiments.store import Store


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cells", nargs="+", choices=CELLS, default=["ppo", "ipo"])
    parser.add_argument("--seeds", nargs="+", type=int, default=list(range(10)))
    parser.add_argument("--data", type=Path, default=Path("data"), help="folder of the results")
    parser.add_argument("--scheduler", help="address of a dask scheduler whose workers train")
    options = parser.parse_args()

    data = options.data.resolve()  # workers may have been started elsewhere
    places = Places(
        tables=data / "tabulated",
        policies=data / "policies" / "door",
        checkpoints=data / "checkpoints" / "door",
    )
    cells = [CELLS[label] for label in options.cells]
    store = Store(data / "results" / "door", "curves")
    store.fill(EXPERIMENT.at(places), cells, options.seeds, -1, options.scheduler)


if __name__ == "__main__":
    main()
