"""CPU time of training on the LQR problem, beside the straightforward implementation's.

    python tests/bench/bench_lqr.py [--iterations 200] [--blocks 10] [--json PATH]

IPO with fixed Phi, 5 domains, 1000 distractors, ten seeds. First both implementations are shown
to learn the same controller. Then they take turns in short blocks, so that a busy machine slows
both, and every block gives a ratio. Training is measured from its start, where the cost takes the
most doublings: later it is faster, while the straightforward implementation stays as it is.

The other yardstick is a stripped prototype of the same round: only the tensor operations that
must be done, for ``B = Q = R = I``, without autograd, checks or parts. It shows what clarity costs.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

from experiments.sealed import write_record
from ipo.game import LinearPlayers
from ipo.lqr import LQR, sample_problem
from ipo.lqr_learners import LQR_METHODS, published_lqr, train
from ipo.optimizers import make_optimizer

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import straightforward

SEEDS = list(range(10))
SIZES = {"num_domains": 5, "dim_distractor": 1000}
DEFAULT_THREADS = torch.get_num_threads()
NUM_SLOW = 2  # iterations of one seed in a block
NUM_COMPARED, TOLERANCE = 5, 1e-6  # iterations; double precision, relative to the largest entry


def cpu_ms(work: Callable[[], object], num_iterations: int, num_threads: int = 1) -> float:
    """CPU milliseconds per iteration, summed over the threads of this process."""
    torch.set_num_threads(num_threads)
    before = time.process_time()
    work()
    elapsed = time.process_time() - before
    if num_threads > 1:
        time.sleep(0.3)  # idle threads spin for a while, which must not count for the next
    return 1000 * elapsed / num_iterations


def training(method: str, block: int) -> Iterator:
    """Of ten seeds; every ``next`` trains for ``block`` iterations."""
    problem, settings = sample_problem(SEEDS, **SIZES), published_lqr(method)
    reports = train(problem, settings, SEEDS, checkpoints=range(0, 5000, block))
    next(reports)  # the start
    return reports


def largest_difference() -> float:
    """Of our controller to those that the two yardsticks learn."""
    settings = replace(published_lqr("ipo_fixed_phi"), num_iterations=NUM_COMPARED)
    problem = sample_problem([0], **SIZES, dtype=torch.float64)
    *_, (_, gain) = train(problem, settings, [0])
    fast = gain[0]
    A, Ws, _ = straightforward.problem(0, **SIZES, dtype=torch.float64)
    slow = straightforward.ipo_fixed_phi(A, Ws, NUM_COMPARED, settings.learning_rate)
    stripped = stripped_rounds(problem, NUM_COMPARED, settings.learning_rate)
    next(stripped)
    return max(
        float((fast - other).abs().max() / other.abs().max()) for other in (slow, next(stripped)[0])
    )


def compare(block: int, num_blocks: int) -> dict[str, list[float]]:
    """For every block: milliseconds of an iteration of ten seeds, and the ratios."""
    A, Ws, _ = straightforward.problem(0, **SIZES)
    reports = training("ipo_fixed_phi", block)
    threads = {"one thread": 1, f"default threads ({DEFAULT_THREADS})": DEFAULT_THREADS}
    columns = {"ipo, one thread [ms]": []}
    columns |= {f"straightforward, {name} [ms]": [] for name in threads}
    columns |= {f"ratio, {name}": [] for name in threads}
    for _ in tqdm(range(num_blocks), desc="comparing", unit="block"):
        fast = cpu_ms(lambda: next(reports), block)
        columns["ipo, one thread [ms]"].append(fast)
        for name, number in threads.items():
            slow = cpu_ms(lambda: straightforward.ipo_fixed_phi(A, Ws, NUM_SLOW), NUM_SLOW, number)
            columns[f"straightforward, {name} [ms]"].append(slow * len(SEEDS))
            columns[f"ratio, {name}"].append(slow * len(SEEDS) / fast)
    return columns


def stripped_rounds(problem: LQR, num_rounds: int, learning_rate: float) -> Iterator[Tensor]:
    """IPO with fixed Phi for ``B = Q = R = I``: its gains ``[R, n_u, n_o]``, every few rounds."""
    A, share = problem.A, 1 / problem.num_domains
    observations = [W.contiguous() for W in problem.W_train.unbind(1)]
    identity = torch.eye(A.shape[-1], dtype=A.dtype).expand_as(A).contiguous()
    negligible = torch.finfo(A.dtype).eps ** 0.5
    gains = torch.zeros(problem.num_runs, *problem.gain_shape, dtype=A.dtype)
    players = [torch.zeros_like(gains) for _ in observations]
    optimizers = [
        torch.optim.AdamW([player], learning_rate, weight_decay=0, fused=True) for player in players
    ]
    gradient = torch.empty_like(gains)
    for player in players:
        player.grad = gradient  # one buffer for all, which stays in the cache
    while True:
        yield gains
        for _ in range(num_rounds):
            for W, player, optimizer in zip(observations, players, optimizers, strict=True):
                F = torch.bmm(gains, W)
                M = A - F
                X = torch.cat([torch.baddbmm(identity, F.mT, F), identity])
                Y = torch.cat([M, M.mT])
                while float(torch.linalg.vector_norm(Y)) > negligible:
                    X = torch.baddbmm(X, torch.bmm(Y.mT, X), Y)
                    Y = torch.bmm(Y, Y)
                P, S = X.chunk(2)
                slope = torch.bmm(torch.baddbmm(F, P, M, alpha=-1), S).mul_(2 * share)
                torch.bmm(slope, W.mT, out=gradient)
                gains.sub_(player, alpha=share)
                optimizer.step()
                gains.add_(player, alpha=share)


def compare_stripped(block: int, num_blocks: int) -> dict[str, list[float]]:
    """Milliseconds of a round of ten seeds, one thread, beside the stripped prototype's."""
    learning_rate = published_lqr("ipo_fixed_phi").learning_rate
    stripped = stripped_rounds(sample_problem(SEEDS, **SIZES), block, learning_rate)
    next(stripped)
    reports = training("ipo_fixed_phi", block)
    columns = {"stripped prototype [ms]": [], "ratio, ipo to stripped": []}
    for _ in tqdm(range(num_blocks), desc="stripped", unit="block"):
        ours = cpu_ms(lambda: next(reports), block)
        least = cpu_ms(lambda: next(stripped), block)
        columns["stripped prototype [ms]"].append(least)
        columns["ratio, ipo to stripped"].append(ours / least)
    return columns


