"""Small problems and comparisons, in double precision, for the tests of several modules."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ipo.lqr import LQR, sample_problem


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


def _norm(matrix: Tensor) -> Tensor:
    return torch.linalg.matrix_norm(matrix, ord=2, keepdim=True)


def assert_close(actual: Tensor, expected: object, rtol: float = 1e-9) -> None:
    """Equal in every entry, to ``rtol`` of the largest one."""
    expected = torch.as_tensor(np.asarray(expected), dtype=actual.dtype)
    atol = rtol * float(expected.abs().max())
    torch.testing.assert_close(actual, expected, rtol=0, atol=atol)


def assert_near(actual: Tensor, expected: object, atol: float) -> None:
    """Equal up to an absolute difference: for what a game has come close to."""
    expected = torch.as_tensor(expected, dtype=actual.dtype).broadcast_to(actual.shape)
    torch.testing.assert_close(actual, expected, rtol=0, atol=atol)
