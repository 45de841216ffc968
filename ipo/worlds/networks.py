"""Networks for tables: MiniGrid's view as the paper's keys see it, and rows instead of pictures.

Observations of a tabulated task are indices of the distinct ones (``ipo.worlds.tabular``); networks
here are evaluated once for each of them, not once for each frame.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import Annotated

import numpy as np
import torch
from torch import Tensor

from ipo.checks import Count, Positive, checked
from ipo.dense_in_numpy import DenseInNumpy
from ipo.distributions import Categorical, Generators
from ipo.networks import (
    Acting,
    Network,
    Outputs,
    PullBack,
    Tanh,
    Weights,
    averaged,
    chosen_rows,
    dense,
)

PIECE = 256  # rows of a table that are evaluated together


class GridNetwork(Network):
    """The actor-critic of the published runs for MiniGrid's 7x7 view (appendix, Fig. 4).

    Three 2x2 convolutions (16, 32, 64 channels) with ReLU, max-pooling after the first; then an
    actor and a critic, each with one hidden layer of 64 tanh units.

    Convolutions start uniform within ``1 / sqrt(inputs)``; in dense layers the weights of each unit
    start as a random direction of length 1, and biases are zero.

    Args:
        num_channels: of the image; 3 for MiniGrid's codes of object, colour and state.
        num_actions: A, of how many to choose.
        width: of all layers, relative to the published ones; sqrt(2) has twice as many weights.
    """

    distribution = Categorical
    phi = ("conv1", "conv2", "conv3")

    @checked
    def __init__(
        self, num_channels: Count = 3, num_actions: Count = 7, width: Positive = 1.0
    ) -> None:
        few, some, many = (round(width * units) for units in (16, 32, 64))
        self.shapes = {
            "conv1": (4 * num_channels, few),
            "conv2": (4 * few, some),
            "conv3": (4 * some, many),
            "actor1": (many, many),
            "actor2": (many, num_actions),
            "critic1": (many, many),
            "critic2": (many, 1),
        }

    def _draw(self, generator: np.random.Generator) -> dict[str, np.ndarray]:
        weights = {}
        for name, (num_inputs, num_units) in self.shapes.items():
            if name.startswith("conv"):
                bound = 1 / math.sqrt(num_inputs)
                matrix = generator.uniform(-bound, bound, (num_inputs, num_units))
                bias = generator.uniform(-bound, bound, num_units)
            else:
                matrix = generator.standard_normal((num_inputs, num_units))
                matrix /= np.linalg.norm(matrix, axis=0)
                bias = np.zeros(num_units)
            weights[f"{name}.weight"], weights[f"{name}.bias"] = matrix, bias
        return weights

    def __call__(self, weights: Weights, images: Tensor) -> Outputs:
        """``images [R, B, 7, 7, C]`` -> logits ``[R, B, A]``, values ``[R, B]``."""

        x = dense(weights, "conv1", _patches(images).flatten(1, -2)).relu()
        x = _max_pool(x.reshape(*images.shape[:2], 6, 6, -1))  # [R, B, 3, 3, 16]
        return self.after_pooling(weights, _patches(x).flatten(2, 3))

    def after_pooling(self, weights: Weights, x: Tensor) -> Outputs:
        """The second convolution's four inputs ``[R, B, 4, 4 x 16]`` of each image -> outputs."""
        num_images = x.shape[1]
        x = dense(weights, "conv2", x.flatten(1, 2)).relu()  # [R, 4 B, 32]
        x = dense(weights, "conv3", x.unflatten(1, (num_images, 4)).flatten(2)).relu()
        logits = dense(weights, "actor2", Tanh.apply(dense(weights, "actor1", x)))
        values = dense(weights, "critic2", Tanh.apply(dense(weights, "critic1", x)))
        return logits, values.squeeze(-1)


class TableNetwork(Network):
    """A network whose observations are indices of rows in a table of K distinct ones."""

    @abstractmethod
    def average(self, players: Sequence[Weights]) -> Outputs:
        """What the players' average makes of the whole table: ``[R, K, A]`` and ``[R, K]``."""

    def frozen(self, players: Sequence[Weights]) -> Acting:
        """The average of ``players`` as they are now, as a function of ``indices [R, B]``."""
        logits, values = self.average(players)
        return lambda indices: (chosen_rows(logits, indices), chosen_rows(values, indices))


