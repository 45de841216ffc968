"""Small problems, networks and comparisons, in double precision, for several tests."""

from collections.abc import Sequence

import numpy as np
import torch
from plain_ppo import ActorCritic
from torch import Tensor

from ipo.distributions import Distribution
from ipo.lqr import LQR, sample_problem
from ipo.lqr_learners import LQRSettings, train
from ipo.networks import Outputs, Weights
from ipo.ppo import PPOSettings, gains
from ipo.rollouts import Rollout
from ipo.worlds.networks import GridNetwork


def paper_problem(
    seeds: Sequence[int] = (0, 1),
    num_domains: int = 3,
    dim_distractor: int = 6,
    dim_state: int = 4,
    contraction: float = 0.9,
) -> LQR:
    """The paper's problem, small."""
    return sample_problem(
        seeds, num_domains, dim_distractor, dim_state, contraction, dtype=torch.float64
    )


def general_problem(
    seed: int = 0, n_x: int = 3, n_u: int = 2, n_y: int = 4, num_runs: int = 2, num_domains: int = 2
) -> LQR:
    """A problem without structure, stable without control: a transpose too many shows."""
    generator = torch.Generator().manual_seed(seed)

    def normal(rows: int, columns: int) -> Tensor:
        return torch.randn(num_runs, rows, columns, generator=generator, dtype=torch.float64)

    def positive(size: int) -> Tensor:
        factor = normal(size, size)
        return factor @ factor.mT + torch.eye(size)

    A = normal(n_x, n_x)
    A *= 0.8 / _norm(A)
    return LQR(
        A=A,
        B=normal(n_x, n_u),
        Q=positive(n_x),
        R=positive(n_u),
        seen=normal(n_x + n_y, num_domains * n_x),
        W_test=normal(n_x + n_y, n_x),
    )


def random_gain(problem: LQR, seed: int = 0) -> Tensor:
    """Gains ``[R, n_u, n_o]`` so small that every domain stays stable."""
    generator = torch.Generator().manual_seed(seed)
    shape = (problem.num_runs, *problem.gain_shape)
    K = torch.randn(shape, generator=generator, dtype=torch.float64)
    shown = torch.cat([problem.seen, problem.W_test], dim=-1)
    return K * (1 - _norm(problem.A)) / 2 / (_norm(problem.B) * _norm(K) * _norm(shown))


def trained_gain(
    problem: LQR, settings: LQRSettings, seeds: Sequence[int], start: Tensor | None = None
) -> Tensor:
    """The controllers ``[R, n_u, n_o]`` that training ends with."""
    *_, (_, gain) = train(problem, settings, seeds, start)
    return gain


def _norm(matrix: Tensor) -> Tensor:
    return torch.linalg.matrix_norm(matrix, ord=2, keepdim=True)


def assert_close(actual: Tensor, expected: object, rtol: float = 1e-9) -> None:
    """Equal in every entry, to ``rtol`` of the largest one."""
    expected = torch.as_tensor(np.asarray(expected), dtype=actual.dtype)
    atol = rtol * float(expected.abs().max())
    torch.testing.assert_close(actual, expected, rtol=0, atol=atol)


class DoubleNetwork(GridNetwork):
    """The grid network in double precision, so that float order cannot pass for a mistake."""

    def start(self, generators: Sequence[np.random.Generator]) -> Weights:
        return {name: weight.double() for name, weight in super().start(generators).items()}

    def __call__(self, weights: Weights, images: Tensor) -> Outputs:
        return super().__call__(weights, images.double())


def plain_network(weights: Weights, run: int = 0) -> ActorCritic:
    """One run's weights in layers of ``torch.nn``."""
    first, last = weights["conv1.weight"], weights["actor2.weight"]
    network = ActorCritic(first.shape[1] // 4, last.shape[2]).to(first.dtype)
    layers = {
        "conv1": network.convolutions[0],
        "conv2": network.convolutions[3],
        "conv3": network.convolutions[5],
        "actor1": network.actor[0],
        "actor2": network.actor[2],
        "critic1": network.critic[0],
        "critic2": network.critic[2],
    }
    with torch.no_grad():
        for name, layer in layers.items():
            matrix = weights[f"{name}.weight"][run].T  # [units, inputs]
            if name.startswith("conv"):  # inputs are row by row the pixels of a 2x2 square
                matrix = matrix.unflatten(1, (2, 2, -1)).permute(0, 3, 1, 2)
            layer.weight.copy_(matrix)
            layer.bias.copy_(weights[f"{name}.bias"][run])
    return network


def assert_near(actual: Tensor, expected: object, atol: float) -> None:
    """Equal up to an absolute difference: for what a game has come close to."""
    expected = torch.as_tensor(expected, dtype=actual.dtype).broadcast_to(actual.shape)
    torch.testing.assert_close(actual, expected, rtol=0, atol=atol)


def clipped_loss(
    distribution: type[Distribution],
    parameters: Tensor,
    values: Tensor,
    batch: Rollout,
    settings: PPOSettings,
) -> Tensor:
    """PPO's loss ``[R]``, to be minimised, on a minibatch ``[R, B]``::

        - mean min(rho A, clip(rho, 1 - c, 1 + c) A) - w_e mean H(pi)
        + w_v mean max((V - G)^2, (clip(V, V_old - c, V_old + c) - G)^2),
        rho = pi(a | o) / pi_old(a | o)

    G are the returns of the rollout; without ``clip_values`` V is not clipped.
    """
    gain, near_gain = gains(distribution, parameters, batch, settings)
    near = values
    if settings.clip_values:
        near = values.clamp(batch.values - settings.clip, batch.values + settings.clip)
    error, near_error = values - batch.returns, near - batch.returns
    return (
        -torch.minimum(gain, near_gain).mean(1)
        - settings.entropy_weight * distribution.entropy(parameters).mean(1)
        + settings.value_weight * torch.maximum(error**2, near_error**2).mean(1)
    )
