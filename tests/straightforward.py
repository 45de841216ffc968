"""The LQR problem and IPO with fixed Phi, slow and obvious: the yardstick for ``ipo.lqr``.

One run at a time, automatic differentiation, and the Lyapunov equation as one linear system
of n_x^2 unknowns. Shares no code with ``ipo``; meant to be checked by reading.
"""

import numpy as np
import torch


def semi_orthogonal(random, rows, columns):
    Q, R = np.linalg.qr(random.rand(rows, rows))
    return (Q * np.sign(np.diag(R)))[:, :columns]


def problem(seed, num_domains, dim_distractor, dim_state=20, dtype=torch.float32):
    """``A``, the training domains' ``W`` and the test domain's ``W``."""
    random = np.random.RandomState(seed)
    A = 0.99 * semi_orthogonal(random, dim_state, dim_state)
    W_c = semi_orthogonal(random, dim_state, dim_state)
    Ws = [
        np.vstack([W_c, semi_orthogonal(random, dim_distractor, dim_state)])
        for _ in range(num_domains + 1)
    ]
    A, *Ws = [torch.tensor(matrix, dtype=dtype) for matrix in (A, *Ws)]
    return A, Ws[:-1], Ws[-1]


def cost(K, A, W):
    """``tr P`` with ``vec P = (I - M' kron M')^-1 vec(I + F'F)``; ``B = Q = R = I``."""
    n = A.shape[0]
    F = K @ W
    M = A - F
    constant = torch.eye(n, dtype=A.dtype) + F.T @ F
    system = torch.eye(n * n, dtype=A.dtype) - torch.kron(M.T.contiguous(), M.T.contiguous())
    return torch.linalg.solve(system, constant.reshape(-1)).reshape(n, n).trace()


def gradient_descent(A, Ws, num_iterations, learning_rate=1e-3):
    K = torch.zeros(A.shape[0], Ws[0].shape[0], dtype=A.dtype, requires_grad=True)
    optimizer = torch.optim.Adam([K], lr=learning_rate)
    for _ in range(num_iterations):
        optimizer.zero_grad()
        (sum(cost(K, A, W) for W in Ws) / len(Ws)).backward()
        optimizer.step()
    return K.detach()


def ipo_fixed_phi(A, Ws, num_iterations, learning_rate=5e-4):
    players = [torch.zeros(A.shape[0], W.shape[0], dtype=A.dtype, requires_grad=True) for W in Ws]
    optimizers = [torch.optim.Adam([player], lr=learning_rate) for player in players]
    for _ in range(num_iterations):
        for d, W in enumerate(Ws):
            optimizers[d].zero_grad()
            average = sum(K if i == d else K.detach() for i, K in enumerate(players)) / len(Ws)
            cost(average, A, W).backward()
            optimizers[d].step()
    return (sum(players) / len(players)).detach()