class OnTable(TableNetwork):
    """A grid network on a table.

    The network is evaluated once for each row that occurs, not once for each occurrence; what comes
    before the second convolution once for each distinct part of the table's images. There are few,
    as walls look alike everywhere.

    Attributes:
        patches: the distinct 2x2 neighbourhoods ``[P, 4 C]``.
        pairs: what is pooled, ``[2, ...]``: patches above each other, then such pairs side by side.
        seen: the pooled squares under the second convolution's four patches, ``[K, 16]``.
    """

    @checked
    def __init__(self, network: GridNetwork, table: Annotated[Tensor, "K 7 7 C"]) -> None:
        self.network, self.table = network, table
        self.distribution, self.phi, self.shapes = network.distribution, network.phi, network.shapes

        def distinct(parts: Tensor) -> tuple[Tensor, Tensor]:
            return parts.flatten(0, -2).unique(dim=0, return_inverse=True)

        self.patches, index = distinct(_patches(table.unsqueeze(0)))
        above, index = distinct(index.reshape(-1, 3, 2, 6).transpose(2, 3))
        beside, index = distinct(index.reshape(-1, 3, 3, 2))
        self.pairs = above.T, beside.T
        self.seen = _patches(index.reshape(1, -1, 3, 3, 1)).reshape(-1, 16)

    def start(self, generators: Generators) -> Weights:
        """As the network starts."""
        return self.network.start(generators)

    def _draw(self, generator: np.random.Generator) -> dict[str, np.ndarray]:
        return self.network._draw(generator)

    def __call__(self, weights: Weights, indices: Tensor) -> Outputs:
        """``indices [R, B]`` -> logits ``[R, B, A]``, values ``[R, B]``."""
        rows, position = _distinct(indices, len(self.table))
        device = rows.device
        squares = self.seen.to(device).index_select(0, rows.flatten()).reshape(len(rows), -1)
        pooled = chosen_rows(self._pooled(weights), squares).reshape(*rows.shape, 4, -1)
        logits, values = self.network.after_pooling(weights, pooled)
        return chosen_rows(logits, position), chosen_rows(values, position)

    def _pooled(self, weights: Weights) -> Tensor:
        """The distinct squares after the first convolution and its pooling, ``[R, squares, 16]``.

        Patches are the same for all runs, whose units stand side by side: one large product.
        """
        num_runs, _, num_units = weights["conv1.weight"].shape
        kernels = weights["conv1.weight"].transpose(0, 1).flatten(1)  # [4 C, R 16]
        device = kernels.device
        x = torch.addmm(weights["conv1.bias"].flatten(), self.patches.to(device), kernels).relu()
        for pair in self.pairs:
            first, second = pair.to(device)
            x = _larger(x.index_select(0, first), x.index_select(0, second))
        return x.reshape(-1, num_runs, num_units).transpose(0, 1)

    def average(self, players: Sequence[Weights]) -> Outputs:
        self._check(players)
        weight = next(iter(players[0].values()))
        policy = averaged(self, players)
        rows = torch.arange(len(self.table), device=weight.device).expand(len(weight), -1)
        # In pieces, which stay in the processor's cache.
        logits, values = zip(*map(policy, rows.split(PIECE, 1)), strict=True)
        return torch.cat(logits, 1), torch.cat(values, 1)


class DenseOnTable(TableNetwork, DenseInNumpy):
    """A dense actor-critic on a table.

    Args:
        table: the observations.
        num_actions: A, of how many to choose.
        hidden: units of each hidden layer.
    """

    @checked
    def __init__(
        self, table: Annotated[Tensor, "K O"], num_actions: Count, hidden: Sequence[Count]
    ) -> None:
        super().__init__(table.shape[1], num_actions, Categorical, hidden)
        self.table = table

    def __call__(self, weights: Weights, indices: Tensor) -> Outputs:
        """``indices [R, B]`` -> logits ``[R, B, A]``, values ``[R, B]``."""
        return super().__call__(weights, self.table[indices])

    def vjp(self, weights: Weights, indices: Tensor) -> tuple[Outputs, PullBack]:
        """As that of a dense network."""
        return super().vjp(weights, self.table[indices])

    def average(self, players: Sequence[Weights]) -> Outputs:
        self._check(players)
        num_runs = len(next(iter(players[0].values())))
        return DenseInNumpy.frozen(self, players)(self.table.expand(num_runs, -1, -1))


def _patches(x: Tensor) -> Tensor:
    """All 2x2 neighbourhoods, ``[R, B, h, w, c] -> [R, B, h - 1, w - 1, 4 c]``."""
    corners = (x[:, :, :-1, :-1], x[:, :, :-1, 1:], x[:, :, 1:, :-1], x[:, :, 1:, 1:])
    return torch.cat(corners, dim=-1)


def _max_pool(x: Tensor) -> Tensor:
    """Maximum over disjoint 2x2 squares, ``[R, B, h, w, c] -> [R, B, h / 2, w / 2, c]``."""
    rows = _larger(x[:, :, ::2], x[:, :, 1::2])
    return _larger(rows[:, :, :, ::2], rows[:, :, :, 1::2])


def _larger(x: Tensor, y: Tensor) -> Tensor:
    """The maximum of two tensors that are not negative; its gradient takes a sixth of the time."""
    return y + (x - y).relu()


def _distinct(indices: Tensor, num_rows: int) -> tuple[Tensor, Tensor]:
    """Rows ``[R, U]`` that occur in ``indices [R, B]`` of each run, and the place of each index.

    Runs with fewer than U rows are filled up with rows that nobody asks for.
    """
    occurs = indices.new_zeros(len(indices), num_rows).scatter_(1, indices, 1)
    num_distinct = int(occurs.sum(1).max())
    rows = occurs.argsort(dim=1, descending=True, stable=True)[:, :num_distinct]
    return rows, (occurs.cumsum(1) - 1).gather(1, indices)
