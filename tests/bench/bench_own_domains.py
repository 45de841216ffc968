"""Speed and returns in environments of gymnasium, beside stable-baselines3's PPO.

    python tests/bench/bench_own_domains.py [--frames 61440] [--seeds 3] [--json PATH]

Stable-baselines3 is no dependency of the project: `pip install stable-baselines3`. One thread
each, as many frames and the same settings (copies, steps, epochs, minibatch, rates, scaled
rewards), so both do the same amount of work. They take turns, so that a busy machine slows both.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import io
import statistics
import time
from pathlib import Path

import gymnasium
import stable_baselines3
from stable_baselines3.common.evaluation import evaluate_policy as evaluate_theirs
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from tqdm import tqdm

from experiments.sealed import write_record
from ipo.own_domains import default_settings, evaluate_policy, train_policy
from ipo.own_domains.copies import Make
from ipo.own_domains.threads import one_thread

ENVIRONMENTS = ("CartPole-v1", "Acrobot-v1", "Pendulum-v1")
NUM_EPISODES = 20
SETTINGS = default_settings("ppo", 1)
FRAMES = SETTINGS.num_envs * SETTINGS.num_steps  # of an update

Result = tuple[float, float]  # frames per CPU second, return


def ours(make: Make, seed: int, num_updates: int) -> Result:
    before = time.process_time()
    policy = train_policy({"one": make}, "ppo", [seed], num_updates=num_updates)
    elapsed = time.process_time() - before
    rows = evaluate_policy(policy, {"one": make}, NUM_EPISODES)
    return num_updates * FRAMES / elapsed, float(rows["value"].mean())


def theirs(make: Make, seed: int, num_updates: int) -> Result:
    s = SETTINGS
    copies = DummyVecEnv([make] * s.num_envs)
    copies = VecNormalize(copies, norm_obs=False, clip_reward=s.reward_clip, gamma=s.discount)
    model = stable_baselines3.PPO(
        "MlpPolicy",
        copies,
        learning_rate=s.learning_rate,
        n_steps=s.num_steps,
        batch_size=s.minibatch_size,
        n_epochs=s.num_epochs,
        gamma=s.discount,
        gae_lambda=s.gae_lambda,
        clip_range=s.clip,
        clip_range_vf=s.clip,
        ent_coef=s.entropy_weight,
        vf_coef=s.value_weight,
        max_grad_norm=s.max_gradient_norm,
        seed=seed,
    )
    before = time.process_time()
    model.learn(num_updates * FRAMES)
    elapsed = time.process_time() - before
    value, _ = evaluate_theirs(model, Monitor(make()), NUM_EPISODES, deterministic=False)
    return model.num_timesteps / elapsed, float(value)


ARMS = {"ipo": ours, "stable-baselines3": theirs}


def compare(num_updates: int, seeds: list[int]) -> list[dict[str, float | str]]:
    """Means over seeds, by environment and arm."""
    rows = []
    for name in tqdm(ENVIRONMENTS, desc="comparing", unit="environment"):
        make = functools.partial(gymnasium.make, name, disable_env_checker=True)
        with one_thread(), contextlib.redirect_stderr(io.StringIO()):  # bars of single trainings
            for train in ARMS.values():  # what a first training imports is not measured
                train(make, 0, 1)
            results = [
                [train(make, seed, num_updates) for train in ARMS.values()] for seed in seeds
            ]
        for arm, of_arm in zip(ARMS, zip(*results, strict=True), strict=True):
            speed, value = map(statistics.mean, zip(*of_arm, strict=True))
            row = {"environment": name, "arm": arm}
            rows.append(row | {"frames_per_cpu_second": speed, "return": value})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=16 * FRAMES, help="of each training")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--json", type=Path, metavar="PATH", help="write the numbers there, too")
    options = parser.parse_args()
    num_updates, seeds = options.frames // FRAMES, list(range(options.seeds))
    if not num_updates or not seeds:
        parser.error(f"must be: --frames >= {FRAMES}, --seeds >= 1")
    rows = compare(num_updates, seeds)
    print(f"{num_updates * FRAMES:,} frames, {len(seeds)} seeds: frames per CPU second, return")
    for row in rows:
        print(
            "  {environment:16}{arm:46}{frames_per_cpu_second:10,.0f}{return:10,.0f}".format(**row)
        )
    if options.json:
        numbers = {"frames": num_updates * FRAMES, "num_seeds": len(seeds), "rows": rows}
        write_record(options.json, numbers)


if __name__ == "__main__":
    main()
