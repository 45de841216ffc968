"""The grid network against torch.nn, the average by hand, tables, and files of weights."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from plain_ppo import ActorCritic
from small import DoubleNetwork, assert_close, plain_network
from torch import Tensor

from experiments.policies import load_policy, save_policy
from ipo.distributions import Categorical
from ipo.network_players import in_one_row
from ipo.networks import DenseNetwork, Network, Weights, copied
from ipo.worlds.networks import DenseOnTable, GridNetwork, OnTable


def generators(*seeds: int) -> list[np.random.Generator]:
    return [np.random.default_rng(seed) for seed in seeds]


def random_images(*shape: int, seed: int = 0) -> Tensor:
    """Codes as MiniGrid has them, from 0 to 10."""
    return torch.tensor(np.random.default_rng(seed).integers(0, 11, size=(*shape, 7, 7, 3)))


def constant_player(logits: list[float], value: float) -> Weights:
    """A player who answers the same to everything."""
    player = GridNetwork(num_actions=len(logits)).start(generators(0))
    player = {name: torch.zeros_like(weight) for name, weight in player.items()}
    player["actor2.bias"][:] = torch.tensor(logits)
    player["critic2.bias"][:] = value
    return player


# ------------------------------------------------------------------- the grid network


def test_a_wider_network_has_twice_as_many_weights():
    """A player alone that is as large as two; with one width, the published layers."""

    def count(width: float) -> int:
        return sum(math.prod(shape) for shape in GridNetwork(width=width).weight_shapes.values())

    assert count(1) == 19_384
    assert count(math.sqrt(2)) == pytest.approx(2 * count(1), rel=0.01)


@given(
    seed=st.integers(0, 1000),
    num_channels=st.integers(1, 8),
    num_actions=st.integers(1, 7),
    num_runs=st.integers(1, 3),
    num_images=st.integers(1, 5),
)
def test_network_is_that_of_torch(seed, num_channels, num_actions, num_runs, num_images):
    network = DoubleNetwork(num_channels, num_actions)
    weights = network.start(generators(*range(seed, seed + num_runs)))
    for name in ("actor1.bias", "actor2.bias", "critic1.bias", "critic2.bias"):  # zero at first
        weights[name] = torch.tensor(np.random.default_rng(seed).normal(size=weights[name].shape))
    shape = num_runs, num_images, 7, 7, num_channels
    images = torch.tensor(np.random.default_rng(seed).normal(size=shape))
    logits, values = network(weights, images)
    for run in range(num_runs):
        expected_logits, expected_values = plain_network(weights, run)(images[run])
        assert_close(logits[run], expected_logits.detach())
        assert_close(values[run], expected_values.detach())


def test_gradient_is_that_of_torch():
    network = DoubleNetwork()
    weights = {name: w.requires_grad_() for name, w in network.start(generators(0, 1)).items()}
    images = random_images(2, 6)
    logits, values = network(weights, images)
    (logits.square().sum() + values.square().sum()).backward()
    for run in range(2):
        plain = plain_network(weights, run)
        logits, values = plain(images[run].double())
        (logits.square().sum() + values.square().sum()).backward()
        grads = [w.grad for w in plain.actor[0].parameters()]
        assert_close(weights["actor1.weight"].grad[run].T, grads[0])
        assert_close(weights["actor1.bias"].grad[run], grads[1])
        first = plain.convolutions[0].weight.grad.permute(2, 3, 1, 0).flatten(0, 2)
        assert_close(weights["conv1.weight"].grad[run], first)


def test_weights_in_one_row_change_together():
    weights = GridNetwork().start(generators(0, 1))
    row, parts = in_one_row(weights)
    assert all(torch.equal(parts[name], weight) for name, weight in weights.items())
    row.zero_()
    assert len(row) == 2 and not any(part.any() for part in parts.values())


def test_single_precision_is_near_double_precision():
    single = GridNetwork().start(generators(0))
    double = {name: weight.double() for name, weight in single.items()}
    images = random_images(1, 50)
    for near, exact in zip(
        GridNetwork()(single, images.float()), GridNetwork()(double, images.double()), strict=True
    ):
        assert_close(near.double(), exact, rtol=1e-5)


def test_start_is_that_of_the_published_runs():
    weights = GridNetwork().start(generators(*range(20)))
    for name in ("conv1", "conv2", "conv3"):
        matrix, bias = weights[f"{name}.weight"], weights[f"{name}.bias"]
        bound = 1 / math.sqrt(matrix.shape[1])
        for drawn in (matrix, bias):
            assert -bound <= drawn.min() < -0.95 * bound
            assert 0.95 * bound < drawn.max() <= bound
        assert float(matrix.std()) == pytest.approx(bound / math.sqrt(3), rel=0.05)
    for name in ("actor1", "actor2", "critic1", "critic2"):
        matrix = weights[f"{name}.weight"]
        assert torch.allclose(matrix.norm(dim=1), torch.ones(20, matrix.shape[2]))
        assert abs(float(matrix.mean())) < 0.01
        assert not weights[f"{name}.bias"].any()


def test_runs_start_each_from_their_own_generator():
    together = GridNetwork().start(generators(0, 1, 2))
    for run in range(3):
        for name, weight in GridNetwork().start(generators(run)).items():
            assert torch.equal(together[name][run], weight[0])
    assert not torch.equal(together["conv1.weight"][0], together["conv1.weight"][1])


def test_size_of_the_network():
    """Convolutions with 208 + 2080 + 8256 weights, actor with 4615, critic with 4225."""
    weights = GridNetwork().start(generators(0))
    assert sum(weight.numel() for weight in weights.values()) == 19384
    assert sum(weight.numel() for weight in ActorCritic().parameters()) == 19384


# ------------------------------------------------------------------------- the average


def test_logits_are_averaged_before_the_softmax():
    """By hand: logits (log 8, 0) and (0, 0) give odds of sqrt(8) : 1; values 3 and 5 give 4."""
    players = [constant_player([math.log(8), 0.0], 3), constant_player([0.0, 0.0], 5)]
    policy = GridNetwork(num_actions=2).frozen(players)
    logits, values = policy(random_images(1, 3).float())
    probability = math.sqrt(8) / (math.sqrt(8) + 1)
    average_of_probabilities = (8 / 9 + 1 / 2) / 2
    assert abs(probability - average_of_probabilities) > 0.04  # so it is clear which one it is
    expected = torch.tensor([[[probability, 1 - probability]] * 3])
    assert_close(logits.softmax(-1), expected, rtol=1e-6)
    assert_close(values, [[4.0] * 3], rtol=1e-6)


@pytest.mark.parametrize("num_players", [1, 2, 3, 5])
def test_average_is_the_mean_of_all_players(num_players):
    network = DoubleNetwork()
    players = [network.start(generators(d, 10 + d)) for d in range(num_players)]
    images = random_images(2, 4)
    logits, values = network.frozen(players)(images)
    for run in range(2):
        each = [plain_network(player, run)(images[run].double()) for player in players]
        assert_close(logits[run], sum(out[0] for out in each).detach() / num_players)
        assert_close(values[run], sum(out[1] for out in each).detach() / num_players)


def test_order_of_players_does_not_matter():
    network = DoubleNetwork()
    players = [network.start(generators(d)) for d in range(3)]
    images = random_images(1, 4)
    for ours, theirs in zip(
        network.frozen(players)(images), network.frozen(players[::-1])(images), strict=True
    ):
        assert_close(ours, theirs, rtol=1e-14)


def test_frozen_average_has_no_gradient():
    network = GridNetwork()
    players = [
        {name: w.requires_grad_() for name, w in network.start(generators(d)).items()}
        for d in range(2)
    ]
    outputs = network.frozen(players)(random_images(1, 2).float())
    assert not any(output.requires_grad for output in outputs)


# ------------------------------------------------------------------------------ tables


def indices_of(num_runs: int, num_frames: int, num_rows: int, seed: int) -> Tensor:
    return torch.tensor(
        np.random.default_rng(seed).integers(0, num_rows, size=(num_runs, num_frames))
    )


@given(
    seed=st.integers(0, 1000),
    num_runs=st.integers(1, 3),
    num_frames=st.integers(1, 40),
    num_rows=st.integers(1, 20),
)
def test_table_gives_what_its_images_give(seed, num_runs, num_frames, num_rows):
    network, table = DoubleNetwork(), random_images(num_rows, seed=seed).double()
    weights = network.start(generators(*range(num_runs)))
    indices = indices_of(num_runs, num_frames, num_rows, seed)
    on_table = OnTable(network, table)
    direct = network(weights, table[indices])
    frozen = on_table.frozen([weights, network.start(generators(*range(5, 5 + num_runs)))])
    average = network.frozen([weights, network.start(generators(*range(5, 5 + num_runs)))])
    for ours, theirs in [
        *zip(on_table(weights, indices), direct, strict=True),
        *zip(frozen(indices), average(table[indices]), strict=True),
    ]:
        assert_close(ours, theirs)


def test_gradient_through_a_table_counts_every_occurrence():
    network, table = DoubleNetwork(), random_images(5).double()
    indices = torch.tensor([[0, 0, 3, 0], [1, 2, 3, 4]])  # runs differ in how many are distinct
    gradients = []
    for evaluate in (OnTable(network, table), lambda w, i: network(w, table[i])):
        weights = {name: w.requires_grad_() for name, w in network.start(generators(0, 1)).items()}
        logits, values = evaluate(weights, indices)
        (logits.square().sum() + values.sum()).backward()
        gradients.append([weight.grad for weight in weights.values()])
    for ours, theirs in zip(*gradients, strict=True):
        assert_close(ours, theirs)


@pytest.mark.parametrize("num_rows", [1, 256, 257, 600])
def test_average_of_a_whole_table(num_rows):
    network, table = DoubleNetwork(), random_images(num_rows).double()
    players = [network.start(generators(0, 1)), network.start(generators(2, 3))]
    logits, values = OnTable(network, table).average(players)
    assert logits.shape == (2, num_rows, 7) and values.shape == (2, num_rows)
    expected = network.frozen(players)(table.expand(2, *table.shape))
    assert_close(logits, expected[0])
    assert_close(values, expected[1])


def test_dense_network_on_a_table_is_that_network():
    table = torch.tensor(np.random.default_rng(0).normal(size=(6, 4))).float()
    indices = torch.tensor([[5, 0, 0, 3], [1, 2, 5, 5]])
    dense, on_table = DenseNetwork(4, 3, Categorical, (5,)), DenseOnTable(table, 3, (5,))
    players = [dense.start(generators(0, 1)), dense.start(generators(2, 3))]
    slopes = torch.ones(2, 4, 3), torch.ones(2, 4)
    (seen, pull_back), (expected, pull_back_there) = (
        on_table.vjp(players[0], indices),
        dense.vjp(players[0], table[indices]),
    )
    there = on_table(players[0], indices)
    acting, average = on_table.frozen(players)(indices), dense.frozen(players)(table[indices])
    for ours, theirs in [
        *zip(seen, expected, strict=True),
        *zip(there, expected, strict=True),
        *zip(acting, average, strict=True),
        *zip(pull_back(*slopes), pull_back_there(*slopes), strict=True),
    ]:
        torch.testing.assert_close(ours, theirs)


def test_frozen_table_keeps_the_players_as_they_were():
    network = GridNetwork()
    player, indices = network.start(generators(0)), torch.tensor([[0, 1, 2]])
    policy = OnTable(network, random_images(3).float()).frozen([player])
    before = policy(indices)[0].clone()
    player["actor2.bias"] += 1
    assert torch.equal(policy(indices)[0], before)


def test_copies_do_not_change_with_the_players():
    player = {n: w.requires_grad_() for n, w in GridNetwork().start(generators(0)).items()}
    (kept,) = copied([player])
    with torch.no_grad():
        player["actor2.bias"] += 1
    assert not kept["actor2.bias"].any() and not kept["actor2.bias"].requires_grad


def test_a_network_without_weights_or_outputs_cannot_be_made():
    class Half(Network):
        def _draw(self, generator):
            return {}

    with pytest.raises(TypeError, match="abstract"):
        Half()


# ------------------------------------------------------------------------------- files


@pytest.mark.parametrize(("num_players", "num_channels"), [(1, 3), (2, 8), (3, 2)])
def test_saved_policy_comes_back(tmp_path, num_players, num_channels):
    network = GridNetwork(num_channels)
    players = [network.start(generators(d, d + 9)) for d in range(num_players)]
    about = {"cell": "ppo_red", "seeds": [0, 1]}
    path = tmp_path / "new" / "policy.safetensors"
    save_policy(path, players, about)
    assert list(path.parent.iterdir()) == [path]
    loaded, found = load_policy(path, network, {"cell": "ppo_red"})
    assert found == about
    assert len(loaded) == num_players
    for ours, theirs in zip(loaded, players, strict=True):
        assert ours.keys() == theirs.keys()
        assert all(torch.equal(ours[name], theirs[name]) for name in theirs)


def test_saving_again_replaces_the_policy_of_the_same_cell_alone(tmp_path):
    network, path = GridNetwork(), tmp_path / "policy.safetensors"
    first, second = network.start(generators(0)), network.start(generators(1))
    save_policy(path, [first, second], {"cell": "a"}, {"minutes": 1})
    save_policy(path, [second], {"cell": "a"}, {"minutes": 2})
    with pytest.raises(ValueError, match="was made for something else: cell = 'a', asked for 'b'"):
        save_policy(path, [first], {"cell": "b"})
    (loaded,), about = load_policy(path, network)
    assert about == {"cell": "a", "minutes": 2}
    assert torch.equal(loaded["conv1.weight"], second["conv1.weight"])


def test_weights_in_training_can_be_saved(tmp_path):
    player = {n: w.requires_grad_() for n, w in GridNetwork().start(generators(0)).items()}
    save_policy(tmp_path / "policy.safetensors", [player], {})
    (loaded,), _ = load_policy(tmp_path / "policy.safetensors", GridNetwork())
    assert not any(weight.requires_grad for weight in loaded.values())
