"""Train and compare policies in domains of your own: any gymnasium environments with vectors.

A domain is a function without arguments that makes an environment. All domains of a task share
their spaces of observations and actions. The page "Your own domains" shows how it is used::

    policy = train_policy({"a": make_a, "b": make_b}, method="ipo")
    rows = evaluate_policy(policy, {"new": make_c})
    rows = compare({"a": make_a, "b": make_b}, {"new": make_c}, controls=True)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gymnasium
import numpy as np
import pandas as pd
import torch
from gymnasium.spaces import Box, Discrete, Space, flatdim
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import ClipAction
from torch import Tensor
from tqdm.auto import tqdm

from ipo.checks import check_count, check_counts
from ipo.distributions import Categorical, Gaussian, Generators
from ipo.networks import DenseNetwork, Network, Weights, copied
from ipo.ppo import PPOSettings, Training
from ipo.rollouts import FromGymnasium

Make = Callable[[], gymnasium.Env]
Domains = Mapping[str, Make]

PPO_RATE, IPO_RATE = 1e-3, 5e-4  # of the paper


@dataclass(frozen=True)
class Policy:
    """Trained policies, one for each seed.

    Attributes:
        label: the method's name in rows.
        network: of every player.
        players: the weights ``{name: [R, ...]}`` of every player; their average acts.
        seeds: of the runs.
    """

    label: str
    network: Network
    players: list[Weights]
    seeds: tuple[int, ...]

    @torch.no_grad()
    def act(self, observation: np.ndarray, run: int = 0) -> np.ndarray:
        """The most likely action of one run for one observation, for an environment's ``step``."""
        seen = torch.as_tensor(observation, dtype=torch.float32).reshape(1, 1, -1)
        of_run = [{name: w[run : run + 1] for name, w in p.items()} for p in self.players]
        parameters, _ = self.network.frozen(of_run)(seen)
        return self.network.distribution.mode(parameters)[0, 0].numpy()


def default_settings(method: str, num_domains: int, **changes: Any) -> PPOSettings:
    """Settings that are sensible for classic control; the learning rates are the paper's.

    The copies of environments, about thirty, can be split evenly among domains and players by
    every method, so that all of them see the same number of frames.
    """
    square = num_domains**2
    sensible: dict[str, Any] = {
        "learning_rate": PPO_RATE if method == "ppo" else IPO_RATE,
        "num_envs": square * math.ceil(30 / square),
        "num_epochs": 8,
        "normalize_rewards": True,
        "normalize_advantages": "minibatch",
    }
    return PPOSettings(method, **(sensible | changes))


def train_policy(
    domains: Domains,
    method: str = "ipo",
    seeds: Sequence[int] = (0,),
    settings: PPOSettings | None = None,
    network: Network | None = None,
    label: str | None = None,
    device: str = "cpu",
    **changes: Any,
) -> Policy:
    """Train one policy for each seed by ``ppo``, ``ipo`` or ``ensemble``.

    Args:
        domains: name -> function that makes an environment; the training domains.
        method: how to train.
        seeds: the runs, which are trained side by side.
        settings: instead of :func:`default_settings` of the method.
        network: instead of a :class:`ipo.networks.DenseNetwork` that fits the spaces.
        label: the method's name in rows; the method itself if none is given.
        device: where networks learn, such as ``cuda``; the policy comes back to the CPU.
        changes: of the settings, such as ``num_updates=50``.

    Raises:
        TypeError, ValueError: a domain that is not a function, too few domains, spaces that
            differ between domains or are not supported, settings that make no sense.
    """
    needed = 1 if method == "ppo" else 2
    observations, actions = check_domains("domains", domains, minimum=needed)
    settings = settings or default_settings(method, len(domains))
    settings = replace(settings, method=method, **changes)
    check_counts("seeds", list(seeds), minimum=0)
    network = network or network_for(observations, actions)
    makers = list(domains.values())

    def environments(
        chosen: list[int], num_copies: list[int], generators: Generators
    ) -> FromGymnasium:
        return _environments([makers[d] for d in np.repeat(chosen, num_copies)], generators)

    training = Training(network, environments, len(makers), settings, list(seeds), device)
    for _ in tqdm(range(settings.num_updates), desc=label or method, unit="update"):
        training.update()
    players = [{name: w.cpu() for name, w in own.items()} for own in copied(training.players)]
    return Policy(label or method, network, players, tuple(seeds))


def evaluate_policy(
    policy: Policy, domains: Domains, num_episodes: int = 20, seed: int = 12345
) -> pd.DataFrame:
    """Mean return of whole episodes with sampled actions: tidy rows, one per run and domain.

    Every copy of a domain counts with its first episode, so that long ones count like short ones.
    """
    check_count("num_episodes", num_episodes)
    check_domains("domains", domains)
    rows = []
    for name, make in domains.items():
        generators = [np.random.default_rng([seed, run]) for run in policy.seeds]
        returns = _returns(policy, make, num_episodes, generators)
        rows += [
            {"method": policy.label, "run": run, "domain": name, "metric": "return", "value": value}
            for run, value in zip(policy.seeds, returns.mean(1).tolist(), strict=True)
        ]
    return pd.DataFrame(rows)


