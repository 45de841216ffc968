"""Distributions over actions, from the numbers that a network puts out for an observation.

Each is described by ``parameters [..., P]`` that the players *average* (appendix of the paper):
the scores of a categorical distribution, the means and standard deviations of a Gaussian one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

Generators = Sequence[np.random.Generator]  # one for each run

LOG_SQRT_TAU = 0.5 * math.log(2 * math.pi)


class Distribution(Protocol):
    """What training needs of a distribution over actions."""

    @staticmethod
    def sample(parameters: Tensor, generators: Generators) -> Tensor:
        """Actions for ``parameters [R, N, P]``."""

    @staticmethod
    def mode(parameters: Tensor) -> Tensor:
        """The most likely actions."""

    @staticmethod
    def log_probability(parameters: Tensor, actions: Tensor) -> Tensor:
        """log pi(a | o), ``[...]``; of a density where actions are continuous."""

    @staticmethod
    def entropy(parameters: Tensor) -> Tensor:
        """H(pi( . | o)) in nats, ``[...]``."""

    @staticmethod
    def gradient(
        parameters: Tensor, actions: Tensor, weights: Tensor, entropy_weight: float | Tensor
    ) -> Tensor:
        """Of ``weights [...] log pi(a | o) + entropy_weight H`` in the parameters.

        The weight of the entropy is a number, or ``[..., 1]``.
        """


class Categorical:
    """A of a finite set; the parameters are its logits ``[..., A]``, an action is a number."""

    @staticmethod
    def sample(parameters: Tensor, generators: Generators) -> Tensor:
        uniform = np.stack([generator.random(parameters.shape[1]) for generator in generators])
        below = parameters.softmax(-1).cumsum(-1)[..., :-1]  # rounding must not lead too far
        return (torch.tensor(uniform).to(below).unsqueeze(-1) > below).sum(-1)

    @staticmethod
    def mode(parameters: Tensor) -> Tensor:
        return parameters.argmax(-1)

    @staticmethod
    def log_probability(parameters: Tensor, actions: Tensor) -> Tensor:
        return _log_softmax(parameters).gather(-1, actions.unsqueeze(-1)).squeeze(-1)

    @staticmethod
    def entropy(parameters: Tensor) -> Tensor:
        log_probabilities = _log_softmax(parameters)
        return -(log_probabilities.exp() * log_probabilities).sum(-1)

    @staticmethod
    def gradient(
        parameters: Tensor, actions: Tensor, weights: Tensor, entropy_weight: float | Tensor
    ) -> Tensor:
        """d log pi(a) / d z_i = 1(i = a) - pi(i),   d H / d z_i = - pi(i) (log pi(i) + H)."""
        log_probabilities = _log_softmax(parameters)
        probabilities = log_probabilities.exp()
        weights = weights.unsqueeze(-1)
        entropy = -(probabilities * log_probabilities).sum(-1, keepdim=True)
        gradient = -probabilities * (weights + entropy_weight * (log_probabilities + entropy))
        return gradient.scatter_add_(-1, actions.unsqueeze(-1), weights)


class Gaussian:
    """Independent normal numbers; the parameters are A means, then A standard deviations.

        log pi(a | o) = -sum_i [ (a_i - m_i)^2 / (2 s_i^2) + log s_i + log(2 pi) / 2 ]
        H(pi( . | o)) =  sum_i [ 1 / 2 + log s_i + log(2 pi) / 2 ]

    Actions are not clipped: a motor or an environment may do that, and the probability is that of
    the action before.
    """

    @staticmethod
    def sample(parameters: Tensor, generators: Generators) -> Tensor:
        mean, deviation = parameters.chunk(2, -1)
        noise = np.array([generator.standard_normal(mean.shape[1:]) for generator in generators])
        return mean + deviation * torch.from_numpy(noise).to(mean)

    @staticmethod
    def mode(parameters: Tensor) -> Tensor:
        return parameters.chunk(2, -1)[0]

    @staticmethod
    def log_probability(parameters: Tensor, actions: Tensor) -> Tensor:
        mean, deviation = parameters.chunk(2, -1)
        standard = (actions - mean) / deviation
        return -(0.5 * standard.square() + deviation.log() + LOG_SQRT_TAU).sum(-1)

    @staticmethod
    def entropy(parameters: Tensor) -> Tensor:
        deviation = parameters.chunk(2, -1)[1]
        return (0.5 + deviation.log() + LOG_SQRT_TAU).sum(-1)

    @staticmethod
    def gradient(
        parameters: Tensor, actions: Tensor, weights: Tensor, entropy_weight: float | Tensor
    ) -> Tensor:
        """With z = (a - m) / s: dlog pi/dm = z / s,  dlog pi/ds = (z^2 - 1) / s,  dH/ds = 1 / s."""
        mean, deviation = parameters.chunk(2, -1)
        standard = (actions - mean) / deviation
        weights = weights.unsqueeze(-1)
        of_deviation = weights * (standard.square() - 1) + entropy_weight
        return torch.cat([weights * standard, of_deviation], -1) / torch.cat([deviation] * 2, -1)


def _log_softmax(logits: Tensor) -> Tensor:
    """For the few logits of an action it takes half of the time of torch's own."""
    return logits - logits.logsumexp(-1, keepdim=True)
