"""The drawing of a network has its layers as nodes, and its edges say what depends on what."""

import networkx
import numpy as np
import pytest
import torch

from experiments.figures import network_graph
from ipo.distributions import Categorical
from ipo.networks import DenseNetwork
from ipo.worlds.networks import GridNetwork

NETWORKS = {
    "grid": (GridNetwork(), (1, 2, 7, 7, 3)),
    "dense": (DenseNetwork(4, 2, Categorical), (1, 2, 4)),
}


@pytest.mark.parametrize("name", NETWORKS)
def test_nodes_are_the_layers_in_order_of_computation(name):
    network, _ = NETWORKS[name]
    nodes, edges = network_graph(network)
    assert set(nodes) == {"observation", "scores", "value", *network.shapes}
    assert all(nodes[start][0] < nodes[end][0] for start, end in edges)
    assert len(edges) == len(nodes) - 1  # a tree
    assert len(set(nodes.values())) == len(nodes)


@pytest.mark.parametrize("name", NETWORKS)
def test_edges_agree_with_what_the_network_computes(name):
    """Doubling the weights of a layer changes exactly the outputs that it leads to."""
    network, shape = NETWORKS[name]
    graph = networkx.DiGraph(network_graph(network)[1])
    weights = network.start([np.random.default_rng(0)])
    observation = torch.rand(shape, generator=torch.Generator().manual_seed(0))
    scores, values = network(weights, observation)
    for layer in network.shapes:
        changed = weights | {f"{layer}.weight": 2 * weights[f"{layer}.weight"]}
        new_scores, new_values = network(changed, observation)
        reached = networkx.descendants(graph, layer)
        assert (not torch.equal(scores, new_scores)) == ("scores" in reached), layer
        assert (not torch.equal(values, new_values)) == ("value" in reached), layer
