"""Penalties on what differs between domains, after V-REx and IRMv1, for a policy's return.

Both come down to a factor for each frame of a rollout, the same for all frames of a domain. It is
measured once for a rollout, before the policy learns from it, as advantages are.

Axes: R runs, F frames, domain after domain: so many of each as ``sizes`` says.

Sources: Krueger et al. (2021) for V-REx and Arjovsky et al. (2019) for IRMv1, both of supervised
learning, where a domain's risk stands for minus its return.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def variance_factors(returns: Tensor, sizes: Sequence[int], penalty: float) -> Tensor:
    """How much a frame's advantage counts, ``[R, F]``, where the returns of domains shall be alike.

        J = mean_d R_d - penalty * var_d R_d,
        dJ = mean_d [ 1 - 2 penalty (R_d - mean R) ] dR_d

    R_d is the mean of what the frames' values should have been: ``returns [R, F]``.
    """
    means = _means_of_domains(returns, sizes)
    return _for_frames(1 - 2 * penalty * (means - means.mean(1, keepdim=True)), sizes)


def scale_factors(
    slopes: Tensor, advantages: Tensor, sizes: Sequence[int], penalty: float
) -> Tensor:
    """``2 penalty g_d`` of each frame's domain, ``[R, F]`` as slopes and advantages are.

    g_d is the derivative of a domain's return by a factor w on the scores of all actions, at w = 1.
    Where no common factor could make any domain better, all g_d are zero::

        penalty * mean_d g_d^2,      g_d = E_d[ A (log pi(a | o) + H(pi( . | o))) ]

    The bracket is the slope of ``log pi``, ``z_a - sum_i pi_i z_i`` for scores z.
    """
    return _for_frames(2 * penalty * _means_of_domains(advantages * slopes, sizes), sizes)


def _means_of_domains(x: Tensor, sizes: Sequence[int]) -> Tensor:
    """``[R, F] -> [R, E]``."""
    return torch.stack([part.mean(1) for part in x.split(list(sizes), 1)], 1)


def _for_frames(x: Tensor, sizes: Sequence[int]) -> Tensor:
    """``[R, E] -> [R, F]``."""
    return x.repeat_interleave(torch.tensor(sizes, device=x.device), 1)
