"""Speed and returns in environments of gymnasium, beside stable-baselines3's PPO.

    python tests/bench/bench_own_domains.py [--seeds 3] [--json PATH]

Stable-baselines3 is no dependency of the project: `pip install stable-baselines3`. One thread
each, as many frames and the same settings (copies, steps, epochs, minibatch, rates, scaled
rewards), so both do the same amount of work. They take turns, so that a busy machine slows both.
Where that matters, there are arms with other settings, too: values clipped as published, and what
stable-baselines3 does by default.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import gymnasium
import stable_baselines3
from gymnasium.wrappers import FlattenObservation
from minigrid.wrappers import ImgObsWrapper
from stable_baselines3.common.evaluation import evaluate_policy as evaluate_theirs
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from experiments.sealed import write_record
from ipo.own_domains import default_settings, evaluate_policy, train_policy
from ipo.own_domains.copies import Make

NUM_EPISODES = 20
SETTINGS = default_settings("ppo", 1)
FRAMES = SETTINGS.num_envs * SETTINGS.num_steps  # of an update
# What stable-baselines3 does by itself with a rollout, which is five times as many steps.
STEPS = {"num_epochs": 10, "minibatch_size": 64, "learning_rate": 3e-4}

Result = tuple[float, float]  # frames per CPU second, return
Train = Callable[[Make, int, int], Result]


def ours(make: Make, seed: int, num_updates: int, **changes: float) -> Result:
    before = time.process_time()
    policy = train_policy({"one": make}, "ppo", [seed], num_updates=num_updates, **changes)
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
        clip_range_vf=s.clip if s.clip_values else None,
        ent_coef=s.entropy_weight,
        vf_coef=s.value_weight,
        max_grad_norm=s.max_gradient_norm,
        seed=seed,
    )
    return trained(model, make, num_updates)


def theirs_by_default(make: Make, seed: int, num_updates: int) -> Result:
    return trained(stable_baselines3.PPO("MlpPolicy", make(), seed=seed), make, num_updates)


def trained(model: stable_baselines3.PPO, make: Make, num_updates: int) -> Result:
    before = time.process_time()
    model.learn(num_updates * FRAMES)
    elapsed = time.process_time() - before
    value, _ = evaluate_theirs(model, Monitor(make()), NUM_EPISODES, deterministic=False)
    return model.num_timesteps / elapsed, float(value)


def flattened(name: str) -> gymnasium.Env:
    return FlattenObservation(ImgObsWrapper(gymnasium.make(name, disable_env_checker=True)))


ARMS: dict[str, Train] = {"ipo": ours, "stable-baselines3": theirs}
CLIPPED: dict[str, Train] = {"ipo, values clipped": partial(ours, clip_values=True)}
BY_DEFAULT: dict[str, Train] = {
    "ipo, steps as stable-baselines3 by default": partial(ours, **STEPS),
    "stable-baselines3 by default": theirs_by_default,
}
make_plain = partial(partial, gymnasium.make, disable_env_checker=True)
# How an environment is made, updates, arms.
ENVIRONMENTS: dict[str, tuple[Make, int, dict[str, Train]]] = {
    "CartPole-v1": (make_plain("CartPole-v1"), 8, ARMS),
    "Acrobot-v1": (make_plain("Acrobot-v1"), 8, ARMS | CLIPPED),
    "Pendulum-v1": (make_plain("Pendulum-v1"), 8, ARMS),
    "MiniGrid-Empty-5x5-v0, flattened": (partial(flattened, "MiniGrid-Empty-5x5-v0"), 4, ARMS),
    "Hopper-v5": (make_plain("Hopper-v5"), 13, ARMS | CLIPPED | BY_DEFAULT),
}


def compare(name: str, seeds: list[int]) -> list[dict[str, float | str]]:
    """Means over seeds in an environment, by arm."""
    make, num_updates, arms = ENVIRONMENTS[name]
    with threadpool_limits(1), contextlib.redirect_stderr(io.StringIO()):  # bars of trainings
        for train in arms.values():  # what a first training imports is not measured
            train(make, 0, 1)
        results = [[train(make, seed, num_updates) for train in arms.values()] for seed in seeds]
    rows = []
    for arm, of_arm in zip(arms, zip(*results, strict=True), strict=True):
        speed, value = map(statistics.mean, zip(*of_arm, strict=True))
        row = {"environment": name, "frames": num_updates * FRAMES, "arm": arm}
        rows.append(row | {"frames_per_cpu_second": speed, "return": value})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--json", type=Path, metavar="PATH", help="write the numbers there, too")
    options = parser.parse_args()
    if options.seeds < 1:
        parser.error("must be: --seeds >= 1")
    rows = []
    for name in tqdm(ENVIRONMENTS, desc="comparing", unit="environment"):
        found = compare(name, list(range(options.seeds)))
        tqdm.write(f"{name}: frames, frames per CPU second, return")
        for row in found:
            line = "  {arm:46}{frames:10,}{frames_per_cpu_second:10,.0f}{return:10,.2f}"
            tqdm.write(line.format(**row))
        rows += found
    if options.json:
        write_record(options.json, {"num_seeds": options.seeds, "rows": rows})


if __name__ == "__main__":
    main()
