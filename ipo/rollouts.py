"""Rollouts: frames from copies of environments, with the advantages that learning needs.

Axes: R runs, N copies of the environments, T steps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from torch import Tensor

from ipo.distributions import Distribution
from ipo.networks import Outputs

TIME_OUTS = ("bootstrap", "terminal", "no_advantage")


class Step(NamedTuple):
    """What ``[R, N]`` copies answer to an action; those that are over begin anew at once.

    ``last_observation`` is what was seen at the end of the step, before any new beginning.
    """

    observation: Tensor
    reward: Tensor
    terminated: Tensor
    truncated: Tensor
    last_observation: Tensor


class Environments(Protocol):
    """``[R, N]`` copies of environments.

    To go on after an interruption they also need ``state()``, a tree of tensors and plain values,
    and ``restore(state)``.
    """

    def reset(self) -> Tensor: ...

    def step(self, actions: Tensor) -> Step: ...


class FromGymnasium:
    """``R x N`` copies in one ``gymnasium.vector.VectorEnv``, which begin anew in the same step.

    Args:
        envs: made with ``autoreset_mode=AutoresetMode.SAME_STEP``; observations are arrays.
        num_runs: R; copies r N to (r + 1) N belong to run r.
        seed: of the first reset; each copy has a random stream of its own.
    """

    def __init__(self, envs: VectorEnv, num_runs: int, seed: int) -> None:
        mode = envs.metadata["autoreset_mode"]
        if mode != AutoresetMode.SAME_STEP:
            raise ValueError(f"envs: have autoreset_mode = {mode}, must have SAME_STEP")
        if envs.num_envs % num_runs:
            raise ValueError(f"envs: {envs.num_envs} copies, must be a multiple of {num_runs} runs")
        self.envs, self.num_runs = envs, num_runs
        # Gymnasium's own seeds s, s + 1, ... would give neighbouring runs the same streams.
        streams = np.random.SeedSequence(seed).spawn(envs.num_envs)
        self.seeds = [int(stream.generate_state(1)[0]) for stream in streams]

    def reset(self) -> Tensor:
        return self._by_run(self.envs.reset(seed=self.seeds)[0])

    def step(self, actions: Tensor) -> Step:
        answer = self.envs.step(actions.flatten(0, 1).numpy())
        observation, reward, terminated, truncated, info = answer
        last = observation.copy()
        for copy in np.flatnonzero(terminated | truncated):
            last[copy] = info["final_obs"][copy]
        return Step(
            self._by_run(observation),
            self._by_run(reward),
            self._by_run(terminated).bool(),
            self._by_run(truncated).bool(),
            self._by_run(last),
        )

    def state(self) -> dict[str, Any]:
        """Of environments that have one."""
        return self.envs.state()

    def restore(self, state: dict[str, Any]) -> None:
        self.envs.restore(state)

    def _by_run(self, values: np.ndarray) -> Tensor:
        return torch.tensor(values, dtype=torch.float32).unflatten(0, (self.num_runs, -1))


class RewardNormalizer:
    """Divides rewards by a running standard deviation of the discounted return, run by run.

        G_t = r_t + gamma G_(t-1)  within an episode,    r_t' = clip(r_t / sd(G_0 ... G_t), -c, c)

    The deviation is that of all copies and steps so far. As in the published runs, G looks back
    and not ahead: it is only a measure of scale.

    Args:
        num_runs, num_copies: R and N.
        discount: gamma.
        clip: c.
    """

    def __init__(self, num_runs: int, num_copies: int, discount: float, clip: float) -> None:
        self.discount, self.clip = discount, clip
        self.discounted = torch.zeros(num_runs, num_copies, dtype=torch.float64)
        self.moments = torch.zeros(3, num_runs, dtype=torch.float64)  # sums of 1, G and G^2

    def __call__(self, rewards: Tensor, ended: Tensor) -> Tensor:
        """``rewards [R, N, T]`` of the next T steps, and where episodes end -> scaled rewards."""
        goes_on = (~ended).double().unbind(-1)
        discounted = []
        for reward, on in zip(rewards.double().unbind(-1), goes_on, strict=True):
            discounted.append(self.discount * self.discounted + reward)
            self.discounted = on * discounted[-1]
        G = torch.stack(discounted, -1)  # [R, N, T]
        sums = torch.stack([torch.ones_like(G), G, G.square()]).sum(2).cumsum(-1)
        count, mean, square = sums + self.moments.unsqueeze(-1)  # each [R, T]
        self.moments = torch.stack([count, mean, square])[..., -1]
        variance = (square / count - (mean / count).square()).clamp(min=0)
        scaled = rewards / (variance + 1e-8).sqrt().unsqueeze(1).to(rewards)
        return scaled.clamp(-self.clip, self.clip)


class Rollout(NamedTuple):
    """Frames ``[R, N, T]`` of one player's environments, with what learning needs to know."""

    observations: Tensor
    actions: Tensor
    log_probabilities: Tensor
    values: Tensor
    advantages: Tensor
    returns: Tensor  # what the values should have been: values + advantages

    def frames(self) -> Rollout:
        """The same as ``[R, F]``."""
        return Rollout(*(x.flatten(1, 2) for x in self))


