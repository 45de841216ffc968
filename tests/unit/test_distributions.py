"""Distributions of actions: against SciPy, by hand, and what averaging players means for them."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm
from small import assert_close
from torch import Tensor

from experiments.policies import load_policy, save_policy
from ipo.dense_in_numpy import DenseInNumpy
from ipo.distributions import Categorical, Gaussian
from ipo.networks import DenseNetwork


def generators(*seeds: int) -> list[np.random.Generator]:
    return [np.random.default_rng(seed) for seed in seeds]


def gaussian(seed: int = 0, num_runs: int = 2, num_rows: int = 5, num_actions: int = 3) -> Tensor:
    random = np.random.default_rng(seed)
    mean = random.normal(size=(num_runs, num_rows, num_actions))
    deviation = random.uniform(0.1, 3, mean.shape)
    return torch.tensor(np.concatenate([mean, deviation], -1))


@given(seed=st.integers(0, 10**6), num_actions=st.integers(1, 6))
def test_gaussian_density_and_entropy_are_scipys(seed, num_actions):
    parameters = gaussian(seed, num_actions=num_actions)
    mean, deviation = parameters.chunk(2, -1)
    actions = Gaussian.sample(parameters, generators(1, 2))
    density = norm.logpdf(actions, mean, deviation).sum(-1)
    np.testing.assert_allclose(Gaussian.log_probability(parameters, actions), density)
    np.testing.assert_allclose(Gaussian.entropy(parameters), norm.entropy(mean, deviation).sum(-1))
    assert torch.equal(Gaussian.mode(parameters), mean)


def test_gaussian_samples_have_the_mean_and_the_deviation():
    parameters = gaussian(num_rows=1).expand(2, 20_000, 6)
    mean, deviation = parameters[:, 0].chunk(2, -1)
    actions = Gaussian.sample(parameters, generators(1, 2))
    assert ((actions.mean(1) - mean).abs() < 5 * deviation / math.sqrt(20_000)).all()
    torch.testing.assert_close(actions.std(1), deviation, rtol=0.03, atol=0)


def test_each_run_draws_from_its_own_generator():
    parameters = gaussian(num_rows=4)
    together = Gaussian.sample(parameters, generators(1, 2))
    alone = Gaussian.sample(parameters[1:], generators(2))
    assert torch.equal(together[1:], alone)


def test_categorical_probabilities_are_a_softmax():
    logits = torch.tensor([[[0.0, math.log(3.0)], [5.0, 5.0]]], dtype=torch.float64)
    actions = torch.tensor([[1, 0]])
    expected = torch.tensor([[math.log(0.75), math.log(0.5)]], dtype=torch.float64)
    torch.testing.assert_close(Categorical.log_probability(logits, actions), expected)
    entropy = -0.75 * math.log(0.75) - 0.25 * math.log(0.25)
    torch.testing.assert_close(float(Categorical.entropy(logits)[0, 0]), entropy)
    assert Categorical.mode(logits)[0, 0] == 1


def test_categorical_samples_are_as_frequent_as_they_should_be():
    logits = torch.tensor([[0.0, math.log(3.0), math.log(4.0)]]).expand(1, 20_000, 3)
    actions = Categorical.sample(logits, generators(0))
    frequency = torch.bincount(actions[0]) / 20_000
    torch.testing.assert_close(frequency, torch.tensor([0.125, 0.375, 0.5]), rtol=0, atol=0.02)


# ------------------------------------------------------------------ the network for vectors


@pytest.mark.parametrize("kind", [DenseNetwork, DenseInNumpy])
def test_players_are_averaged_in_means_and_deviations_not_in_their_logarithms(kind):
    network = kind(4, 2)
    players = [network.start(generators(d)) for d in range(2)]
    players[0]["log_std"][:] = 0.0
    players[1]["log_std"][:] = math.log(3.0)
    observations = torch.randn(1, 7, 4, generator=torch.Generator().manual_seed(0))
    parameters, values = network.frozen(players)(observations)
    outputs = [network(player, observations) for player in players]
    expected = (outputs[0][0] + outputs[1][0]) / 2
    torch.testing.assert_close(parameters, expected)
    torch.testing.assert_close(parameters[..., 2:], torch.full((1, 7, 2), 2.0))
    torch.testing.assert_close(values, (outputs[0][1] + outputs[1][1]) / 2)


def test_the_network_starts_with_orthogonal_weights():
    network = DenseNetwork(15, 6)
    weights = network.start(generators(0, 1))
    assert {name: tuple(w.shape[1:]) for name, w in weights.items()} == network.weight_shapes
    for layer, gain in (("actor1", 2), ("actor2", 2), ("actor3", 1), ("critic3", 2)):
        matrix = weights[f"{layer}.weight"].double()
        small = matrix @ matrix.mT if matrix.shape[1] <= matrix.shape[2] else matrix.mT @ matrix
        torch.testing.assert_close(
            small, gain * torch.eye(small.shape[1]).double().expand_as(small)
        )
    assert not weights["log_std"].any()
    assert not torch.equal(weights["actor1.weight"][0], weights["actor1.weight"][1])


@pytest.mark.parametrize("distribution", [Gaussian, Categorical])
def test_the_networks_gradient_is_right(distribution):
    network = DenseNetwork(3, 2, distribution, hidden=(4,))
    weights = {name: w.double() for name, w in network.start(generators(0)).items()}
    observations = torch.randn(
        1, 5, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    names = list(weights)

    def outputs(*tensors: Tensor) -> tuple[Tensor, Tensor]:
        return network(dict(zip(names, tensors, strict=True)), observations)

    leaves = tuple(w.requires_grad_() for w in weights.values())
    assert torch.autograd.gradcheck(outputs, leaves)


@pytest.mark.parametrize("distribution", [Gaussian, Categorical])
@pytest.mark.parametrize("hidden", [(), (4,), (4, 3)])
@pytest.mark.parametrize("dtype, rtol", [(torch.float64, 1e-12), (torch.float32, 1e-5)])
def test_the_gradient_by_hand_is_that_of_torch(distribution, hidden, dtype, rtol):
    network, of_torch = (kind(3, 2, distribution, hidden) for kind in (DenseInNumpy, DenseNetwork))
    weights = {name: w.to(dtype) for name, w in network.start(generators(0, 1)).items()}
    generator = torch.Generator().manual_seed(0)
    for weight in weights.values():  # no number is 0 by chance
        weight += 0.5 * torch.randn(weight.shape, generator=generator)
    observations = torch.randn(2, 7, 3, generator=generator, dtype=dtype)
    outputs, pull_back = network.vjp(weights, observations)
    expected, torchs_pull_back = of_torch.vjp(weights, observations)
    slopes = [torch.randn(x.shape, generator=generator, dtype=dtype) for x in outputs]
    found = [*outputs, *pull_back(*slopes)]
    for ours, theirs in zip(found, [*expected, *torchs_pull_back(*slopes)], strict=True):
        assert ours.shape == theirs.shape and theirs.any()
        assert_close(ours, theirs, rtol)


def test_a_saved_policy_comes_back(tmp_path):
    network = DenseNetwork(15, 6)
    players = [network.start(generators(d)) for d in range(2)]
    save_policy(tmp_path / "p.safetensors", players, {"seed": 0})
    loaded, about = load_policy(tmp_path / "p.safetensors", network, {"seed": 0})
    assert about == {"seed": 0}
    assert all(torch.equal(loaded[d][n], w) for d in range(2) for n, w in players[d].items())


@pytest.mark.parametrize(
    "other", [DenseNetwork(14, 6), DenseNetwork(15, 5), DenseNetwork(15, 6, hidden=(64,))]
)
def test_weights_of_another_network_are_refused(tmp_path, other):
    network = DenseNetwork(15, 6)
    save_policy(tmp_path / "p.safetensors", [other.start(generators(0))], {})
    with pytest.raises(ValueError, match=r"of player 0 has shape .*, needs"):
        load_policy(tmp_path / "p.safetensors", network)


@pytest.mark.parametrize(
    "change", [{"num_observations": 0}, {"num_actions": -1}, {"hidden": (64, 0)}]
)
def test_a_network_of_impossible_size_is_refused(change):
    with pytest.raises(ValueError, match=f"{next(iter(change))}.* = .*must be at least 1"):
        DenseNetwork(**({"num_observations": 15, "num_actions": 6} | change))
