"""Speed and returns in environments of gymnasium, beside stable-baselines3's PPO.

    python tests/bench/bench_own_domains.py [--frames 61440] [--seeds 3] [--json PATH]

Stable-baselines3 is no dependency of the project: `pip install stable-baselines3`. One thread
each, and as many frames. It is measured with its own defaults, and with our settings (copies,
steps, epochs, minibatch, rates, scaled rewards), where both do the same amount of work. The arms
take turns, seed by seed, so that a busy machine slows all.
"""

from __future__ import annotations

import argparse
import functools
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import gymnasium
import stable_baselines3
from stable_baselines3.common.evaluation import evaluate_policy as evaluate_theirs
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from tqdm import tqdm

from experiments.files import replace_text
from ipo.own_domains import default_settings, evaluate_policy, train_policy
from ipo.threads import one_thread

ENVIRONMENTS = ("CartPole-v1", "Acrobot-v1", "Pendulum-v1")
NUM_EPISODES = 20
SETTINGS = default_settings("ppo", 1)
FRAMES = SETTINGS.num_envs * SETTINGS.num_steps  # of an update

Result = tuple[float, float]  # frames per CPU second, return


def ours(make: Callable[[], gymnasium.Env], seeds: list[int], num_updates: int) -> Result:
    before = time.process_time()
    policy = train_policy({"one": make}, "ppo", seeds, num_updates=num_updates)
    elapsed = time.process_time() - before
    rows = evaluate_policy(policy, {"one": make}, NUM_EPISODES)
    return len(seeds) * num_updates * FRAMES / elapsed, rows["value"].mean()


def same_settings(make: Callable[[], gymnasium.Env], seed: int, num_updates: int) -> Result:
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
    return learned(model, make, num_updates)


def own_defaults(make: Callable[[], gymnasium.Env], seed: int, num_updates: int) -> Result:
    return learned(stable_baselines3.PPO("MlpPolicy", make(), seed=seed), make, num_updates)


def learned(
    model: stable_baselines3.PPO, make: Callable[[], gymnasium.Env], num_updates: int
) -> Result:
    before = time.process_time()
    model.learn(num_updates * FRAMES)
    elapsed = time.process_time() - before
    env = stable_baselines3.common.monitor.Monitor(make())
    value, _ = evaluate_theirs(model, env, NUM_EPISODES, deterministic=False)
    return model.num_timesteps / elapsed, value


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=16 * FRAMES, help="of each training")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--json", type=Path, metavar="PATH", help="write the numbers there, too")
    options = parser.parse_args()
    num_updates, seeds = options.frames // FRAMES, list(range(options.seeds))
    if not num_updates or not seeds:
        parser.error(f"must be: --frames >= {FRAMES}, --seeds >= 1")
    arms = {
        "ipo": lambda make, seed: ours(make, [seed], num_updates),
        "sb3, same settings": lambda make, seed: same_settings(make, seed, num_updates),
        "sb3, its defaults": lambda make, seed: own_defaults(make, seed, num_updates),
    }
    columns = {name: {arm: [] for arm in arms} for name in ENVIRONMENTS}
    with one_thread():
        for arm in arms.values():  # what a first training imports is not measured
            arm(lambda: gymnasium.make("CartPole-v1"), 0)
        trainings = [(name, seed) for name in ENVIRONMENTS for seed in seeds]
        for name, seed in tqdm(trainings, desc="comparing", unit="seed"):
            make = functools.partial(gymnasium.make, name, disable_env_checker=True)
            for arm, train in arms.items():
                columns[name][arm].append(train(make, seed))
    rows = {
        name: {
            arm: dict(
                zip(
                    ("frames_per_cpu_second", "return"),
                    map(statistics.mean, zip(*of_arm, strict=True)),
                    strict=True,
                )
            )
            for arm, of_arm in own.items()
        }
        for name, own in columns.items()
    }
    print(f"{options.frames} frames, means of {options.seeds} seeds: frames per CPU second, return")
    for name, own in rows.items():
        for arm, row in own.items():
            print(f"  {name:16}{arm:24}" + "".join(f"{value:10.0f}" for value in row.values()))
    if options.json:
        numbers = {"frames": num_updates * FRAMES, "seeds": len(seeds), "rows": rows}
        replace_text(options.json, json.dumps(numbers, indent=1) + "\n")


if __name__ == "__main__":
    main()