def collect(
    policy: Callable[[Tensor], Outputs],
    distribution: type[Distribution],
    environments: Environments,
    observation: Tensor,
    num_steps: int,
    generators: Sequence[np.random.Generator],
    normalizer: RewardNormalizer | None,
    discount: float,
    gae_lambda: float,
    time_outs: str,
) -> tuple[Rollout, Tensor]:
    """T steps of a policy in all copies; returns the rollout and the observation after it.

    The settings are those of :class:`ipo.ppo.Settings`.
    """
    steps = []
    for _ in range(num_steps):
        parameters, values = policy(observation)
        actions = distribution.sample(parameters, generators)
        step = environments.step(actions)
        beyond = torch.zeros_like(values)
        if time_outs == "bootstrap" and bool(step.truncated.any()):
            # The task goes on after a time-out: what it is worth from there is part of the return.
            beyond = discount * step.truncated * policy(step.last_observation)[1]
        steps.append(
            (
                observation,
                parameters,
                actions,
                values,
                step.reward,
                beyond,
                step.terminated,
                step.truncated,
            )
        )
        observation = step.observation
    observations, parameters, actions, values, rewards, beyond, terminated, truncated = (
        torch.stack(x, dim=2) for x in zip(*steps, strict=True)
    )
    ended = terminated | truncated
    if normalizer is not None:
        rewards = normalizer(rewards, ended)
    gains = advantages(
        rewards + beyond,
        values,
        torch.cat([values[..., 1:], policy(observation)[1].unsqueeze(-1)], dim=-1),
        ended,
        discount,
        gae_lambda,
        without=truncated if time_outs == "no_advantage" else None,
    )
    log_probabilities = distribution.log_probability(parameters, actions)
    rollout = Rollout(observations, actions, log_probabilities, values, gains, values + gains)
    return rollout, observation


def advantages(
    rewards: Tensor,
    values: Tensor,
    next_values: Tensor,
    ended: Tensor,
    discount: float,
    gae_lambda: float,
    without: Tensor | None = None,
) -> Tensor:
    """Generalised advantage estimates; all tensors are ``[..., T]``.

        delta_t = r_t + gamma V(o_(t+1)) - V(o_t)
        A_t     = delta_t + gamma lambda A_(t+1),      both without their future where t is the end

    Steps marked in ``without`` get A_t = 0: what they were worth is not known.

    Source: Schulman et al. (2016).
    """
    goes_on = (~ended).to(values)
    deltas = rewards + discount * goes_on * next_values - values
    factors = discount * gae_lambda * goes_on
    if without is not None:
        deltas = deltas.masked_fill(without, 0.0)  # these steps end an episode: no future either
    estimates = torch.empty_like(deltas)
    estimate = torch.zeros_like(deltas[..., 0])
    for t in reversed(range(deltas.shape[-1])):
        estimate = deltas[..., t] + factors[..., t] * estimate
        estimates[..., t] = estimate
    return estimates
