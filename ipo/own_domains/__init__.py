"""Train and compare policies in domains of your own: gymnasium environments with vectors or images.

A domain is a function without arguments that makes an environment. All domains of a task share
their spaces of observations and actions. The page "Your own domains" shows how it is used::

    policy = train_policy({"a": make_a, "b": make_b}, method="ipo")
    rows = evaluate_policy(policy, {"new": make_c})
    rows = compare({"a": make_a, "b": make_b}, {"new": make_c}, controls=True)
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import torch
from threadpoolctl import threadpool_limits
from torch import Tensor
from tqdm.auto import tqdm

from ipo.checks import Count, Seed, Seeds, checked, one_of
from ipo.distributions import Generators
from ipo.networks import Network, copied
from ipo.own_domains.copies import Copies, Domains, check_domains
from ipo.own_domains.policy import Policy, check_network, network_for
from ipo.ppo import METHODS, PPOSettings, Training
from ipo.rollouts import Device

if TYPE_CHECKING:
    import pandas as pd

__all__ = [
    "Policy",
    "check_domains",
    "compare",
    "default_settings",
    "evaluate_policy",
    "network_for",
    "train_policy",
]

PPO_RATE, IPO_RATE = 1e-3, 5e-4  # of the paper

# On matrices as small as those of policies more threads wait for each other.
one_thread = threadpool_limits.wrap(limits=1)


def default_settings(method: str, num_domains: int, **changes: Any) -> PPOSettings:
    """Settings that are sensible for classic control; the learning rates are the paper's.

    The change of the value is not bounded: on Acrobot a policy learns far better without.
    The copies of environments, about thirty, can be split evenly among domains and players by
    every method, so that all of them see the same number of frames.
    """
    square = num_domains**2
    sensible: dict[str, Any] = {
        "learning_rate": PPO_RATE if method == "ppo" else IPO_RATE,
        "adam_epsilon": 1e-5,
        "num_envs": square * math.ceil(30 / square),
        "num_epochs": 8,
        "clip_values": False,
        "normalize_rewards": True,
        "normalize_advantages": "minibatch",
    }
    return PPOSettings(method, **(sensible | changes))


@one_thread
@checked
def train_policy(
    domains: Domains,
    method: Annotated[str, one_of(METHODS)] = "ipo",
    seeds: Seeds = (0,),
    settings: PPOSettings | None = None,
    network: Network | None = None,
    label: str | None = None,
    device: Device = "cpu",
    **changes: Any,
) -> Policy:
    """Train one policy for each seed by ``ppo``, ``ipo``, ``ensemble`` or ``in_turn``.

    Args:
        domains: name -> function that makes an environment; the training domains.
        method: how to train.
        seeds: the runs, which are trained side by side.
        settings: instead of :func:`default_settings` of the method.
        network: instead of that of :func:`ipo.own_domains.policy.network_for`.
        label: the method's name in rows; the method itself if none is given.
        device: where networks learn, such as ``cuda``; the policy comes back to the CPU.
        changes: of the settings, such as ``num_updates=50``.

    Raises:
        TypeError, ValueError: a domain that is not a function, too few domains, spaces that
            differ between domains or are not supported, a network that does not fit them,
            settings that make no sense; observations or rewards that are not finite.
    """
    needed = 1 if method == "ppo" else 2
    observations, actions = check_domains("domains", domains, minimum=needed)
    settings = settings or default_settings(method, len(domains))
    settings = replace(settings, method=method, **changes)
    network = network or network_for(observations, actions)
    check_network(network, observations, actions)
    names = list(domains)

    def environments(chosen: list[int], num_copies: list[int], generators: Generators) -> Copies:
        return Copies([names[d] for d in np.repeat(chosen, num_copies)], domains, generators)

    training = Training(network, environments, len(names), settings, list(seeds), device)
    for _ in tqdm(range(settings.num_updates), desc=label or method, unit="update"):
        training.update()
    players = [{name: w.cpu() for name, w in own.items()} for own in copied(training.players)]
    return Policy(label or method, tuple(seeds), observations, actions, network, players)


@one_thread
@checked
def evaluate_policy(
    policy: Policy,
    domains: Domains,
    num_episodes: Count = 20,
    seed: Seed = 12345,
    max_steps: Count = 10_000,
) -> pd.DataFrame:
    """Mean return of whole episodes with sampled actions: tidy rows, one per run and domain.

    Every copy of a domain counts with its first episode, so that long ones count like short ones.

    Raises:
        TypeError, ValueError: domains with other spaces than the policy was trained with; an
            episode of more than ``max_steps``.
    """
    import pandas as pd

    check_domains("domains", domains, trained=(policy.observations, policy.actions))
    rows = []
    total = len(domains) * len(policy.seeds) * num_episodes
    with tqdm(total=total, desc=f"{policy.label}, evaluation", unit="episode") as bar:
        for name in domains:
            generators = [np.random.default_rng([seed, run]) for run in policy.seeds]
            copies = Copies([name] * num_episodes, domains, generators)
            returns = _returns(policy, copies, generators, max_steps, bar)
            copies.close()
            same = {"method": policy.label, "domain": name, "metric": "return"}
            rows += [
                {**same, "run": run, "value": value}
                for run, value in zip(policy.seeds, returns.mean(1).tolist(), strict=True)
            ]
    return pd.DataFrame(rows, columns=["method", "run", "domain", "metric", "value"])


@checked
def compare(
    train_domains: Domains,
    test_domains: Domains,
    seeds: Seeds = (0, 1),
    controls: bool = False,
    num_episodes: Count = 20,
    max_steps: Count = 10_000,
    **changes: Any,
) -> pd.DataFrame:
    """PPO and IPO side by side: rows of every method, run and domain.

    Both see the same number of frames. With ``controls`` there are four more methods, which
    separate what IPO changes at once: PPO with IPO's learning rate, IPO with PPO's, an ensemble
    with IPO's players, average and learning rate, in which every player owns all domains, and one
    network that learns from one domain at a time, without players.
    """
    import pandas as pd

    both = {**train_domains, **test_domains}
    spaces = check_domains("train_domains", train_domains, minimum=2)
    check_domains("test_domains", test_domains, trained=spaces)
    if again := sorted(train_domains.keys() & test_domains.keys()):
        raise ValueError(f"test_domains = {again}: must have names that train_domains has not")
    arms = {"ppo": ("ppo", PPO_RATE), "ipo": ("ipo", IPO_RATE)}
    if controls:
        arms |= {
            f"ppo_lr{IPO_RATE:g}": ("ppo", IPO_RATE),
            f"ipo_lr{PPO_RATE:g}": ("ipo", PPO_RATE),
            "ensemble": ("ensemble", IPO_RATE),
            "in_turn": ("in_turn", IPO_RATE),
        }
    parts = []
    for label, (method, rate) in arms.items():
        rule = default_settings(method, len(train_domains), learning_rate=rate)
        policy = train_policy(train_domains, method, seeds, rule, label=label, **changes)
        parts.append(evaluate_policy(policy, both, num_episodes, max_steps=max_steps))
    return pd.concat(parts, ignore_index=True)


def _returns(
    policy: Policy, copies: Copies, generators: Generators, max_steps: int, bar: tqdm
) -> Tensor:
    """Return of the first episode of every copy, ``[R, N]``."""
    acting = policy.network.frozen(policy.players)
    observation = copies.reset()
    returns = torch.zeros(copies.shape)
    running = torch.ones_like(returns, dtype=torch.bool)
    for _ in range(max_steps):
        parameters, _ = acting(observation)
        step = copies.step(policy.network.distribution.sample(parameters, generators))
        returns += running * step.reward
        ended = running & (step.terminated | step.truncated)
        if ended.any():
            running &= ~ended
            bar.update(int(ended.sum()))
            if not running.any():
                return returns
        observation = step.observation
    raise ValueError(
        f"domain {copies.names[0]!r}: {int(running.sum())} of {running.numel()} episodes went on "
        f"after max_steps = {max_steps}; must end, for example by gymnasium.wrappers.TimeLimit"
    )
