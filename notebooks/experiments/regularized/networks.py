"""PPO with regularisers, and with penalties on what differs between domains.

Both penalties come down to a factor for each frame of a rollout, the same for all frames of a
domain. It is measured once for a rollout, before the policy learns from it, as advantages are.

Axes: R runs, F frames, domain after domain: so many of each as ``sizes`` says.

Sources: Krueger et al. (2021) for V-REx and Arjovsky et al. (2019) for IRMv1, both of supervised
learning, where a domain's risk stands for minus its return.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated

import numpy as np
import torch
from torch import Tensor

from ipo.checks import NonNegative, check_number, checked
from ipo.distributions import Categorical, Distribution, Generators
from ipo.networks import Network, Outputs, PullBack, Weights
from ipo.ppo import MakeEnvironments, PPOSettings, Training, gains
from ipo.rollouts import Rollout

# Frames, and the factor of each in the penalty on the scale of scores.
Penalized = namedtuple("Penalized", (*Rollout._fields, "factors"))


@checked
@dataclass(frozen=True)
class RegularizedSettings(PPOSettings):
    """How a policy is trained with regularisers; none has an effect where it is 0.

    Attributes:
        weight_decay: decoupled (AdamW), per unit of learning rate, of all weights.
        dropout: probability with which an input of a layer above the network's Phi is left out of
            a gradient step; those that stay are scaled up. Rollouts are collected with all.
        variance_penalty: of :func:`variance_factors`, after V-REx.
        scale_penalty: of :func:`scale_factors`, after IRMv1.
    """

    weight_decay: NonNegative = 0.0
    dropout: Annotated[float, partial(check_number, least=0, below=1)] = 0.0
    variance_penalty: NonNegative = 0.0
    scale_penalty: NonNegative = 0.0


def training_of(
    network: Network,
    make_environments: MakeEnvironments,
    num_domains: int,
    settings: PPOSettings,
    seeds: Sequence[int],
) -> Training:
    """Of settings with regularisers or without."""
    kind = RegularizedTraining if isinstance(settings, RegularizedSettings) else Training
    return kind(network, make_environments, num_domains, settings, seeds)


class RegularizedTraining(Training):
    """The same, where gradients are those of a thinned network and a penalised return.

    Raises:
        ValueError: besides, a network or players without what a regulariser needs.
    """

    def __init__(
        self,
        network: Network,
        make_environments: MakeEnvironments,
        num_domains: int,
        settings: RegularizedSettings,
        seeds: Sequence[int],
    ) -> None:
        _check_needs(network, num_domains, settings)
        self.dropouts = [
            np.random.default_rng(np.random.SeedSequence(s).spawn(4)[3]) for s in seeds
        ]
        if settings.dropout:
            network = Thinned(network, settings.dropout, self.dropouts)
        super().__init__(network, make_environments, num_domains, settings, seeds)
        self.sizes = [
            [settings.num_steps * number for number in own] for own in settings.copies(num_domains)
        ]
        for optimizer in self.learners.optimizers:
            (group,) = optimizer.param_groups
            group |= {"weight_decay": settings.weight_decay, "decoupled_weight_decay": True}

    def _frames(self, move: int, rollout: Rollout) -> Rollout:
        settings, sizes, frames = self.settings, self.sizes[move], super()._frames(move, rollout)
        if settings.variance_penalty:
            factors = variance_factors(frames.returns, sizes, settings.variance_penalty)
            frames = frames._replace(advantages=factors * frames.advantages)
        if settings.scale_penalty:
            parameters, _ = self.learners.acting()(frames.observations)
            slopes = frames.log_probabilities + self.network.distribution.entropy(parameters)
            factors = scale_factors(slopes, frames.advantages, sizes, settings.scale_penalty)
            frames = Penalized(*frames, factors)
        return frames

    def _slopes(self, parameters: Tensor, values: Tensor, batch: Rollout) -> tuple[Tensor, Tensor]:
        of_parameters, of_values = super()._slopes(parameters, values, batch)
        if self.settings.scale_penalty:
            of_parameters += scale_gradient(
                self.network.distribution, parameters, batch, self.settings
            )
        return of_parameters, of_values

    def _generators(self) -> list[np.random.Generator]:
        return [*super()._generators(), *self.dropouts]


def _check_needs(network: Network, num_domains: int, settings: RegularizedSettings) -> None:
    if settings.dropout and not network.phi:
        raise ValueError(f"dropout = {settings.dropout}: needs a network that has a phi")
    owned = [move.domains for move in settings.moves(num_domains)]
    if settings.variance_penalty and any(len(domains) < 2 for domains in owned):
        raise ValueError(
            f"variance_penalty = {settings.variance_penalty}: needs players of several domains"
        )
    if settings.scale_penalty and network.distribution is not Categorical:
        raise ValueError(
            f"scale_penalty = {settings.scale_penalty}: needs actions to choose from, whose scores "
            "can be scaled"
        )


# ------------------------------------------------------------------------------ penalties


def variance_factors(returns: Tensor, sizes: Sequence[int], penalty: float) -> Tensor:
    """How much a frame's advantage counts, ``[R, F]``, where the returns of domains shall be alike.

        J = mean_d R_d - penalty * var_d R_d,
        dJ = mean_d [ 1 - 2 penalty (R_d - mean R) ] dR_d

    R_d is the mean of what the frames' values should have been: ``returns [R, F]``.
    """
    means = _means_of_domains(returns, sizes)
    return _for_frames(1 - 2 * penalty * (means - means.mean(1, keepdim=True)), sizes)


def scale_factors(
    slopes: Tensor, advantages: Tensor, sizes: Sequence[int], penalty: float
) -> Tensor:
    """``2 penalty g_d`` of each frame's domain, ``[R, F]`` as slopes and advantages are.

    g_d is the derivative of a domain's return by a factor w on the scores of all actions, at w = 1.
    Where no common factor could make any domain better, all g_d are zero::

        penalty * mean_d g_d^2,      g_d = E_d[ A (log pi(a | o) + H(pi( . | o))) ]

    The bracket is the slope of ``log pi``, ``z_a - sum_i pi_i z_i`` for scores z.
    """
    return _for_frames(2 * penalty * _means_of_domains(advantages * slopes, sizes), sizes)


def scale_penalty(
    distribution: type[Distribution], parameters: Tensor, batch: Penalized, settings: PPOSettings
) -> Tensor:
    """What PPO's loss has besides, ``[R]``, on a minibatch with factors f of :func:`scale_factors`.

    mean f clip(rho, 1 - c, 1 + c) A (log pi(a | o) + H(pi))
    """
    _, near_gain = gains(distribution, parameters, batch, settings)
    return (batch.factors * near_gain * _slope(distribution, parameters, batch)).mean(1)


def scale_gradient(
    distribution: type[Distribution], parameters: Tensor, batch: Penalized, settings: PPOSettings
) -> Tensor:
    """Of :func:`scale_penalty` in each frame's parameters ``[R, B, P]``.

    It needs no more than the gradients of log pi and H, whose sum is that of the slope.
    """
    gain, near_gain = gains(distribution, parameters, batch, settings)
    inside = gain.masked_fill(gain != near_gain, 0.0)
    factors = batch.factors / batch.factors.shape[1]
    weights = factors * (inside * _slope(distribution, parameters, batch) + near_gain)
    of_entropy = (factors * near_gain).unsqueeze(-1)
    return distribution.gradient(parameters, batch.actions, weights, of_entropy)


def _slope(distribution: type[Distribution], parameters: Tensor, batch: Penalized) -> Tensor:
    """Of log pi(a | o) in a factor on all scores, ``[R, B]``: log pi(a | o) + H(pi)."""
    return distribution.log_probability(parameters, batch.actions) + distribution.entropy(
        parameters
    )


def _means_of_domains(x: Tensor, sizes: Sequence[int]) -> Tensor:
    """``[R, F] -> [R, E]``."""
    return torch.stack([part.mean(1) for part in x.split(list(sizes), 1)], 1)


def _for_frames(x: Tensor, sizes: Sequence[int]) -> Tensor:
    """``[R, E] -> [R, F]``."""
    return x.repeat_interleave(torch.tensor(sizes, device=x.device), 1)


# -------------------------------------------------------------------------------- dropout


class Thinned(Network):
    """A network that acts with all inputs of its layers, and learns without some of them."""

    def __init__(self, network: Network, probability: float, generators: Generators) -> None:
        self.network, self.probability, self.generators = network, probability, generators
        self.distribution, self.phi, self.shapes = network.distribution, network.phi, network.shapes
        self.start, self.frozen = network.start, network.frozen

    def _draw(self, generator: np.random.Generator) -> dict[str, np.ndarray]:
        return self.network._draw(generator)

    def __call__(self, weights: Weights, observations: Tensor) -> Outputs:
        return self.network(weights, observations)

    def vjp(self, weights: Weights, observations: Tensor) -> tuple[Outputs, PullBack]:
        factors = dropout_factors(self.network, weights, self.probability, self.generators)
        return vjp_with_dropout(self.network, weights, observations, factors)


def dropout_factors(
    network: Network, weights: Weights, probability: float, generators: Generators
) -> Weights:
    """Of dropout above Phi: ``{name: [R, inputs, 1]}`` for the matrix of each layer.

    An input is left out, 0, with the probability, or scaled by 1 / (1 - probability). What is left
    out is left out for all frames of a minibatch, and drawn run by run.
    """
    factors = {}
    for layer, (num_inputs, _) in network.shapes.items():
        if layer not in network.phi:
            uniform = np.stack([generator.random(num_inputs) for generator in generators])
            kept = torch.from_numpy((uniform >= probability) / (1 - probability))
            name = f"{layer}.weight"
            factors[name] = kept.to(weights[name]).unsqueeze(-1)
    return factors


def vjp_with_dropout(
    network: Network, weights: Weights, observations: Tensor, factors: Weights
) -> tuple[Outputs, PullBack]:
    """:meth:`Network.vjp` where some matrices are multiplied by factors."""

    def multiplied(name: str, x: Tensor) -> Tensor:
        return x * factors[name] if name in factors else x

    thinned = {name: multiplied(name, w) for name, w in weights.items()}
    outputs, pull_back = network.vjp(thinned, observations)

    def pull_back_to_all(of_parameters: Tensor, of_values: Tensor) -> list[Tensor]:
        slopes = pull_back(of_parameters, of_values)
        return [multiplied(name, x) for name, x in zip(weights, slopes, strict=True)]

    return outputs, pull_back_to_all
