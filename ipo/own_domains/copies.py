"""Domains of your own: what they must have in common, and copies of them side by side.

A domain is a function without arguments that makes a gymnasium environment.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Discrete, Space
from torch import Tensor

from ipo.distributions import Generators
from ipo.rollouts import Step

__all__ = ["Copies", "Domains", "Make", "Spaces", "check_domains"]

Make = Callable[[], gymnasium.Env]
Domains = Mapping[str, Make]
Spaces = tuple[Space, Space]  # of observations, of actions

NUM_TRIED = 100  # actions, after which domains count as alike


def check_domains(
    name: str, domains: Domains, minimum: int = 1, trained: Spaces | None = None
) -> Spaces:
    """The spaces of observations and actions that all domains share, or share with ``trained``.

    Domains that answer the same to the same seed and actions are a warning.

    Raises:
        TypeError: a domain that is no function, or makes no environment.
        ValueError: too few domains, spaces that differ or that no network here is made for.
    """
    if not isinstance(domains, Mapping):
        raise TypeError(f"{name} = {domains!r}: must map names to functions that make environments")
    if len(domains) < minimum:
        raise ValueError(f"{name} = {list(domains)}: must be at least {minimum}")
    envs = {}
    for domain, make in domains.items():
        if not callable(make):
            raise TypeError(f"{name}[{domain!r}] = {make!r}: must be a function")
        envs[domain] = make()
        if not isinstance(envs[domain], gymnasium.Env):
            raise TypeError(f"{name}[{domain!r}]() = {envs[domain]!r}: must be a gymnasium.Env")
    spaces = {domain: (env.observation_space, env.action_space) for domain, env in envs.items()}
    first, shared = next(iter(spaces.items()))
    _check_shared(name, spaces, trained or shared, "the training" if trained else repr(first))
    _check_supported(name, *shared)
    _warn_of_twins(name, envs)
    for env in envs.values():
        env.close()
    return shared


class Copies:
    """Copies ``[R, N]`` of domains, one after the other: :class:`ipo.rollouts.Environments`.

    Each run has resets of its own, so that it is the same whatever runs are beside it. Actions
    are clipped to the space. What is kept is copied: an environment may use its array again.

    Args:
        names: of the domains that each copy is of, N.
        domains: by name.
        generators: of the resets of each run, R.

    Raises:
        ValueError: from ``reset`` and ``step``, an observation or reward that is not finite.
    """

    def __init__(self, names: Sequence[str], domains: Domains, generators: Generators) -> None:
        self.shape = len(generators), len(names)
        self.names = [*names] * len(generators)
        self.envs = [domains[name]() for name in self.names]
        if len({*map(id, self.envs)}) < len(self.envs):
            raise ValueError(f"domains {sorted({*names})}: must make a new one at each call")
        self.seeds = [int(s) for g in generators for s in g.integers(2**31, size=len(names))]
        observations, self.actions = self.envs[0].observation_space, self.envs[0].action_space
        self.size, self.dtype = (
            (len(self.envs), *(observations.shape or ())),
            dtype_of(observations),
        )

    def reset(self) -> Tensor:
        seen = np.empty(self.size, self.dtype)
        for i, (env, seed) in enumerate(zip(self.envs, self.seeds, strict=True)):
            seen[i] = env.reset(seed=seed)[0]
        return self._by_run(self._finite("observation", seen))

    def step(self, actions: Tensor) -> Step:
        last, rewards = np.empty(self.size, self.dtype), np.empty(len(self.envs), np.float32)
        terminated, truncated = np.empty((2, len(self.envs)), bool)
        chosen = clipped(actions.flatten(0, 1).numpy(), self.actions)
        for i, (env, action) in enumerate(zip(self.envs, chosen, strict=True)):
            last[i], rewards[i], terminated[i], truncated[i], _ = env.step(action)
        self._finite("reward", rewards)
        seen = self._finite("observation", last)
        ended = np.flatnonzero(terminated | truncated)
        if len(ended):
            seen = last.copy()
            for i in ended.tolist():
                seen[i] = self.envs[i].reset()[0]
            self._finite("observation", seen)
        return Step(*map(self._by_run, (seen, rewards, terminated, truncated, last)))

    def close(self) -> None:
        for env in self.envs:
            env.close()

    def _finite(self, what: str, values: np.ndarray) -> np.ndarray:
        if not np.isfinite(values).all():
            copy, *place = np.argwhere(~np.isfinite(values))[0].tolist()
            value = values[(copy, *place)]
            raise ValueError(
                f"domain {self.names[copy]!r}: {what}{place or ''} = {value}, must be finite"
            )
        return values

    def _by_run(self, values: np.ndarray) -> Tensor:
        return torch.from_numpy(values).unflatten(0, self.shape)


def is_image(observations: Space) -> bool:
    """Whether it is of pictures, or stacks of them."""
    return isinstance(observations, Box) and len(observations.shape) == 3


def dtype_of(observations: Space) -> type[np.generic]:
    """In which they are kept: images of bytes as they are, for a quarter of the memory."""
    keeps = is_image(observations) and observations.dtype == np.uint8
    return np.uint8 if keeps else np.float32


def clipped(actions: np.ndarray, space: Space) -> np.ndarray:
    """Actions ``[..., A]`` of a Gaussian, within the space; choices are what they were."""
    return np.clip(actions, space.low, space.high) if isinstance(space, Box) else actions


def _check_shared(name: str, spaces: Mapping[str, Spaces], shared: Spaces, whose: str) -> None:
    for domain, (seen, done) in spaces.items():
        if done != shared[1]:
            raise ValueError(
                f"{name}[{domain!r}]: has action space {done}, must have that of {whose}, "
                f"{shared[1]}"
            )
        if _kind(seen) != _kind(shared[0]):
            raise ValueError(
                f"{name}[{domain!r}]: has observation space {seen}, must have the kind and shape "
                f"of that of {whose}, {shared[0]}"
            )


def _kind(observations: Space) -> tuple:
    return type(observations), observations.shape, observations.dtype == np.uint8


def _check_supported(name: str, observations: Space, actions: Space) -> None:
    if not is_image(observations) and not _is_vector(observations):
        raise ValueError(
            f"{name}: have observation space {observations}, must be vectors or images (Box); "
            "gymnasium.wrappers.FlattenObservation makes vectors"
        )
    is_choice = isinstance(actions, Discrete) and actions.start == 0
    if not is_choice and not _is_vector(actions):
        raise ValueError(
            f"{name}: have action space {actions}, must be Discrete from 0, or vectors (Box)"
        )


def _is_vector(space: Space) -> bool:
    return isinstance(space, Box) and len(space.shape) == 1


def _warn_of_twins(name: str, envs: Mapping[str, gymnasium.Env]) -> None:
    """Domains whose parameter was set on a wrapper are the same environment twice."""
    actions = next(iter(envs.values())).action_space
    actions.seed(0)
    answers = {domain: np.array(env.reset(seed=0)[0]).tobytes() for domain, env in envs.items()}
    for _ in range(NUM_TRIED):
        if not _twins(answers):  # most domains differ at once
            return
        action = actions.sample()
        for domain, env in envs.items():
            observation, *others, _ = env.step(action)
            answers[domain] += np.array(observation).tobytes() + np.array(others).tobytes()
            if any(others[1:]):  # terminated, truncated
                env.reset()
    warnings.warn(
        f"{name}: {_twins(answers)} answered alike to {NUM_TRIED} actions; "
        "was a parameter set on a wrapper, and not on env.unwrapped?",
        stacklevel=5,
    )


def _twins(answers: Mapping[str, bytes]) -> list[list[str]]:
    """Domains with the same answers."""
    groups: dict[bytes, list[str]] = {}
    for domain, answer in answers.items():
        groups.setdefault(answer, []).append(domain)
    return [group for group in groups.values() if len(group) > 1]
