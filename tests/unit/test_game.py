"""The game: average, rounds of best responses and Nash gap, on a game that is solved by hand.

Player d wants the average p = (x_1 + x_2) / 2 at its target t_d: J_d = (p - t_d)^2 / 2.
"""

import pytest
import torch
from small import assert_close, general_problem, paper_problem, random_gain

from ipo.game import average, best_response_round, nash_gap, new_players, split_players
from ipo.lqr import invariant_gain, riccati_gain, training_costs

TARGETS = (1.0, 3.0)


@pytest.fixture
def weights() -> torch.Tensor:
    """Of two players in one run, at zero."""
    return new_players(1, 2, [1], dtype=torch.float64)


def gradient_step(player: torch.Tensor, objective, learning_rate: float = 1.0) -> None:
    (gradient,) = torch.autograd.grad(objective(), player)
    player.data -= learning_rate * gradient


def test_players_step_in_order_and_feel_their_share(weights):
    """dJ_d/dx_d = (p - t_d) / 2. Player 1: 0 + 1/2; then p = 1/4 and player 2: 0 + 11/8."""
    players, policy = split_players(weights), average(weights)

    def respond(d, policy_of_d):
        gradient_step(players[d], lambda: 0.5 * (policy_of_d() - TARGETS[d]).square().sum())

    best_response_round(players, policy, respond)
    assert weights.flatten().tolist() == [0.5, 1.375]
    assert policy.tolist() == [[0.9375]]


def test_best_responses_end_where_the_last_player_wants_the_average(weights):
    players, policy = split_players(weights), average(weights)

    def respond(d, policy_of_d):
        players[d].data += 2 * (TARGETS[d] - policy_of_d().detach())

    best_response_round(players, policy, respond)
    assert weights.flatten().tolist() == [2.0, 4.0]  # first p = 1, then p = 3
    assert policy.tolist() == [[3.0]]


def test_a_player_sees_the_average_of_its_present_weights(weights):
    players, policy = split_players(weights), average(weights)
    seen = []

    def respond(d, policy_of_d):
        for move in (0.0, 1.0):
            players[d].data += move
            seen.append(policy_of_d().item())

    best_response_round(players, policy, respond)
    assert seen == [0.0, 0.5, 0.5, 1.0]


def test_policy_is_updated_in_place_to_the_average_of_the_players():
    weights = new_players(3, 4, [2, 5], dtype=torch.float64)
    weights += torch.randn(3, 4, 2, 5, generator=torch.Generator().manual_seed(0)).double()
    players, policy = split_players(weights), average(weights)
    place, before = policy.data_ptr(), policy.clone()

    def respond(d, policy_of_d):
        gradient_step(players[d], lambda: (policy_of_d() - d).square().sum())

    best_response_round(players, policy, respond)
    assert not torch.allclose(policy, before)
    assert_close(policy, average(weights), rtol=1e-14)
    assert policy.data_ptr() == place


def test_average_is_over_players():
    assert average(torch.tensor([[[1.0, 2.0], [3.0, 6.0]]])).tolist() == [[2.0, 4.0]]


def test_new_players_are_zero_and_each_contiguous():
    weights = new_players(2, 3, [4, 5], dtype=torch.float64)
    assert weights.shape == (2, 3, 4, 5)
    assert weights.dtype == torch.float64
    assert not weights.any()
    assert all(player.is_contiguous() for player in weights.unbind(1))


def test_split_players_are_leaves_that_share_memory():
    weights = new_players(2, 3, [4])
    players = split_players(weights)
    assert [tuple(player.shape) for player in players] == [(2, 4)] * 3
    assert all(player.is_leaf and player.requires_grad for player in players)
    players[1].data += 1
    assert weights[:, 1].eq(1).all() and not weights[:, [0, 2]].any()


def test_nash_gap_is_the_largest_gain_of_a_single_player():
    costs, best_costs = torch.tensor([[1.0, 5.0], [2.0, 2.0]]), torch.tensor([[1.0, 4.0], [0, 2.0]])
    assert nash_gap(costs, best_costs).tolist() == [1.0, 2.0]


def test_nash_gap_is_zero_where_nobody_can_gain():
    problem = paper_problem()
    costs = training_costs(invariant_gain(problem), problem)
    assert nash_gap(costs, riccati_gain(problem)[1][:, None]).abs().max() < 1e-9


def test_nash_gap_is_positive_elsewhere():
    problem = general_problem()
    costs = training_costs(random_gain(problem), problem)
    assert (nash_gap(costs, riccati_gain(problem)[1][:, None]) > 0.01).all()