def methods(block: int, num_blocks: int) -> dict[str, list[float]]:
    """Milliseconds of an iteration of ten seeds, one thread, by method."""
    columns = {}
    for method in tqdm(LQR_METHODS, desc="methods", unit="method"):
        reports = training(method, block)
        times = [cpu_ms(lambda reports=reports: next(reports), block) for _ in range(num_blocks)]
        columns[f"{method} [ms]"] = times
    return columns


def adam_alone(block: int, num_blocks: int) -> dict[str, list[float]]:
    """Milliseconds of all players' Adam steps without a cost or a gradient: the lower bound."""
    problem = sample_problem(SEEDS, **SIZES)
    starts = torch.zeros(len(SEEDS), problem.num_domains, *problem.gain_shape)
    game = LinearPlayers(starts, lambda player: make_optimizer("adam", player, 5e-4))
    for player in game.players:
        player.grad = torch.ones_like(player)

    def update() -> None:
        for _ in range(block):
            for optimizer in game.optimizers:
                optimizer.step()

    return {"Adam alone, ipo_fixed_phi [ms]": [cpu_ms(update, block) for _ in range(num_blocks)]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--iterations", type=int, default=200, help="of ten seeds in all blocks")
    parser.add_argument("--blocks", type=int, default=10)
    parser.add_argument("--json", type=Path, metavar="PATH", help="write the numbers there, too")
    options = parser.parse_args()
    if not 0 < options.blocks <= options.iterations <= 5000:
        parser.error("must be: 0 < --blocks <= --iterations <= 5000")

    torch.set_num_threads(1)
    difference = largest_difference()
    if not difference < TOLERANCE:
        sys.exit(f"The controllers differ by {difference:.1e} of the largest entry")
    sizes = options.iterations // options.blocks, options.blocks
    columns = compare(*sizes) | compare_stripped(*sizes) | methods(*sizes) | adam_alone(*sizes)
    rows = {
        name: {"median": statistics.median(values), "min": min(values), "max": max(values)}
        for name, values in columns.items()
    }
    print(f"Same controllers: they differ by {difference:.1e} of the largest entry\n")
    print(f"{'CPU time, ten seeds, n_d = 5, n_y = 1000':46}{'median':>10}{'min':>10}{'max':>10}")
    for name, row in rows.items():
        print(f"{name:46}" + "".join(f"{value:10.1f}" for value in row.values()))
    if options.json:
        numbers = {"relative_difference": difference, "rows": rows}
        write_record(options.json, numbers)


if __name__ == "__main__":
    main()