def compare(
    train_domains: Domains,
    test_domains: Domains,
    seeds: Sequence[int] = (0, 1),
    controls: bool = False,
    num_episodes: int = 20,
    **changes: Any,
) -> pd.DataFrame:
    """PPO and IPO side by side: rows of every method, run and domain.

    Both see the same number of frames. With ``controls`` there are three more methods, which
    separate what IPO changes at once: PPO with IPO's learning rate, IPO with PPO's, and an
    ensemble with IPO's players, average and learning rate, in which every player owns all domains.
    """
    both = {**train_domains, **test_domains}
    check_domains("train_domains", train_domains, minimum=2)
    check_domains("train_domains and test_domains", both)
    arms = {"ppo": ("ppo", PPO_RATE), "ipo": ("ipo", IPO_RATE)}
    if controls:
        arms |= {
            f"ppo_lr{IPO_RATE:g}": ("ppo", IPO_RATE),
            f"ipo_lr{PPO_RATE:g}": ("ipo", PPO_RATE),
            "ensemble": ("ensemble", IPO_RATE),
        }
    parts = []
    for label, (method, rate) in arms.items():
        rule = default_settings(method, len(train_domains), learning_rate=rate)
        policy = train_policy(train_domains, method, seeds, rule, label=label, **changes)
        parts.append(evaluate_policy(policy, both, num_episodes))
    return pd.concat(parts, ignore_index=True)


def network_for(observations: Space, actions: Space) -> DenseNetwork:
    """An actor-critic whose sizes fit the spaces."""
    if isinstance(actions, Discrete):
        return DenseNetwork(flatdim(observations), int(actions.n), Categorical)
    return DenseNetwork(flatdim(observations), flatdim(actions), Gaussian)


def check_domains(name: str, domains: Domains, minimum: int = 1) -> tuple[Space, Space]:
    """The spaces of observations and actions that all domains share.

    Raises:
        TypeError, ValueError: see :func:`train_policy`.
    """
    if not isinstance(domains, Mapping):
        raise TypeError(f"{name} = {domains!r}: must map names to functions that make environments")
    if len(domains) < minimum:
        raise ValueError(f"{name} = {list(domains)}: must be at least {minimum}")
    spaces = {}
    for domain, make in domains.items():
        if not callable(make):
            raise TypeError(f"{name}[{domain!r}] = {make!r}: must be a function")
        env = make()
        spaces[domain] = (env.observation_space, env.action_space)
        env.close()
    first, (observations, actions) = next(iter(spaces.items()))
    for domain, (seen, done) in spaces.items():
        if done != actions:
            raise ValueError(
                f"{name}[{domain!r}]: has action space {done}, "
                f"must have that of {first!r}, {actions}"
            )
        if seen.shape != observations.shape or type(seen) is not type(observations):
            raise ValueError(
                f"{name}[{domain!r}]: has observation space {seen}, "
                f"must have the kind and shape of that of {first!r}, {observations}"
            )
    if not isinstance(observations, Box) or len(observations.shape) != 1:
        raise ValueError(f"{name}: have observation space {observations}, must be vectors (Box)")
    is_choice = isinstance(actions, Discrete) and actions.start == 0
    if not is_choice and not (isinstance(actions, Box) and len(actions.shape) == 1):
        raise ValueError(
            f"{name}: have action space {actions}, must be Discrete from 0, or vectors (Box)"
        )
    return observations, actions


def _environments(makers: Sequence[Make], generators: Generators) -> FromGymnasium:
    """One copy of each maker for every run, with resets from the run's generator."""

    def wrapped(make: Make) -> gymnasium.Env:
        env = make()
        return ClipAction(env) if isinstance(env.action_space, Box) else env

    copies = [lambda make=make: wrapped(make) for _ in generators for make in makers]
    vector = SyncVectorEnv(copies, autoreset_mode=AutoresetMode.SAME_STEP)
    environments = FromGymnasium(vector, len(generators), seed=0)
    # Seeds of its own for each run, so that a run is the same whatever runs are beside it.
    environments.seeds = [int(s) for g in generators for s in g.integers(2**31, size=len(makers))]
    return environments


def _returns(policy: Policy, make: Make, num_episodes: int, generators: Generators) -> Tensor:
    """Return of the first episode of every copy, ``[R, N]``."""
    environments = _environments([make] * num_episodes, generators)
    acting = policy.network.frozen(policy.players)
    observation = environments.reset()
    returns = torch.zeros(observation.shape[:2])
    running = torch.ones_like(returns, dtype=torch.bool)
    while running.any():
        parameters, _ = acting(observation)
        step = environments.step(policy.network.distribution.sample(parameters, generators))
        returns += running * step.reward
        running &= ~(step.terminated | step.truncated)
        observation = step.observation
    return returns
