"""The game: ownership, rounds, average and Nash gap, on a game that is solved by hand.

Player d wants the average p = (x_1 + x_2) / 2 at its target t_d: J_d = (p - t_d)^2 / 2.
"""

from functools import partial

import pytest
import torch
from small import assert_close, general_problem, paper_problem, random_gain

from ipo.game import LinearPlayers, average, moves, nash_gap, play_round
from ipo.lqr import invariant_gain, riccati_gain, training_costs
from ipo.optimizers import make_optimizer

TARGETS = (1.0, 3.0)
COSTS = [lambda p, target=target: 0.5 * (p - target).square().sum(1) for target in TARGETS]


def plain(learning_rate: float = 1.0):
    return partial(make_optimizer, "plain", learning_rate=learning_rate)


def players_at_zero(learning_rate: float = 1.0, **options) -> LinearPlayers:
    """Two players in one run, each with plain steps."""
    return LinearPlayers(torch.zeros(1, 2, 1).double(), plain(learning_rate), **options)


# -------------------------------------------------------------------------------- ownership


@pytest.mark.parametrize(
    ("method", "expected"),
    [
        ("pooled", [(0, [0, 1, 2])]),
        ("ipo", [(0, [0]), (1, [1]), (2, [2])]),
        ("ensemble", [(0, [0, 1, 2]), (1, [0, 1, 2]), (2, [0, 1, 2])]),
        ("in_turn", [(0, [0]), (0, [1]), (0, [2])]),
    ],
)
def test_who_moves_on_which_domains(method, expected):
    assert moves(method, 3) == expected


@pytest.mark.parametrize(
    ("method", "num_domains", "message"),
    [("poled", 2, "method = 'poled'.*did you mean 'pooled'"), ("ipo", 0, "num_domains = 0: must")],
)
def test_a_game_that_does_not_exist(method, num_domains, message):
    with pytest.raises(ValueError, match=message):
        moves(method, num_domains)


# ----------------------------------------------------------------------------------- rounds


@pytest.mark.parametrize(
    ("num_inner_rounds", "phi", "expected"),
    [(1, False, "012"), (1, True, "p012"), (2, True, "p012012")],
)
def test_order_of_the_moves_in_a_round(num_inner_rounds, phi, expected):
    made = []
    move_phi = partial(made.append, "p") if phi else None
    play_round(3, lambda d: made.append(str(d)), num_inner_rounds, move_phi)
    assert "".join(made) == expected


def test_players_step_in_order_and_feel_their_share():
    """dJ_d/dx_d = (p - t_d) / 2. Player 1: 0 + 1/2; then p = 1/4 and player 2: 0 + 11/8."""
    players = players_at_zero()
    players.round(COSTS)
    assert players.weights.flatten().tolist() == [0.5, 1.375]
    assert players.policy.tolist() == [[0.9375]]


def test_players_who_move_together_see_the_same_average():
    players = players_at_zero(order="together")
    players.round(COSTS)
    assert players.weights.flatten().tolist() == [0.5, 1.5]
    assert players.policy.tolist() == [[1.0]]


@pytest.mark.parametrize("order", ["in_turn", "together"])
def test_inner_rounds_are_rounds_above_the_same_phi(order):
    once, twice, seen = players_at_zero(order=order), players_at_zero(order=order), []
    once.round(COSTS, num_inner_rounds=2, move_phi=lambda: seen.append(once.policy.item()))
    for _ in range(2):
        twice.round(COSTS)
    assert torch.equal(once.weights, twice.weights)
    assert torch.equal(once.policy, twice.policy)
    assert seen == [0.0]


def test_steps_that_solve_end_where_the_last_player_wants_the_average():
    """d^2 J_d / dx_d^2 = 1/4: with a learning rate of 4 a step is the best response."""
    players = players_at_zero(learning_rate=4.0)
    players.round(COSTS)
    assert players.weights.flatten().tolist() == [2.0, 4.0]  # first p = 1, then p = 3
    assert players.policy.tolist() == [[3.0]]


def test_a_player_sees_the_average_of_its_present_weights():
    """L-BFGS tries several weights in a step; each trial is seen with the others' old ones."""
    players, seen = players_at_zero(), []

    def recorded(p: torch.Tensor) -> torch.Tensor:
        seen.append((p.item(), [player.item() for player in players.players]))
        return COSTS[0](p)

    players.optimizers[0] = make_optimizer("lbfgs", players.players[:1], 1.0)
    players.round([recorded, COSTS[1]])
    assert len(seen) > 1
    assert seen[-1][1][0] != 0
    assert all(p == sum(weights) / 2 for p, weights in seen)


@pytest.mark.parametrize("order", ["in_turn", "together"])
def test_policy_is_updated_in_place_to_the_average_of_the_players(order):
    starts = torch.randn(3, 4, 2, 5, generator=torch.Generator().manual_seed(0)).double()
    players = LinearPlayers(starts, plain(0.1), order=order)
    place, before = players.policy.data_ptr(), players.policy.clone()
    players.round([lambda p, d=d: (p - d).square().sum((1, 2)) for d in range(4)])
    assert not torch.allclose(players.policy, before)
    assert_close(players.policy, average(players.weights), rtol=1e-14)
    assert players.policy.data_ptr() == place


def test_bounded_players_are_put_back():
    players = players_at_zero(learning_rate=100.0, bound=0.5)
    players.round([COSTS[0], lambda p: COSTS[1](-p)])
    assert players.weights.flatten().tolist() == [0.5, -0.5]
    assert players.policy.tolist() == [[0.0]]


def test_gradients_are_clipped():
    """Player 1's gradient is -1/2 and stays; player 2's is -11/8 and becomes -1."""
    players = players_at_zero(max_gradient_norm=1.0)
    players.round(COSTS)
    assert players.weights.flatten().tolist() == [0.5, 1.0]


def test_average_is_over_players():
    assert average(torch.tensor([[[1.0, 2.0], [3.0, 6.0]]])).tolist() == [[2.0, 4.0]]


def test_players_are_contiguous_leaves_that_leave_their_start_alone():
    starts = torch.randn(2, 4, 5).double().unsqueeze(1).expand(-1, 3, -1, -1)
    given = starts.clone()
    players = LinearPlayers(starts, plain())
    assert torch.equal(players.weights, given)
    assert [tuple(player.shape) for player in players.players] == [(2, 4, 5)] * 3
    for player in players.players:
        assert player.is_contiguous() and player.is_leaf and player.requires_grad
    players.round([lambda p: p.square().sum((1, 2))] * 3)
    assert torch.equal(starts, given)


def test_order_that_does_not_exist():
    with pytest.raises(ValueError, match=r"order = 'togeter'.*did you mean 'together'"):
        players_at_zero(order="togeter")


# --------------------------------------------------------------------------------- Nash gap


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
