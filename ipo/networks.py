"""Networks for many runs at once: every weight has a leading run axis R, and layers are ``bmm``.

A network is a function ``network(weights, observations) -> (parameters, values)`` of one player's
weights ``{name: [R, ...]}``; the parameters are those of its ``distribution`` of actions, such as
logits. Players are kept apart as a list of such weights; their average acts (Section 4 and the
appendix of the paper):

    parameters = (1 / E) sum_d parameters_d,    value = (1 / E) sum_d value_d
"""

from __future__ import annotations

import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Annotated, Any

import numpy as np
import torch
from torch import Tensor

from ipo.checks import Count, check_count, checked
from ipo.distributions import Distribution, Gaussian, Generators
from ipo.game import average

Weights = dict[str, Tensor]
Outputs = tuple[Tensor, Tensor]
Acting = Callable[[Tensor], Outputs]  # what is done where observations are seen
PullBack = Callable[[Tensor, Tensor], list[Tensor]]  # slopes in the outputs -> in the weights


class Network(ABC):
    """What actor-critics share: layers by name, weights drawn run by run, the players' average.

    Attributes:
        distribution: what the outputs of the actor are parameters of.
        shapes: ``{layer: (inputs, units)}``.
        phi: the layers that see observations, which players share where Phi is variable.
    """

    distribution: type[Distribution]
    shapes: dict[str, tuple[int, int]]
    phi: Sequence[str] = ()

    @property
    def weight_shapes(self) -> dict[str, tuple[int, ...]]:
        """Of a player's weights in one run, by name."""
        shapes = {f"{layer}.weight": shape for layer, shape in self.shapes.items()}
        return shapes | {f"{layer}.bias": shape[1:] for layer, shape in self.shapes.items()}

    @checked
    def start(self, generators: Annotated[Generators, "R"]) -> Weights:
        """Random weights, one run for each generator."""
        runs = [self._draw(generator) for generator in generators]
        return {
            name: torch.tensor(np.stack([run[name] for run in runs]), dtype=torch.float32)
            for name in runs[0]
        }

    @abstractmethod
    def _draw(self, generator: np.random.Generator) -> dict[str, np.ndarray]:
        """Random weights of one run."""

    @abstractmethod
    def __call__(self, weights: Weights, observations: Tensor) -> Outputs:
        """``observations [R, B, ...]`` -> parameters ``[R, B, P]``, values ``[R, B]``."""

    def vjp(self, weights: Weights, observations: Tensor) -> tuple[Outputs, PullBack]:
        """The outputs, and what takes a loss's slopes in them to those in the weights.

        It is the vector-Jacobian product: slopes of the shapes of parameters and values -> one
        ``[R, ...]`` for each of the weights, in their order. Nothing else has a gradient.
        """
        leaves = {name: w.detach().requires_grad_() for name, w in weights.items()}
        with torch.enable_grad():
            outputs = self(leaves, observations)

        def pull_back(of_parameters: Tensor, of_values: Tensor) -> list[Tensor]:
            slopes = (of_parameters, of_values)
            return list(torch.autograd.grad(outputs, list(leaves.values()), slopes))

        return (outputs[0].detach(), outputs[1].detach()), pull_back

    @checked
    def _check(self, players: Annotated[Sequence[Weights], "E"]) -> None:
        for d, player in enumerate(players):
            shapes = {name: tuple(weight.shape[1:]) for name, weight in player.items()}
            if shapes != self.weight_shapes:
                raise ValueError(f"players[{d}]: of shapes {shapes}, must be {self.weight_shapes}")

    def frozen(self, players: Sequence[Weights]) -> Acting:
        """The average that acts, as a function of observations."""
        self._check(players)
        return averaged(self, players)


class DenseNetwork(Network):
    """A separate actor and critic of tanh layers, for observations that are vectors.

    With the default sizes it is the network of the paper's door-opening runs. Weights start as
    orthogonal matrices times sqrt(2), those of the actor's last layer times 1; biases start at 0.
    The standard deviations of a Gaussian do not depend on the observation: their logarithms are
    weights, which start at 0. :class:`ipo.dense_in_numpy.DenseInNumpy` is the same, but faster.

    Args:
        num_observations: length of an observation.
        num_actions: A, of how many to choose or of how many numbers an action consists.
        distribution: :class:`ipo.distributions.Categorical` or
            :class:`ipo.distributions.Gaussian`.
        hidden: units of each hidden layer.
    """

    @checked
    def __init__(
        self,
        num_observations: Count,
        num_actions: Count,
        distribution: type[Distribution] = Gaussian,
        hidden: Sequence[Count] = (64, 64),
    ) -> None:
        self.distribution, self.num_actions = distribution, num_actions
        self.layers: dict[str, list[str]] = {}
        self.shapes = {}
        for part, num_outputs in (("actor", num_actions), ("critic", 1)):
            sizes = [num_observations, *hidden, num_outputs]
            self.layers[part] = [f"{part}{i + 1}" for i in range(len(sizes) - 1)]
            self.shapes |= zip(self.layers[part], itertools.pairwise(sizes), strict=True)
        self.phi = [layers[0] for layers in self.layers.values()] if hidden else []

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


def averaged(network: Callable[[Weights, Tensor], Outputs], players: Sequence[Weights]) -> Acting:
    """The average of a network's players, without gradients, as a function of observations."""

    @torch.no_grad()
    def policy(observations: Tensor) -> Outputs:
        outputs = [network(player, observations) for player in players]
        parameters, values = zip(*outputs, strict=True)
        return average(torch.stack(parameters, 1)), average(torch.stack(values, 1))

    return policy


@checked
def copied(players: Sequence[Weights]) -> list[Weights]:
    """The players as they are now, without gradients; training changes weights in place."""
    return [{name: w.detach().clone() for name, w in player.items()} for player in players]


@checked
def of_run(players: Annotated[Sequence[Weights], "E"], run: int) -> list[Weights]:
    """The players of one of R runs, as views ``[1, ...]`` of the same memory."""
    num_runs = min(len(weights) for player in players for weights in player.values())
    check_count("run", run, 0, num_runs - 1)
    return [{name: w[run : run + 1] for name, w in player.items()} for player in players]


def dense(weights: Weights, name: str, x: Tensor) -> Tensor:
    """A layer by name: ``x [R, B, inputs] -> [R, B, units]``."""
    return torch.baddbmm(weights[f"{name}.bias"].unsqueeze(1), x, weights[f"{name}.weight"])


class Tanh(torch.autograd.Function):
    """The hyperbolic tangent by NumPy, which is ten times as fast as torch's on the CPU."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        on_cpu = x.device.type == "cpu"
        y = torch.from_numpy(np.tanh(x.detach().numpy())) if on_cpu else x.tanh()
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


def chosen_rows(table: Tensor, chosen: Tensor) -> Tensor:
    """Rows of ``table [R, U, ...]`` at ``chosen [R, B]``: ``[R, B, ...]``."""
    first = table.shape[1] * torch.arange(len(table), device=chosen.device).unsqueeze(1)
    rows = table.flatten(0, 1).index_select(0, (first + chosen).flatten())
    return rows.unflatten(0, chosen.shape)
