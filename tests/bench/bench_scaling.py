"""How a sweep scales from one worker process to two, and how much memory a worker needs.

    python tests/bench/bench_scaling.py [--rounds 3] [--json PATH]

The sweep has short trainings of three chapters, some dozens of CPU-seconds in all, and is run by
the loop of all experiments (``experiments.work``) with one worker and with two, in turns. Where
other programs run, wall time says little; so the load is recorded, and what the same jobs cost in
CPU-seconds beside each other. Memory is that of a whole batch, in a process of its own.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import resource
import statistics
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from threadpoolctl import threadpool_limits

from experiments.doors.training import CELLS, EXPERIMENT, shorter
from experiments.experiment import Cell, Places
from experiments.keys import arm
from experiments.lqr import published_cell
from experiments.origin import machine
from experiments.registry import CHAPTERS
from experiments.sealed import write_record
from experiments.store import timed
from experiments.work import finished

DOOR = replace(CELLS["ipo"], saved_after=(1,), curve_every=1)
ONE_UPDATE = replace(DOOR.settings, num_updates=1)
# Experiment, cell, runs at once. Memory does not depend on the number of iterations or updates.
WHOLE = {
    "lqr/tables": (published_cell("ipo_variable_phi", 10, 1000, num_iterations=30), 10),
    "keys/main": (arm("ipo", "ipo", num_updates=1), 25),
    "door/curves": (replace(DOOR, settings=ONE_UPDATE), EXPERIMENT.runs_at_once),
}
SWEEP = WHOLE | {"door/curves": (replace(DOOR, settings=shorter(ONE_UPDATE)), 1)}
NUM_OF_EACH = 6  # so that little time passes in which one worker has nothing left to do


def seconds(name: str, cell: Cell, num_runs: int, folder: Path) -> float:
    """CPU-seconds of a job from nothing: what it saves is its own, but for the tables."""
    chapter, experiment = name.split("/")
    one_thread = threadpool_limits(1)  # as in the workers, where this process computes alone
    with one_thread, TemporaryDirectory(dir=folder) as own:
        places = Places(folder / "tables", Path(own) / "policies", Path(own) / "checkpoints")
        run = CHAPTERS[chapter][experiment].at(places).run
        return timed(run, cell, list(range(num_runs)))[2]["cpu_seconds"]


def sweep(num_workers: int, folder: Path) -> dict[str, float]:
    """Wall and CPU-seconds of all jobs, by workers who did the same before.

    What a worker imports and tabulates first takes as long as its jobs, and little of a long sweep.
    """
    jobs = [
        partial(seconds, name, *SWEEP[name], folder) for _ in range(NUM_OF_EACH) for name in SWEEP
    ]
    list(finished(jobs, num_workers))
    began = time.perf_counter()
    cpu = sum(finished(jobs, num_workers))
    return {"wall": time.perf_counter() - began, "cpu": cpu}


def memory(name: str, cell: Cell, num_runs: int, folder: Path) -> float:
    """GiB of this process at its peak, after a job."""
    seconds(name, cell, num_runs, folder)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", type=Path, metavar="PATH", help="write the numbers there, too")
    options = parser.parse_args()
    if options.rounds < 1:
        parser.error("must be: --rounds >= 1")

    rounds, gib = [], {}
    spawned = multiprocessing.get_context("spawn")
    with TemporaryDirectory() as scratch:
        for name, (cell, num_runs) in WHOLE.items():  # first: it makes the tables of the keys
            with ProcessPoolExecutor(1, spawned) as process:
                gib[name] = process.submit(memory, name, cell, num_runs, Path(scratch)).result()
            print(f"{name}: {gib[name]:.2f} GiB")
        for _ in range(options.rounds):
            load = os.getloadavg()[0]
            one, two = (sweep(n, Path(scratch)) for n in (1, 2))
            rounds.append(
                {
                    "load before": load,
                    "CPU-seconds": one["cpu"],
                    "times as fast": one["wall"] / two["wall"],
                    "CPU-seconds beside each other": two["cpu"] / one["cpu"],
                }
            )
            print(", ".join(f"{name} {value:.2f}" for name, value in rounds[-1].items()))
            if options.json:  # after each: a round takes minutes
                write_record(options.json, summary(rounds, gib))


def summary(rounds: list[dict[str, float]], gib: dict[str, float]) -> dict[str, object]:
    """The record of all rounds so far."""
    median = {key: statistics.median(r[key] for r in rounds) for key in rounds[0]}
    return {"machine": machine(), "rounds": len(rounds), "median": median, "gib": gib}


if __name__ == "__main__":
    main()
