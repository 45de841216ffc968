"""CPU time of training and evaluation on the coloured keys, beside a plain loop over MiniGrid.

    python tests/bench/bench_keys.py [--updates 5] [--json PATH]

The published PPO and IPO on red and green. The module trains ten or 25 runs at once on the table;
the plain loop (``tests/plain_ppo.py``, which the tests show to learn the same weights) trains one
run in MiniGrid. It calls the network for each step of each copy (``single``), or once for a step of
all 24 or 48 copies of a player (``batched``). They take turns, update by update of 6,144 frames, so
that a busy machine slows all; every update gives ratios. One thread. A run has 20 updates: fewer
are scaled up. Tabulation happens once, before, and is shown apart.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
from minigrid.wrappers import ImgObsWrapper
from tqdm import tqdm

from experiments.keys import Cell, Keys, published
from experiments.sealed import write_record
from ipo.worlds.colored_keys import ColoredKeysEnv
from ipo.worlds.minigrid_tables import tabulate
from ipo.worlds.tabular import expected_return

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import plain_ppo

COLORS = ("red", "green")
METHODS = ("ppo", "ipo")
AT_ONCE = (10, 25)
UPDATES_OF_A_RUN = 20
NUM_POLICIES = 100
GOALS = {"seconds of a run": 3.0, "ratio": 15.0, "seconds of an evaluation": 1.0}


def cpu_seconds(work: Callable[[], object]) -> float:
    """CPU seconds of this process."""
    before = time.process_time()
    work()
    return time.process_time() - before


def stacked(task: Keys, method: str, num_runs: int) -> Iterator:
    """Training of many runs; every ``next`` is an update."""
    reports = task.train(Cell(method, published(method)), list(range(num_runs)))
    next(reports)  # the start
    return reports


def plain(method: str, at_once: bool) -> Iterator:
    """Training of one run in MiniGrid; every ``next`` is an update."""
    settings = published(method)
    owned = [move.domains for move in settings.moves(len(COLORS))]
    copies = settings.copies(len(COLORS))
    envs = [
        [ImgObsWrapper(ColoredKeysEnv(color=COLORS[d])) for d in domains for _ in range(own[0])]
        for domains, own in zip(owned, copies, strict=True)
    ]
    players = [plain_ppo.ActorCritic() for _ in owned]
    draws, orders = np.random.default_rng(0), np.random.default_rng(1)
    seeds = [range(len(own)) for own in envs]
    return plain_ppo.train(players, envs, settings, draws, orders, seeds, at_once)


def training(task: Keys, method: str, num_updates: int) -> dict[str, list[float]]:
    """Seconds of a whole run and ratios, for every update."""
    fast = {number: stacked(task, method, number) for number in AT_ONCE}
    slow = {"single": plain(method, at_once=False), "batched": plain(method, at_once=True)}
    columns: dict[str, list[float]] = {}
    for _ in tqdm(range(num_updates), desc=method, unit="update"):
        loops = {name: cpu_seconds(lambda own=own: next(own)) for name, own in slow.items()}
        seconds = {
            f"{method}, {name} plain loop [s]": UPDATES_OF_A_RUN * loop
            for name, loop in loops.items()
        }
        for number, reports in fast.items():
            of_run = cpu_seconds(lambda reports=reports: next(reports)) / number
            seconds[f"{method}, {number} at once [s]"] = of_run * UPDATES_OF_A_RUN
            for name, loop in loops.items():
                seconds[f"{method}, {number} at once, ratio to {name}"] = loop / of_run
        for name, value in seconds.items():
            columns.setdefault(name, []).append(value)
    return columns


def evaluation(task: Keys, num_times: int) -> dict[str, list[float]]:
    """Seconds to get 100 policies of two players from their weights, and their exact returns."""
    generators = [np.random.default_rng(run) for run in range(NUM_POLICIES)]
    players = [task.network.start(generators) for _ in COLORS]
    table = task.tasks["grey"]

    def policies() -> np.ndarray:
        return task.logits(players, table.images).softmax(-1).numpy()

    ready = policies()
    everything = [cpu_seconds(lambda: expected_return(table, policies())) for _ in range(num_times)]
    alone = [cpu_seconds(lambda: expected_return(table, ready)) for _ in range(num_times)]
    return {
        f"{NUM_POLICIES} policies, network and return [s]": everything,
        f"{NUM_POLICIES} policies, return alone [s]": alone,
    }


def verdicts(rows: dict[str, dict[str, float]]) -> dict[str, bool]:
    """Whether the medians reach the goals."""
    reached = {}
    for name, row in rows.items():
        if "at once [s]" in name:
            reached[name] = row["median"] <= GOALS["seconds of a run"]
        elif "ratio to single" in name:
            reached[name] = row["median"] >= GOALS["ratio"]
        elif "policies" in name:
            reached[name] = row["median"] < GOALS["seconds of an evaluation"]
    return reached


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--updates", type=int, default=5, help="of each training; 20 are a run")
    parser.add_argument("--json", type=Path, metavar="PATH", help="write the numbers there, too")
    options = parser.parse_args()
    if not 0 < options.updates <= UPDATES_OF_A_RUN:
        parser.error(f"must be: 0 < --updates <= {UPDATES_OF_A_RUN}")

    torch.set_num_threads(1)
    columns = {
        "tabulation of one colour [s]": [cpu_seconds(lambda: tabulate(ColoredKeysEnv()))],
    }
    with tempfile.TemporaryDirectory() as folder:
        task = Keys(folder)
    for method in METHODS:
        columns |= training(task, method, options.updates)
    columns |= evaluation(task, options.updates)
    rows = {
        name: {"median": statistics.median(values), "min": min(values), "max": max(values)}
        for name, values in columns.items()
    }
    reached = verdicts(rows)
    print(f"{'CPU time, one thread; runs of 122,880 frames':48}{'median':>9}{'min':>9}{'max':>9}")
    for name, row in rows.items():
        goal = {True: "  reached", False: "  MISSED"}.get(reached.get(name), "")
        print(f"{name:48}" + "".join(f"{value:9.2f}" for value in row.values()) + goal)
    if options.json:
        content = {"updates": options.updates, "goals": GOALS, "rows": rows}
        write_record(options.json, content)


if __name__ == "__main__":
    main()
