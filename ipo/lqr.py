"""Linear quadratic control with distractors: the problem, its exact cost, and its solutions.

    s[t+1] = A s[t] + B a[t],    o = W s = [W_c; W_d] s,    a = -K o,    s[0] ~ N(0, I)
    cost   = E sum_t  s'Q s + a'R a                                  (Section 5.1 of the paper)

A domain is a choice of ``W_d``. ``W_c s`` holds the whole state in the same way in every
domain; ``W_d s`` holds it once more in a way that changes: a distractor. (The paper writes
``a = K o``; the sign is a matter of convention.)

Tensors have the leading axes runs R and, where they differ by domain, domains E. Sizes:
``n_x`` states, ``n_u`` inputs, ``n_y`` distractors, ``n_o = n_x + n_y`` observations.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
import scipy.linalg
import torch
from torch import Tensor

from ipo.checks import Count, Natural, Positive, Seeds, check_count, checked

# A closed loop whose power 2^20 has not vanished counts as unstable: its spectral radius
# is above 1 - 1e-5.
FEWEST_DOUBLINGS, MAX_DOUBLINGS = 4, 20

Gains = Annotated[Tensor, "R n_u n_o"]
Observation = Annotated[Tensor, "R n_o n_x"]  # of a domain


@checked
@dataclass(frozen=True)
class LQR:
    """A stack of R independent problems that share their sizes.

    Attributes:
        A: dynamics ``[R, n_x, n_x]``.
        B: inputs ``[R, n_x, n_u]``.
        Q: weights of the state in the cost ``[R, n_x, n_x]``.
        R: weights of the input ``[R, n_u, n_u]``.
        seen: observations of the training domains side by side, ``[W_1 ... W_E]``,
            ``[R, n_o, E n_x]``: one product ``K seen`` gives the feedback in all of them.
        W_test: observation of the test domain ``[R, n_o, n_x]``.
    """

    A: Annotated[Tensor, "R n_x n_x"]
    B: Annotated[Tensor, "R n_x n_u"]
    Q: Annotated[Tensor, "R n_x n_x"]
    R: Annotated[Tensor, "R n_u n_u"]
    seen: Annotated[Tensor, "R n_o columns"]
    W_test: Annotated[Tensor, "R n_o n_x"]

    def __post_init__(self) -> None:
        num_columns, n_x = self.seen.shape[-1], self.A.shape[-1]
        if num_columns % n_x:
            raise ValueError(f"seen: has {num_columns} columns, must have a multiple of {n_x}")

    @property
    def sizes(self) -> dict[str, Any]:
        (R, n_x, n_u), n_o = self.B.shape, self.seen.shape[1]
        return {"R": R, "n_x": n_x, "n_u": n_u, "n_o": n_o, "dtype": self.A.dtype}

    @property
    def num_runs(self) -> int:
        return self.A.shape[0]

    @property
    def num_domains(self) -> int:
        return self.seen.shape[-1] // self.A.shape[-1]

    @property
    def gain_shape(self) -> tuple[int, int]:
        """``(n_u, n_o)``."""
        return self.B.shape[-1], self.seen.shape[-2]

    @property
    def W_train(self) -> Tensor:
        """Observations of the training domains ``[R, E, n_o, n_x]``."""
        return split_domains(self.seen, self.num_domains)

    def _map(self, change: Callable[[Tensor], Tensor]) -> LQR:
        return replace(self, **{name: change(getattr(self, name)) for name in vars(self)})

    @checked
    def run(self, r: Natural) -> LQR:
        """The problem of run r alone, still with a run axis."""
        check_count("r", r, 0, self.num_runs - 1)
        return self._map(lambda tensor: tensor[r : r + 1])

    def to(self, dtype: torch.dtype) -> LQR:
        return self._map(lambda tensor: tensor.to(dtype))


@checked
def sample_problem(
    seeds: Seeds,
    num_domains: Count,
    dim_distractor: Count,
    dim_state: Count = 20,
    contraction: Positive = 0.99,
    dtype: torch.dtype = torch.float32,
) -> LQR:
    """The paper's random problems, one per seed: ``B = Q = R = I``, one test domain.

    ``A`` is ``contraction`` times a random orthogonal matrix. The text says orthogonal, but
    then ``K = 0``, where training starts, has infinite cost, and the oracle's 32.1 comes out
    only with 0.99. The draws follow the published runs: NumPy's legacy generator, seeded
    with the run's number, in the order ``A``, ``W_c``, one ``W_d`` per training domain, one
    for the test domain.

    Raises:
        TypeError, ValueError: see the rules below; nothing has been drawn by then.
    """
    if dim_distractor < dim_state:
        raise ValueError(
            f"dim_distractor = {dim_distractor}: must be at least dim_state = {dim_state}, "
            "or W_d cannot be semi-orthogonal"
        )

    def draw(seed: int) -> tuple[np.ndarray, np.ndarray]:
        random = np.random.RandomState(seed)
        A = contraction * random_orthogonal(random, dim_state, dim_state)
        W_c = random_orthogonal(random, dim_state, dim_state)
        distractors = (
            random_orthogonal(random, dim_distractor, dim_state) for _ in range(num_domains + 1)
        )
        return A, np.stack([np.concatenate([W_c, W_d]) for W_d in distractors])

    A, W = (torch.tensor(np.stack(x), dtype=dtype) for x in zip(*map(draw, seeds), strict=True))
    identity = torch.eye(dim_state, dtype=dtype).expand(len(seeds), -1, -1)
    seen = W[:, :-1].transpose(1, 2).flatten(2)
    return LQR(A, identity, identity, identity, seen, W_test=W[:, -1])


def split_domains(matrix: Tensor, num_domains: int) -> Tensor:
    """``[R, rows, E n_x] -> [R, E, rows, n_x]``, a view."""
    return matrix.unflatten(-1, (num_domains, -1)).transpose(1, 2)


@checked
def random_orthogonal(
    random: np.random.RandomState, num_rows: Count, num_columns: Count
) -> np.ndarray:
    """A random matrix with orthonormal columns, ``[num_rows, num_columns]``.

    The first columns of the QR factor ``Q diag(sign(diag(R)))`` of a square matrix with
    uniform [0, 1) entries. They depend on the matrix' first columns only, so only these are
    factorised; all are drawn, because the published runs draw them.
    """
    check_count("num_columns", num_columns, maximum=num_rows)
    entries = random.rand(num_rows, num_rows)[:, :num_columns]
    orthonormal, triangular = np.linalg.qr(entries)
    return orthonormal * np.sign(np.diag(triangular))


@checked
def expected_cost(K: Gains, problem: LQR, W: Observation) -> Tensor:
    """Expected infinite-horizon cost of ``a = -K o`` in the domain with observation ``W``.

    With ``s[0] ~ N(0, I)`` it is ``tr P``, where P solves

        P = Q + F'R F + M'P M,    F = K W,    M = A - B F.

    Args:
        K: gains ``[R, n_u, n_o]``.
        W: observations ``[R, n_o, n_x]``.

    Returns:
        ``[R]``, differentiable; ``inf`` where the closed loop is unstable, since the equation then
        still has a solution, but a meaningless one.
    """
    return feedback_costs(K @ W, problem)


@checked
def training_costs(K: Gains, problem: LQR) -> Tensor:
    """:func:`expected_cost` of gains ``[R, n_u, n_o]`` in every training domain, ``[R, E]``."""
    return feedback_costs(split_domains(K @ problem.seen, problem.num_domains), problem)


def feedback_costs(F: Tensor, problem: LQR) -> Tensor:
    """The cost of ``a = -F s``, F ``[R, n_u, n_x]`` or ``[R, E, n_u, n_x]``; unchecked."""
    return _FeedbackCosts.apply(F, problem)


def feedback_slopes(F: Tensor, problem: LQR, share: float = 1.0) -> tuple[Tensor, Tensor]:
    """The same, and ``share`` times its gradient, of the shape of F, by hand.

        dJ/dF = 2 [R F - B'P M] S,    S = I + M S M'   (sum of the states' covariances)

    Source: Fazel et al. (2018), lemma 1.
    """
    A, B, Q, R = (_beside(matrix, F) for matrix in (problem.A, problem.B, problem.Q, problem.R))
    feedback = F.flatten(0, -3)
    M = torch.baddbmm(A, B, feedback, alpha=-1)
    RF = torch.bmm(R, feedback)
    P, S = _lyapunov_pair(M, torch.baddbmm(Q, feedback.mT, RF))
    slopes = torch.baddbmm(RF, B.mT, torch.bmm(P, M), alpha=-1).mul_(2 * share)
    costs = P.diagonal(dim1=-2, dim2=-1).sum(-1)
    return costs.view(F.shape[:-2]), torch.bmm(slopes, S).view_as(F)


def _beside(matrix: Tensor, F: Tensor) -> Tensor:
    """A matrix of each run, once for each of its systems."""
    if F.dim() == 3:
        return matrix
    return matrix.unsqueeze(1).expand(-1, F.shape[1], -1, -1).flatten(0, 1)


class _FeedbackCosts(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, F: Tensor, problem: LQR) -> Tensor:
        costs, slopes = feedback_slopes(F, problem)
        ctx.save_for_backward(slopes)
        return costs

    @staticmethod
    def backward(ctx: Any, grad_costs: Tensor) -> tuple[Tensor, None]:
        (slopes,) = ctx.saved_tensors
        return slopes * grad_costs[..., None, None], None


def _lyapunov_pair(M: Tensor, C: Tensor) -> tuple[Tensor, Tensor]:
    """Solve ``P = C + M'P M`` and ``S = I + M S M'`` together by doubling.

    After k doublings ``X`` holds the first 2^k terms of both series and ``Y`` is M^(2^k):

        X <- X + Y'X Y,    Y <- Y Y.

    Stops when the next terms are below rounding, which takes 4 to 10 doublings: before, it would
    be a waste of time to look.

    Returns:
        P, S ``[systems, n, n]``. Where a series does not end, P is infinite and S is NaN: the cost
        is infinite and has no gradient.
    """
    X = torch.cat([C, torch.eye(M.shape[-1], dtype=M.dtype).expand_as(C)])
    Y = torch.cat([M, M.mT])  # the second equation is the first one of M'
    negligible = math.sqrt(torch.finfo(M.dtype).eps) / 4
    for number in range(1, MAX_DOUBLINGS + 1):
        X = torch.baddbmm(X, torch.bmm(Y.mT, X), Y)
        Y = torch.bmm(Y, Y)
        if number < FEWEST_DOUBLINGS:
            continue
        size = torch.linalg.vector_norm(Y[: len(M)], dim=(-2, -1))
        if float(size.max()) < negligible:
            P, S = X.chunk(2)
            return P, S
    P, S = X.chunk(2)
    endless = ~(size < negligible)
    P[endless], S[endless] = math.inf, math.nan
    return P, S


@checked
def spectral_radius(K: Gains, problem: LQR, W: Observation) -> Tensor:
    """Largest absolute eigenvalue ``[R]`` of the closed loop ``A - B K W``; stable below 1."""
    M = problem.A - problem.B @ K @ W
    return torch.linalg.eigvals(M.double()).abs().amax(-1)


@checked
def riccati_gain(problem: LQR) -> tuple[Tensor, Tensor]:
    """The oracle, which sees the state: its gain ``F* [R, n_u, n_x]`` and cost ``[R]``.

        P* = Q + A'P*A - A'P*B (R + B'P*B)^-1 B'P*A,    F* = (R + B'P*B)^-1 B'P*A

    No controller of any kind is better in any domain. Source: Anderson and Moore (2007).
    """

    def solve(*matrices: Tensor) -> tuple[np.ndarray, float]:
        A, B, Q, R = (matrix.double().numpy() for matrix in matrices)
        P = scipy.linalg.solve_discrete_are(A, B, Q, R)
        return np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A), np.trace(P)

    solutions = [
        solve(*run) for run in zip(problem.A, problem.B, problem.Q, problem.R, strict=True)
    ]
    gains, costs = (torch.tensor(np.array(x)) for x in zip(*solutions, strict=True))
    return gains.to(problem.A), costs.to(problem.A)


@checked
def oracle_cost(dim_state: Count = 20, contraction: Positive = 0.99) -> float:
    """The oracle's cost in closed form for the paper's problem.

    With ``B = Q = R = I`` and ``A = c`` times an orthogonal matrix, ``P* = p I`` with

        p = (c^2 + sqrt(c^4 + 4)) / 2.
    """
    c2 = contraction**2
    return dim_state * (c2 + math.sqrt(c2**2 + 4)) / 2


@checked
def row_space(problem: LQR) -> Tensor:
    """Orthonormal basis ``[R, n_o, rank]`` of the observations that training can show.

    The span of the columns of ``[W_1 ... W_E]``. What a gain does outside of it has no
    effect in any training domain.
    """
    basis, sizes, _ = torch.linalg.svd(problem.seen.double(), full_matrices=False)
    rank = int((sizes[0] > 1e-6 * sizes[0, 0]).sum())
    return basis[..., :rank].to(problem.A)


@checked
def project(K: Gains, basis: Annotated[Tensor, "R n_o rank"]) -> Tensor:
    """The part of gains ``[R, n_u, n_o]`` inside the span of ``basis [R, n_o, rank]``."""
    return (K @ basis) @ basis.mT


@checked
def minimum_norm_gain(problem: LQR) -> Tensor:
    """The smallest gain ``[R, n_u, n_o]`` that is optimal in every training domain.

        K = [F* ... F*] pinv([W_1 ... W_E])

    Gradient descent from ``K = 0`` converges to it (see the chapter on LQR).
    """
    F, _ = riccati_gain(problem.to(torch.float64))
    targets = F.repeat(1, 1, problem.num_domains)
    return (targets @ torch.linalg.pinv(problem.seen.double())).to(problem.A)


@checked
def invariant_gain(problem: LQR) -> Tensor:
    """The gain ``[F* W_c^-1, 0]``, ``[R, n_u, n_o]``: optimal in every domain there can be."""
    F, _ = riccati_gain(problem)
    n_x = F.shape[-1]
    K = torch.zeros(problem.num_runs, *problem.gain_shape, dtype=F.dtype)
    K[..., :n_x] = F @ torch.linalg.inv(problem.seen[:, :n_x, :n_x])
    return K


@checked
def simulate(
    K: Gains, problem: LQR, W: Observation, start: Annotated[Tensor, "R n_x"], num_steps: Natural
) -> Tensor:
    """States ``[R, num_steps + 1, n_x]`` of the closed loop from ``start [R, n_x]``."""
    M = problem.A - problem.B @ K @ W
    states = [start]
    for _ in range(num_steps):
        states.append((M @ states[-1].unsqueeze(-1)).squeeze(-1))
    return torch.stack(states, dim=1)
