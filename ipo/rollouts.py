"""Rollouts: frames from copies of environments, with the advantages that learning needs.

Axes: R runs, N copies of the environments, T steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from ipo.checks import Count, Positive, Probability, checked, one_of
from ipo.distributions import Distribution, Generators
from ipo.networks import Acting

TIME_OUTS = ("bootstrap", "terminal", "no_advantage")
TimeOuts = Annotated[str, one_of(TIME_OUTS)]
Scales = Annotated[Sequence[Count], "scales"]


class Step(NamedTuple):
    """What ``[R, N]`` copies answer to an action; those that are over begin anew at once.

    ``last_observation`` is what was seen at the end of the step, before any new beginning.
    """

    observation: Tensor
    reward: Tensor
    terminated: Tensor
    truncated: Tensor
    last_observation: Tensor


@runtime_checkable
class Environments(Protocol):
    """``[R, N]`` copies of environments.

    To go on after an interruption they also need ``state()``, a tree of tensors and plain values,
    and ``restore(state)``.
    """

    def reset(self) -> Tensor: ...

    def step(self, actions: Tensor) -> Step: ...


class RewardNormalizer:
    """Divides rewards by a running standard deviation of the discounted return, run by run.

        G_t = r_t + gamma G_(t-1)  within an episode,    r_t' = clip(r_t / sd(G_0 ... G_t), -c, c)

    The deviation is that of all steps so far, in all copies or in some of them. As in the published
    runs, G looks back and not ahead: it is only a measure of scale.

    Args:
        num_runs: R.
        scales: how many copies share a deviation: the first ones, those that follow, and so on.
        discount: gamma.
        clip: the bound c.
    """

    @checked
    def __init__(
        self, num_runs: Count, scales: Scales, discount: Probability, clip: Positive
    ) -> None:
        self.scales, self.discount, self.clip = list(scales), discount, clip
        self.discounted = torch.zeros(num_runs, sum(scales), dtype=torch.float64)
        # Sums of 1, G and G^2, for each deviation.
        self.moments = torch.zeros(3, num_runs, len(scales), dtype=torch.float64)

    def __call__(self, rewards: Tensor, ended: Tensor) -> Tensor:
        """``rewards [R, N, T]`` of the next T steps, and where episodes end -> scaled rewards."""
        self.discounted, self.moments = (
            x.to(rewards.device) for x in (self.discounted, self.moments)
        )
        goes_on = (~ended).double().unbind(-1)
        discounted = []
        for reward, on in zip(rewards.double().unbind(-1), goes_on, strict=True):
            discounted.append(self.discount * self.discounted + reward)
            self.discounted = on * discounted[-1]
        G = torch.stack(discounted, -1)  # [R, N, T]
        copies = torch.stack([torch.ones_like(G), G, G.square()]).split(self.scales, dim=2)
        sums = torch.stack([own.sum(2) for own in copies], dim=2).cumsum(-1)
        count, mean, square = sums + self.moments.unsqueeze(-1)  # each [R, scales, T]
        self.moments = torch.stack([count, mean, square])[..., -1]
        variance = (square / count - (mean / count).square()).clamp(min=0)
        deviation = (variance + 1e-8).sqrt().to(rewards)
        of_copies = torch.arange(len(self.scales)).repeat_interleave(torch.tensor(self.scales))
        scaled = rewards / deviation.index_select(1, of_copies.to(rewards.device))
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


def check_device(name: str, device: str | torch.device) -> None:
    """Torch has several errors for a device that it cannot use."""
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError, ImportError) as error:
        raise ValueError(f"{name} = {device!r}: must be one that torch can use: {error}") from error


Device = Annotated[str | torch.device, check_device]


@checked
@dataclass
class Collector:
    """One player's copies of environments, which go on from rollout to rollout.

    Attributes:
        environments: all begin now.
        num_steps: T, of each rollout.
        discount: gamma.
        gae_lambda: lambda of the advantage estimate.
        time_outs: see :class:`ipo.ppo.PPOSettings`.
        reward_clip: bound on normalised rewards; ``None``: they are not normalised.
        scales: see :class:`RewardNormalizer`; ``None``: all copies share a deviation.
        device: of the policy and the rollouts; environments and their answers are on the CPU.

    Raises:
        ValueError: ``scales`` that are not those of all copies.
    """

    environments: Environments
    num_steps: Count
    discount: Probability
    gae_lambda: Probability
    time_outs: TimeOuts = "bootstrap"
    reward_clip: Positive | None = None
    scales: Scales | None = None
    device: Device = "cpu"

    def __post_init__(self) -> None:
        self.observation = self.environments.reset().to(self.device)
        self.normalizer = None
        if self.reward_clip is not None:
            num_runs, num_copies = self.observation.shape[:2]
            scales = self.scales or [num_copies]
            if sum(scales) != num_copies:
                raise ValueError(f"scales = {scales}: must be {num_copies} copies in all")
            self.normalizer = RewardNormalizer(num_runs, scales, self.discount, self.reward_clip)

    def collect(
        self, policy: Acting, distribution: type[Distribution], generators: Generators
    ) -> Rollout:
        """T steps of a policy in all copies; each run draws its actions from its generator."""
        steps = [self._act(policy, distribution, generators) for _ in range(self.num_steps)]
        observations, parameters, actions, values, rewards, beyond, terminated, truncated = (
            torch.stack(x, dim=2) for x in zip(*steps, strict=True)
        )
        ended = terminated | truncated
        if self.normalizer is not None:
            rewards = self.normalizer(rewards, ended)
        all_values = torch.cat([values, policy(self.observation)[1].unsqueeze(-1)], dim=-1)
        errors = value_errors(rewards + beyond, all_values, ended, self.discount)
        if self.time_outs == "no_advantage":  # what these steps were worth is not known
            errors = errors.masked_fill(truncated, 0.0)
        gains = advantages(errors, ended, self.discount * self.gae_lambda)
        log_probabilities = distribution.log_probability(parameters, actions)
        return Rollout(observations, actions, log_probabilities, values, gains, values + gains)

    def _act(
        self, policy: Acting, distribution: type[Distribution], generators: Generators
    ) -> tuple[Tensor, ...]:
        observation = self.observation
        parameters, values = policy(observation)
        actions = distribution.sample(parameters, generators)
        answer = self.environments.step(actions.cpu())
        step = Step(*(x.to(self.device) for x in answer))
        self.observation = step.observation
        beyond = torch.zeros_like(values)
        timed_out = step.truncated & ~step.terminated
        if self.time_outs == "bootstrap" and bool(timed_out.any()):
            # The task goes on after a time-out: what it is worth from there is part of the return.
            later = self.discount * policy(step.last_observation)[1]
            beyond = torch.where(timed_out, later, beyond)
        ends = step.terminated, step.truncated
        return observation, parameters, actions, values, step.reward, beyond, *ends

    def state(self) -> dict[str, Any]:
        """All that changes; the environments must have a state."""
        scale = self.normalizer and [self.normalizer.discounted, self.normalizer.moments]
        return {
            "environments": self.environments.state(),  # type: ignore[attr-defined]
            "observation": self.observation,
            "scale": scale,
        }

    def restore(self, state: dict[str, Any]) -> None:
        self.environments.restore(state["environments"])  # type: ignore[attr-defined]
        self.observation = state["observation"].to(self.device)
        if self.normalizer is not None:
            self.normalizer.discounted, self.normalizer.moments = state["scale"]


def value_errors(rewards: Tensor, values: Tensor, ended: Tensor, discount: float) -> Tensor:
    """By how much each of T steps was better than the critic said, ``[..., T]``.

        delta_t = r_t + gamma V(o_(t+1)) - V(o_t),      without V(o_(t+1)) where t is the end

    ``values [..., T + 1]`` have the one of what is seen after the last step, too.
    """
    goes_on = (~ended).to(values)
    return rewards + discount * goes_on * values[..., 1:] - values[..., :-1]


def advantages(errors: Tensor, ended: Tensor, decay: float) -> Tensor:
    """Generalised advantage estimates of :func:`value_errors`; all tensors are ``[..., T]``.

        A_t = delta_t + gamma lambda A_(t+1),      without A_(t+1) where t is the end

    ``decay`` is gamma lambda. Source: Schulman et al. (2016).
    """
    factors = decay * (~ended).to(errors)
    estimates = torch.empty_like(errors)
    estimate = torch.zeros_like(errors[..., 0])
    for t in reversed(range(errors.shape[-1])):
        estimate = errors[..., t] + factors[..., t] * estimate
        estimates[..., t] = estimate
    return estimates
