"""Actor-critics for domains of your own: observations are vectors or images."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d

from ipo.dense_in_numpy import DenseInNumpy
from ipo.distributions import Distribution, Gaussian
from ipo.networks import DenseNetwork, Outputs, Weights

__all__ = ["ImageNetwork", "VectorNetwork"]

SMALL = 4  # pixels of the shorter side, at which convolutions stop
CHANNELS = (32, 64)  # of the first convolution, and of all others


class _Unbiased(DenseNetwork):
    """It starts without preferences among actions.

    The actor's last layer starts at a hundredth of an orthogonal matrix, the critic's at one, as
    Andrychowicz et al. (2021) advise.
    """

    def _draw(self, generator: np.random.Generator) -> dict[str, np.ndarray]:
        weights = super()._draw(generator)
        weights[f"{self.layers['actor'][-1]}.weight"] *= 0.01
        weights[f"{self.layers['critic'][-1]}.weight"] /= math.sqrt(2)
        return weights


class VectorNetwork(_Unbiased, DenseInNumpy):
    """A :class:`ipo.networks.DenseNetwork` that starts without preferences among actions."""


class ImageNetwork(_Unbiased):
    """Convolutions that actor and critic share, and a hidden layer of tanh units for each.

    A convolution is 3x3 with stride 2 and a ReLU; there are as many as it takes until the shorter
    side has at most 4 pixels, so images can have any size. Their weights start like those of the
    hidden layers of a :class:`ipo.networks.DenseNetwork`. Channels come last, or first where that
    axis is the shortest, as in a stack of frames. Bytes are divided by 255; other numbers are
    taken as they are.

    Args:
        shape: of an image.
        num_actions: A, of how many to choose or of how many numbers an action consists.
        distribution: of the actions.
        hidden: units of each hidden layer of actor and critic.
    """

    def __init__(
        self,
        shape: Sequence[int],
        num_actions: int,
        distribution: type[Distribution] = Gaussian,
        hidden: Sequence[int] = (128,),
    ) -> None:
        if len(shape) != 3 or min(shape) < 1:
            raise ValueError(f"shape = {shape}: must be 3 whole numbers from 1")
        self.channels_first = shape[0] < min(shape[1:])
        channels, *sides = shape if self.channels_first else (shape[2], *shape[:2])
        convolutions: dict[str, tuple[int, int]] = {}
        while min(sides) > SMALL or not convolutions:
            units = CHANNELS[min(len(convolutions), 1)]
            convolutions[f"conv{len(convolutions) + 1}"] = (9 * channels, units)
            channels, sides = units, [(side + 1) // 2 for side in sides]
        super().__init__(channels * sides[0] * sides[1], num_actions, distribution, hidden)
        self.convolutions = self.phi = list(convolutions)
        self.shapes |= convolutions

    def __call__(self, weights: Weights, observations: Tensor) -> Outputs:
        """``observations [R, B, *shape]`` -> parameters ``[R, B, P]``, values ``[R, B]``."""
        x = observations / 255 if observations.dtype == torch.uint8 else observations
        if not self.channels_first:
            x = x.movedim(-1, 2)
        for name in self.convolutions:
            x = self._convolved(x, weights[f"{name}.weight"], weights[f"{name}.bias"])
        return super().__call__(weights, x.flatten(2))

    @staticmethod
    def _convolved(x: Tensor, matrices: Tensor, biases: Tensor) -> Tensor:
        """``[R, B, C, H, W]``; run by run, which is faster than runs as groups of channels."""
        runs = zip(x, matrices, biases, strict=True)
        kernels = ((own, w.T.unflatten(1, (-1, 3, 3)), b) for own, w, b in runs)
        return torch.stack([conv2d(own, k, b, stride=2, padding=1) for own, k, b in kernels]).relu()
