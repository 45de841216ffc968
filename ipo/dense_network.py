"""An actor-critic for observations that are vectors: the network of the door-opening runs."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ipo.checks import check_count
from ipo.distributions import Distribution, Gaussian
from ipo.networks import Network, Outputs, Weights, dense


class DenseNetwork(Network):
    """A separate actor and critic of tanh layers, for observations that are vectors.

    With the default sizes it is the network of the paper's door-opening runs. Weights start as
    orthogonal matrices times sqrt(2), those of the actor's last layer times 1; biases start at 0.
    The standard deviations of a Gaussian do not depend on the observation: their logarithms are
    weights, which start at 0.

    Args:
        num_observations: length of an observation.
        num_actions: A, of how many to choose or of how many numbers an action consists.
        distribution: :class:`ipo.distributions.Categorical` or
            :class:`ipo.distributions.Gaussian`.
        hidden: units of each hidden layer.
    """

    def __init__(
        self,
        num_observations: int,
        num_actions: int,
        distribution: type[Distribution] = Gaussian,
        hidden: Sequence[int] = (64, 64),
    ) -> None:
        check_count("num_observations", num_observations)
        check_count("num_actions", num_actions)
        for units in hidden:
            check_count("hidden", units)
        self.distribution, self.num_actions = distribution, num_actions
        self.layers: dict[str, list[str]] = {}
        self.shapes = {}
        for part, num_outputs in (("actor", num_actions), ("critic", 1)):
            sizes = [num_observations, *hidden, num_outputs]
            self.layers[part] = [f"{part}{i + 1}" for i in range(len(sizes) - 1)]
            self.shapes |= zip(self.layers[part], itertools.pairwise(sizes), strict=True)

    @property
    def weight_shapes(self) -> dict[str, tuple[int, ...]]:
        extra = {"log_std": (self.num_actions,)} if self.distribution is Gaussian else {}
        return super().weight_shapes | extra

    def _draw(self, generator: np.random.Generator) -> dict[str, np.ndarray]:
        weights = {name: np.zeros(shape) for name, shape in self.weight_shapes.items()}
        for layer, shape in self.shapes.items():
            gain = 1.0 if layer == self.layers["actor"][-1] else math.sqrt(2)
            weights[f"{layer}.weight"] = gain * _orthogonal(shape, generator)
        return weights

    def __call__(self, weights: Weights, observations: Tensor) -> Outputs:
        """``observations [R, B, O]`` -> parameters ``[R, B, P]``, values ``[R, B]``."""

        def outputs(part: str) -> Tensor:
            x = observations
            *hidden, last = self.layers[part]
            for layer in hidden:
                x = Tanh.apply(dense(weights, layer, x))
            return dense(weights, last, x)

        parameters, values = outputs("actor"), outputs("critic").squeeze(-1)
        if self.distribution is Gaussian:
            deviation = weights["log_std"].exp().unsqueeze(1)
            parameters = torch.cat([parameters, deviation.expand_as(parameters)], -1)
        return parameters, values

    def frozen(self, players: Sequence[Weights]) -> Callable[[Tensor], Outputs]:
        """The average that acts, as a function of ``observations [R, B, O]``.

        In NumPy: for the few rows of a step, torch would take five times as long.
        """
        weights = [
            {name: w.detach().numpy().copy() for name, w in player.items()} for player in players
        ]
        deviation = None
        if self.distribution is Gaussian:
            deviation = np.mean([np.exp(own["log_std"]) for own in weights], 0)[:, None]

        def outputs(own: dict[str, np.ndarray], part: str, x: np.ndarray) -> np.ndarray:
            for layer in self.layers[part]:
                x = x @ own[f"{layer}.weight"] + own[f"{layer}.bias"][:, None]
                if layer != self.layers[part][-1]:
                    x = np.tanh(x)
            return x

        def policy(observations: Tensor) -> Outputs:
            x = observations.numpy()
            parameters = sum(outputs(own, "actor", x) for own in weights) / len(weights)
            values = sum(outputs(own, "critic", x) for own in weights)[..., 0] / len(weights)
            if deviation is not None:
                spread = np.broadcast_to(deviation, parameters.shape)
                parameters = np.concatenate([parameters, spread], -1)
            return torch.from_numpy(parameters), torch.from_numpy(values)

        return policy


class Tanh(torch.autograd.Function):
    """The hyperbolic tangent by NumPy, which is ten times as fast as torch's on the CPU."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        y = torch.from_numpy(np.tanh(x.detach().numpy()))
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (y,) = ctx.saved_tensors
        return torch.ops.aten.tanh_backward(gradient, y)  # gradient (1 - y^2), in one pass


def _orthogonal(shape: tuple[int, int], generator: np.random.Generator) -> np.ndarray:
    """A random matrix whose columns, or rows if those are fewer, are orthonormal; uniform."""
    tall = generator.standard_normal((max(shape), min(shape)))
    Q, R = np.linalg.qr(tall)
    Q *= np.sign(np.diag(R))
    # Contiguous: the fused Adam pairs weights and gradients by their place in memory.
    return np.ascontiguousarray(Q if shape[0] >= shape[1] else Q.T)
