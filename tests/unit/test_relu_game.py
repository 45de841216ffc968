"""The game between ReLU networks: best responses beside a slow search, a stuck pair by hand."""

import itertools

import numpy as np
import pandas as pd
import pytest

from experiments.games.relu import FAMILIES, Cell, Game, ends, problem, relu_cells, run_relu, table


def one_unit(players: list[list[float]]) -> Game:
    """Observations -1 and 1, equally often in both domains; relu(x) is wanted."""
    own = problem("no_bias", 1, np.random.default_rng(0))
    half = np.full((2, 2), 0.5)
    return Game(own._replace(shares=half, wanted=np.array([0.0, 1.0])), np.array(players))


def test_players_on_the_wrong_side_are_stuck_if_they_are_large():
    """Changing sides gains 0.5 at x = 1, and loses 0.5 (a / 2)^2 at x = -1."""
    for a, stuck in ((1.9, False), (2.1, True)):
        game = one_unit([[a, 0.0], [-a, 0.0]])
        assert game.cost(0) == pytest.approx(0.5)
        gains = [game.response(d)[0] for d in range(2)]
        assert gains == pytest.approx([0, 0] if stuck else [0.5 - 0.5 * (a / 2) ** 2] * 2)


def test_a_game_ends_where_nobody_gains():
    game = one_unit([[1.0, 0.0], [-1.0, 0.0]])
    game.play(10)
    assert [game.response(d)[0] for d in range(2)] == pytest.approx([0, 0])
    assert game.players.mean(0) == pytest.approx([0, 1])


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("width", [1, 2])
def test_best_responses_are_those_of_a_slow_search(family, width):
    rng = np.random.default_rng(1)
    own = problem(family, width, rng)
    game = Game(own, rng.standard_normal((2, len(own.wanted))))
    for d in range(2):
        root = np.sqrt(own.shares[d])
        target = 2 * own.wanted - game.players[1 - d]
        costs = [
            np.sum(
                (root * (basis @ np.linalg.lstsq(root[:, None] * basis, root * target)[0] - target))
                ** 2
            )
            for basis in own.networks
        ]
        gain, response = game.response(d)
        assert game.cost(d) - gain == pytest.approx(min(costs) / 4, abs=1e-12)
        game.players[d] = response
        assert game.cost(d) == pytest.approx(min(costs) / 4, abs=1e-12)


def test_wide_players_are_done_after_one_round():
    widest = [
        cell
        for cell in relu_cells()
        if (cell.family, cell.width) in (("no_bias", 2), ("biases", 5))
    ]
    rows = pd.concat([run_relu(Cell(c.family, c.width, c.scale, 1), [0, 1, 2]) for c in widest])
    assert rows["value"].abs().max() < 1e-9


def test_ends_are_told_apart():
    cell = Cell("biases", 1, 1.0)
    values = {"gap": [0.0, 0.0, 1.0, 1.0], "cost": [0.0, 0.5, 0.0, 0.5]}
    rows = pd.DataFrame(
        {**cell.columns, "run": run, "metric": metric, "value": values[metric][run]}
        for metric, run in itertools.product(values, range(4))
    )
    assert ends(rows)["rest"].tolist() == [True, True, False, False]
    (line,) = table(rows).to_dict("records")
    assert [line["an equilibrium, optimal"], line["an equilibrium, not optimal"]] == [0.25, 0.25]
    assert line["none reached"] == 0.5
