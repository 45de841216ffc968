"""Speed of the doors: simulation, one update of PPO and of IPO, memory.

    python tests/bench/bench_door.py [--blocks 6] [--steps 60] [--json PATH]

CPU time is compared in short blocks that take turns, so that a busy machine slows all alike. What
training needs is the published settings' rollout and updates, measured once and multiplied: of one
run alone, and of each of as many as are trained together.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from experiments.doors.training import CELLS, EXPERIMENT, NETWORK, new_training
from experiments.origin import machine
from experiments.sealed import write_record
from ipo.worlds.many_doors import VectorDoor
from ipo.worlds.one_door import DoorEnv

FRICTIONS = [0.0] * 24 + [0.1] * 8
UPDATES = 190  # of 131,072 steps each: 25 million


def cpu_seconds(work: Callable[[], object]) -> float:
    before = time.process_time()
    work()
    return time.process_time() - before


def acting(timestep: float) -> Callable[[int], None]:
    """32 doors with random actions of a policy, as in training."""
    doors = VectorDoor(FRICTIONS, timestep=timestep)
    policy = NETWORK.frozen([NETWORK.start([np.random.default_rng(0)])])
    generator = [np.random.default_rng(0)]
    state = {"observations": doors.reset(seed=0)[0]}

    def run(num_steps: int) -> None:
        for _ in range(num_steps):
            rows = torch.tensor(state["observations"], dtype=torch.float32).unsqueeze(0)
            actions = NETWORK.distribution.sample(policy(rows)[0], generator)[0]
            state["observations"] = doors.step(actions.numpy())[0]

    return run


def one_at_a_time() -> Callable[[int], None]:
    """The published time step, one environment, and the network in torch."""
    env, weights = DoorEnv(0.0, timestep=0.001), NETWORK.start([np.random.default_rng(0)])
    generator = [np.random.default_rng(0)]
    state = {"observation": env.reset(seed=0)[0]}

    @torch.no_grad()
    def run(num_steps: int) -> None:
        for _ in range(num_steps):
            rows = torch.tensor(state["observation"], dtype=torch.float32)[None, None]
            parameters, _ = NETWORK(weights, rows)
            action = NETWORK.distribution.sample(parameters, generator)[0, 0]
            state["observation"], _, _, truncated, _ = env.step(action.numpy())
            if truncated:
                state["observation"], _ = env.reset()

    return run


def simulation(num_steps: int, num_blocks: int) -> dict[str, list[float]]:
    """Steps of a door per CPU second, and ratios, block by block."""
    ways = {
        "0.004 s, 32 doors": (acting(0.004), 32),
        "0.001 s, 32 doors": (acting(0.001), 32),
        "0.001 s, one by one": (one_at_a_time(), 1),
    }
    speeds: dict[str, list[float]] = {name: [] for name in ways}
    for _ in tqdm(range(num_blocks), desc="simulation", unit="block"):
        for name, (run, num_doors) in ways.items():
            number = num_steps * (32 // num_doors) // (4 if num_doors == 1 else 1)
            spent = cpu_seconds(lambda run=run, number=number: run(number))
            speeds[name].append(number * num_doors / spent)
    fast, *slow = speeds
    for name in slow:
        pairs = zip(speeds[fast], speeds[name], strict=True)
        speeds[f"ratio to {name}"] = [a / b for a, b in pairs]
    return speeds


def update_costs(method: str, num_runs: int) -> dict[str, float]:
    """CPU seconds of a run's share in a published update: simulation, and what learning costs."""
    training = new_training(CELLS[method], range(num_runs))
    costs = {"simulation": 0.0, "learning": 0.0}
    for d, collector in enumerate(training.collectors):
        average = training.learners.acting()
        start = time.process_time()
        rollout = collector.collect(average, NETWORK.distribution, training.draws)
        collected = time.process_time()
        training.improve(d, rollout.frames())
        costs["simulation"] += collected - start
        costs["learning"] += time.process_time() - collected
    return {part: seconds / num_runs for part, seconds in costs.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--blocks", type=int, default=6)
    parser.add_argument("--steps", type=int, default=60, help="of 32 doors in each block")
    parser.add_argument("--json", type=Path, metavar="PATH", help="write the numbers there, too")
    options = parser.parse_args()
    if options.blocks < 1 or options.steps < 4:
        parser.error("must be: --blocks >= 1, --steps >= 4")

    torch.set_num_threads(1)
    threadpool_limits(1)  # NumPy's, with which networks act and learn
    speeds = {
        name: statistics.median(values)
        for name, values in simulation(options.steps, options.blocks).items()
    }
    print("Steps of a door per CPU second, with the policy; ratios")
    for name, value in speeds.items():
        print(f"  {name:32}{value:12,.1f}")
    runs_at_once = EXPERIMENT.runs_at_once
    costs = {
        method: {"alone": update_costs(method, 1), "together": update_costs(method, runs_at_once)}
        for method in ("ppo", "ipo")
    }
    print(f"CPU minutes of 25 million steps of a run, alone and together with {runs_at_once - 1}")
    for method, ways in costs.items():
        for way, parts in ways.items():
            minutes = {name: seconds * UPDATES / 60 for name, seconds in parts.items()}
            text = ", ".join(f"{name} {value:.1f}" for name, value in minutes.items())
            title = f"{method} {way}"
            print(f"  {title:32}{sum(minutes.values()):12.1f}   ({text})")
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"Memory at its peak: {memory:.2f} GiB")
    if options.json:
        numbers = {
            "machine": machine(),
            "speeds": speeds,
            "update_cpu_seconds": costs,
            "runs_at_once": runs_at_once,
            "memory_gib": memory,
        }
        write_record(options.json, numbers)


if __name__ == "__main__":
    main()
