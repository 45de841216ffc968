"""Penalties on what differs between domains, and dropout: against torch's own derivatives."""

import numpy as np
import pytest
import torch
from small import DoubleNetwork, assert_close
from torch import Tensor

from experiments.regularized.networks import (
    Penalized,
    RegularizedSettings,
    dropout_factors,
    scale_factors,
    scale_gradient,
    scale_penalty,
    training_of,
    variance_factors,
    vjp_with_dropout,
)
from ipo.distributions import Categorical
from ipo.networks import DenseNetwork

SIZES = [3, 5, 2]


def normal(*shape: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def means(x: Tensor) -> Tensor:
    """Of domains, by hand."""
    return torch.stack([x[:, :3].mean(1), x[:, 3:8].mean(1), x[:, 8:].mean(1)], 1)


def test_factors_are_the_gradient_of_mean_less_variance():
    returns = normal(2, 10).requires_grad_()
    J = means(returns).mean(1) - 0.7 * means(returns).var(1, unbiased=False)
    (whole,) = torch.autograd.grad(J.sum(), returns)
    (of_means,) = torch.autograd.grad(means(returns).mean(1).sum(), returns)
    factors = variance_factors(returns.detach(), SIZES, 0.7)
    assert_close(factors * of_means, whole)


def test_without_a_penalty_all_frames_count_alike():
    assert (variance_factors(normal(2, 10), SIZES, 0.0) == 1).all()


def test_factors_are_the_gradient_of_the_squared_slopes():
    """penalty * mean_d (d R_d / d w)^2 at w = 1, differentiated twice by torch."""
    sizes, logits = [4, 4], normal(2, 8, 5).requires_grad_()
    actions, gains = normal(2, 8, 5, seed=1).argmax(-1), normal(2, 8, seed=2)
    old = Categorical.log_probability(logits, actions).detach()
    w = torch.ones(2, 1, 1, dtype=torch.float64, requires_grad=True)
    ratio = (Categorical.log_probability(w * logits, actions) - old).exp()
    returns = torch.stack([part.mean(1) for part in (ratio * gains).split(sizes, 1)], 1)
    slopes = [torch.autograd.grad(R.sum(), w, create_graph=True)[0] for R in returns.unbind(1)]
    penalty = 0.3 * torch.stack([slope.flatten() for slope in slopes], 1).square().mean(1)
    (expected,) = torch.autograd.grad(penalty.sum(), logits)

    plain = logits.detach()
    slope = old + Categorical.entropy(plain)
    factors = scale_factors(slope, gains, sizes, 0.3)
    weights = factors * gains * (slope + 1) / 8
    entropy_weight = (factors * gains / 8).unsqueeze(-1)
    assert_close(Categorical.gradient(plain, actions, weights, entropy_weight), expected)


def test_gradient_of_the_penalty_is_that_of_torch():
    """On frames of which many are clipped."""
    logits, values, gains = normal(2, 400, 3), normal(2, 400, seed=1), normal(2, 400, seed=2)
    actions = normal(2, 400, 3, seed=3).argmax(-1)
    old = Categorical.log_probability(logits, actions) + 0.3 * normal(2, 400, seed=4)
    batch = Penalized(values, actions, old, values, gains, values, normal(2, 400, seed=5))
    settings, leaf = RegularizedSettings("ppo"), logits.clone().requires_grad_()
    penalty = scale_penalty(Categorical, leaf, batch, settings)
    (expected,) = torch.autograd.grad(penalty.sum(), leaf)
    assert_close(scale_gradient(Categorical, logits, batch, settings), expected)


def test_nothing_is_to_be_scaled_where_actions_are_as_good_as_each_other():
    zero = torch.zeros(2, 10, dtype=torch.float64)
    assert not scale_factors(normal(2, 10), zero, SIZES, 1.0).any()


# ------------------------------------------------------------------------------ dropout

NETWORKS = {
    "grid": (DoubleNetwork(), normal(2, 6, 7, 7, 3)),
    "dense": (DenseNetwork(4, 3, Categorical, hidden=(8, 8)), normal(2, 6, 4).float()),
}


@pytest.mark.parametrize("name", NETWORKS)
def test_gradient_of_a_thinned_network_is_that_of_torch(name):
    network, seen = NETWORKS[name]
    weights = network.start([np.random.default_rng(run) for run in range(2)])
    factors = dropout_factors(network, weights, 0.4, [np.random.default_rng(run) for run in (5, 6)])
    leaves = {name: w.clone().requires_grad_() for name, w in weights.items()}
    thinned = {name: w * factors[name] if name in factors else w for name, w in leaves.items()}
    outputs = network(thinned, seen)
    slopes = [torch.ones_like(outputs[0]).cumsum(-1), torch.ones_like(outputs[1])]
    expected = torch.autograd.grad(outputs, list(leaves.values()), slopes)
    ours, pull_back = vjp_with_dropout(network, weights, seen, factors)
    rtol = 1e-9 if name == "grid" else 1e-5
    for found, torchs in zip((*ours, *pull_back(*slopes)), (*outputs, *expected), strict=True):
        assert_close(found, torchs.detach(), rtol)


def test_dropout_leaves_out_a_share_of_the_inputs_above_phi_and_keeps_the_mean():
    network = DoubleNetwork()
    weights = network.start([np.random.default_rng(0)])
    rng = np.random.default_rng(1)
    drawn = [dropout_factors(network, weights, 0.25, [rng]) for _ in range(300)]
    assert set(drawn[0]) == {f"{part}{i}.weight" for part in ("actor", "critic") for i in (1, 2)}
    values = torch.cat([factor.flatten() for factors in drawn for factor in factors.values()])
    assert {round(v, 6) for v in values.unique().tolist()} == {0, round(1 / 0.75, 6)}
    assert float(values.mean()) == pytest.approx(1, abs=0.02)  # 77,000 draws: 9 standard errors


@pytest.mark.parametrize(
    ("method", "changes", "error"),
    [
        ("ipo", {"variance_penalty": 1.0}, "variance_penalty = 1.0: needs players of several"),
        ("ppo", {"scale_penalty": 1.0}, "scale_penalty = 1.0: needs actions to choose from"),
        ("ppo", {"dropout": 0.5}, "dropout = 0.5: needs a network that has a phi"),
    ],
)
def test_what_a_network_or_a_method_does_not_have_is_refused(method, changes, error):
    def never(*_: object) -> None:
        raise AssertionError("nothing must be made")

    network = DenseNetwork(3, 2, hidden=())  # of a Gaussian, without a first part
    with pytest.raises(ValueError, match=error):
        training_of(network, never, 2, RegularizedSettings(method, num_envs=4, **changes), [0])
