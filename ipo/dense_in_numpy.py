"""The dense network in NumPy, layer by layer and gradient by gradient, for the CPU.

A policy is small: what an operation of torch costs whatever its size is most of the time that a
step or a minibatch takes. Nothing else is new here; to understand the book, read ``networks``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ipo.distributions import Gaussian
from ipo.networks import Acting, DenseNetwork, Outputs, PullBack, Weights, copied

__all__ = ["DenseInNumpy"]

Layers = list[tuple[np.ndarray, np.ndarray]]  # matrices [R, inputs, units], biases [R, 1, units]


class DenseInNumpy(DenseNetwork):
    """A :class:`ipo.networks.DenseNetwork`: the same numbers, but for rounding, in less time.

    On another device than the CPU it is torch's.
    """

    def vjp(self, weights: Weights, observations: Tensor) -> tuple[Outputs, PullBack]:
        """As that of a network; on small minibatches in half of the time."""
        if observations.device.type != "cpu":
            return super().vjp(weights, observations)
        layers = [self._layers(weights, part) for part in self.layers]
        seen = [_inputs_and_output(own, observations.numpy()) for own in layers]
        (*_, parameters), (*_, values) = seen
        deviation = None
        if self.distribution is Gaussian:
            deviation = np.exp(weights["log_std"].numpy())
            parameters = _with_deviation(parameters, deviation)

        def pull_back(of_parameters: Tensor, of_values: Tensor) -> list[Tensor]:
            of_actor = of_parameters.numpy()[..., : self.num_actions]
            slopes = (of_actor, of_values.unsqueeze(-1).numpy())
            found = [
                _slopes_of_layers(own, x, y) for own, x, y in zip(layers, seen, slopes, strict=True)
            ]
            named = {
                f"{layer}.{kind}": slope
                for part, own in zip(self.layers.values(), found, strict=True)
                for layer, pair in zip(part, own, strict=True)
                for kind, slope in zip(("weight", "bias"), pair, strict=True)
            }
            if deviation is not None:
                of_deviation = of_parameters.numpy()[..., self.num_actions :]
                named["log_std"] = deviation * of_deviation.sum(1)
            return [torch.from_numpy(named[name]) for name in weights]

        return (torch.from_numpy(parameters), torch.from_numpy(values[..., 0])), pull_back

    def _layers(self, weights: Weights, part: str) -> Layers:
        """Views of the weights of the ``actor`` or the ``critic``."""
        return [
            (weights[f"{name}.weight"].numpy(), weights[f"{name}.bias"].numpy()[:, None])
            for name in self.layers[part]
        ]

    def frozen(self, players: Sequence[Weights]) -> Acting:
        """As that of a network; on the few rows of a step in a fifth of the time."""
        self._check(players)
        if next(iter(players[0].values())).device.type != "cpu":
            return super().frozen(players)
        players = copied(players)
        actors, critics = ([self._layers(own, part) for own in players] for part in self.layers)
        deviation = None
        if self.distribution is Gaussian:
            deviation = np.mean([own["log_std"].exp().numpy() for own in players], 0)

        def outputs(parts: list[Layers], x: np.ndarray) -> np.ndarray:
            each = [_inputs_and_output(own, x)[-1] for own in parts]
            return np.sum(each, 0) / len(each)

        def policy(observations: Tensor) -> Outputs:
            x = observations.numpy()
            parameters, values = outputs(actors, x), outputs(critics, x)[..., 0]
            if deviation is not None:
                parameters = _with_deviation(parameters, deviation)
            return torch.from_numpy(parameters), torch.from_numpy(values)

        return policy


def _inputs_and_output(layers: Layers, x: np.ndarray) -> list[np.ndarray]:
    """What goes into each of the layers, with tanh between them, and what comes out at the end."""
    values = [x]
    for number, (matrix, bias) in enumerate(layers):
        y = values[-1] @ matrix
        y += bias
        values.append(y if number == len(layers) - 1 else np.tanh(y, out=y))
    return values


def _slopes_of_layers(layers: Layers, values: list[np.ndarray], slope: np.ndarray) -> Layers:
    """From a loss's slope ``[R, B, units]`` in the output to those in matrices and biases.

    ``values`` are those of :func:`_inputs_and_output`. Back through a layer y = tanh(x) W + b::

        dL/dW = tanh(x)' dL/dy,    dL/db = 1' dL/dy,    dL/dx = (dL/dy W') (1 - tanh(x)^2)
    """
    ones = np.ones((1, 1, slope.shape[1]), slope.dtype)
    found: Layers = []
    for number in reversed(range(len(layers))):
        x = values[number]
        found.append((x.swapaxes(1, 2) @ slope, (ones @ slope)[:, 0]))  # a product: a fast sum
        if number > 0:
            slope = slope @ layers[number][0].swapaxes(1, 2)
            slope *= 1 - x * x
    return found[::-1]


def _with_deviation(means: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """Parameters of a Gaussian from means ``[R, B, A]`` and deviations ``[R, A]``."""
    return np.concatenate([means, np.broadcast_to(deviation[:, None], means.shape)], -1)
