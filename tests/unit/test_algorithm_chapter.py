"""The chapter on the algorithm: what decides its tables and figures, and rows of small games."""

import numpy as np
import pandas as pd
import pytest
import torch
from small import assert_close, assert_near

from experiments.games import played as games_played
from experiments.games import scalar as algorithm
from experiments.games.played import Game, Gap, Steps, Trajectory, Vote
from experiments.games.scalar import Cell, problem_cell
from experiments.games.scalar_control import stationary_cost
from ipo.causality.regressions import effect_of_target
from ipo.causality.small_games import GameSettings, play, vote

RULE = GameSettings("ipo", learning_rate=0.1, num_rounds=40)


def double(values) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


# --------------------------------------------------------------- where IPO wins, ties, loses


@pytest.mark.parametrize(
    ("ipo", "pooled", "expected"),
    [
        (1.0, 2.0, "IPO better"),
        (1.98, 2.0, "tie"),  # 1 % exactly
        (1.979, 2.0, "IPO better"),
        (2.02, 2.0, "tie"),
        (2.021, 2.0, "IPO worse"),
        (5.0, np.inf, "IPO better"),
        (np.inf, 5.0, "IPO worse"),
        (np.inf, np.inf, "both unstable"),
    ],
)
def test_outcome_by_hand(ipo, pooled, expected):
    assert algorithm.outcome(np.array([ipo]), np.array([pooled])).tolist() == [expected]


def rows_of(cell: Cell, gains: list[tuple[float, float]]) -> pd.DataFrame:
    lines = [
        {**cell.columns, "run": run, "domain": "all", "metric": f"k_{i}", "value": weight}
        for run, pair in enumerate(gains)
        for i, weight in enumerate(pair, start=1)
    ]
    return pd.DataFrame(lines)


def test_shares_of_outcomes_are_of_problems_and_beta_by_beta_of_pairs():
    ipo, pooled = (problem_cell(label, (None, None), "random") for label in ("ipo_adam", "pooled"))
    # better everywhere; the same; unstable for some betas, the invariant controller for none
    rows = pd.concat(
        [
            rows_of(ipo, [(0.4, 0.0), (0.3, 0.1), (0.0, 1.0)]),
            rows_of(pooled, [(0.05, 0.0), (0.3, 0.1), (0.4, 0.0)]),
        ]
    )
    shares = algorithm.shares_of_outcomes(rows, ipo, pooled)
    third = pytest.approx(1 / 3)
    assert shares == {"IPO better": third, "tie": third, "IPO worse": third, "both unstable": 0}
    by_beta = algorithm.shares_beta_by_beta(rows, ipo, pooled)
    assert by_beta["β by β: better"] > 1 / 3  # with k_2 = 1 it is better where beta is near 1
    assert by_beta["worse"] < 1 / 3


def test_ablation_counts_unstable_controllers_too():
    cells = {
        (n, label): problem_cell(label, (None,) * n, "random")
        for n in (2, 3)
        for label in ("pooled", "ipo_adam")
    }
    gains = {"pooled": [(0.4, 0.0), (0.0, 1.0)], "ipo_adam": [(0.0, 1.0), (0.0, 1.0)]}
    rows = pd.concat([rows_of(cell, gains[label]) for (_, label), cell in cells.items()])
    line = algorithm.ablation_line(rows, cells, "ipo_adam")
    expected = {"2 domains: better": 0, "2: worse": 0.5, "2: unstable": 1}
    assert line == expected | {"3 domains: better": 0, "3: worse": 0.5, "3: unstable": 1}


# --------------------------------------------------------------------------- tables of gains


def test_cells_are_trained_in_a_standard_way_but_for_the_rounds():
    assert problem_cell("ipo_adam", (1.0, 0.5)).settings == algorithm.standard(2)["ipo_adam"]
    shorter = problem_cell("ipo_adam", (1.0, 0.5), num_rounds=7).settings
    assert vars(shorter) == vars(algorithm.standard(2)["ipo_adam"]) | {"num_rounds": 7}


def test_a_line_of_control_says_where_a_controller_is_unstable():
    cell = problem_cell("pooled", (1.0, 0.9))
    rows = rows_of(cell, [(0.0, 1.0)])
    largest = rows.iloc[:1].assign(metric="largest_weight", value=1.0)
    line = algorithm.control_line(pd.concat([rows, largest]), cell, (0.5, -0.6))
    assert line["training β"] == "1, 0.9"
    own = stationary_cost(double([0.0, 1.0]), double([1.0, 0.9])).mean()
    assert line["training cost"] == f"{own:.2f}"
    assert line["β = 0.5"] != "unstable"
    assert line["β = -0.6"] == "unstable"


def test_starts_are_lines_and_methods_columns():
    cells = [
        problem_cell(label, (1.0, -0.2), start=start)
        for label in ("ipo_bound2", "ipo_adam")
        for start in ((0.3, 0.0), (0.1, 0.1))
    ]
    rows = pd.concat([rows_of(cell, [(i, 10 * i)]) for i, cell in enumerate(cells)])
    table = algorithm.starts_table(rows, cells)
    assert table["start"].tolist() == ["(0.3, 0)", "(0.1, 0.1)"]
    assert table["IPO, bound 2: k₂"].tolist() == [0, 10]
    assert table["IPO, one Adam per player: k₁"].tolist() == [2, 3]


# ------------------------------------------------------------------------------- small games


def test_rows_of_a_game_hold_all_players_in_order():
    game = Game("effect", (1.0, 0.4, -0.3), RULE, (0.2, 0.1))
    cell = Trajectory("ipo_plain", game)
    rows = games_played.run_trajectory(cell, [0])
    costs = effect_of_target(double([game.domains])).costs
    rounds = games_played.looks(40)
    played = torch.stack([p[0] for _, p in play(costs, double([game.start]), RULE, rounds)])
    assert_close(double(games_played.players_of(rows, cell)), played)
    assert_close(double(games_played.averages_of(rows, cell)), played.mean(1))


def test_players_may_begin_apart_and_only_the_end_may_count():
    game = Game("noise", (0.8, -0.4), RULE, (1.0, -1.9, 1.0, -1.0))
    assert game.first.tolist() == [[[1.0, -1.9], [1.0, -1.0]]]
    whole, end = (Trajectory("ipo_plain", game, on_the_way=way) for way in (True, False))
    path = games_played.players_of(games_played.run_trajectory(whole, [0]), whole)
    last = games_played.players_of(games_played.run_trajectory(end, [0]), end)
    assert path[0, :, 1].tolist() == [-1.9, -1.0]
    assert len(last) == 1
    assert np.array_equal(path[-1:], last)


def test_looks_are_dense_at_the_start_and_cover_the_whole_game():
    rounds = games_played.looks(2000)
    assert rounds[:20] == list(range(20))
    assert rounds[-1] == 2000
    assert games_played.looks(5) == [0, 1, 2, 3, 4, 5]


def test_shares_weigh_costs_and_equal_ones_change_nothing():
    w = double([[0.3, 0.2]])
    plain, equal, unequal = (
        Game("noise", (0.8, -0.4), RULE, (1.0, 0.0), shares=shares).costs
        for shares in ((), (0.5, 0.5), (0.75, 0.25))
    )
    for factor, one, same, other in zip((1.5, 0.5), plain, equal, unequal, strict=True):
        assert_close(same(w), one(w))
        assert_close(other(w), factor * one(w))


def test_table_of_shares_has_the_end_of_each_method():
    cells = [
        Trajectory(
            "ipo_plain",
            Game("noise", (0.8, -0.4), RULE, (1.0, 0.0), shares=(share, 1 - share)),
            on_the_way=False,
        )
        for share in (0.5, 0.75)
    ]
    rows = pd.concat([games_played.run_trajectory(cell, [0]) for cell in cells])
    table = games_played.shares_table(rows, cells, algorithm.NAMES)
    assert table["data of domain 1"].tolist() == ["50%", "75%"]
    assert table["pooled least squares"].tolist() == pytest.approx([0.2, 0.5])
    assert (table["IPO, plain steps"].diff().dropna() > 0).all()


def test_irm_is_one_player_with_the_pooled_costs_and_a_penalty():
    def objective(penalty):
        game = Game("effect", (1.0, -0.4), RULE, (1.0, 0.0), irm_penalty=penalty)
        (cost,) = game.costs
        return cost(double([[0.4, 0.3]]))

    costs = Game("effect", (1.0, -0.4), RULE, (1.0, 0.0)).costs
    assert_close(objective(0.0), sum(cost(double([[0.4, 0.3]])) for cost in costs) / 2)
    assert float(objective(1.0)) > float(objective(0.0))


def test_an_unknown_problem_is_named():
    with pytest.raises(ValueError, match=r"problem = 'efect'.*did you mean 'effect'"):
        Game("efect", (1.0, 0.5), RULE, (0.0, 0.0))


def test_run_i_of_a_vote_is_problem_i_and_settled_games_agree_with_the_theorem():
    cell = Vote(3, GameSettings("ipo", learning_rate=2.4, num_rounds=400, bound=2.0))
    rows = games_played.run_vote(cell, [0, 7])
    assert rows["run"].unique().tolist() == [0, 7]
    line = games_played.vote_line(rows, cell)
    assert (line["problems"], line["settled"]) == (2, 2)
    assert line["largest difference to the vote"] < 1e-6
    alone = games_played.run_vote(cell, [7])
    both = rows[rows["run"] == 7].merge(alone, on=["metric"], suffixes=("", "_alone"))
    assert_near(double(both["value"].to_numpy()), double(both["value_alone"].to_numpy()), 1e-12)


def test_games_that_still_move_do_not_count_as_settled():
    cell = Vote(2, GameSettings("ipo", num_rounds=1, bound=2.0))
    line = games_played.vote_line(games_played.run_vote(cell, [0, 1]), cell)
    assert line["settled"] == 0
    assert np.isnan(line["largest difference to the vote"])


def test_voters_are_a_grid_for_two_and_within_the_unit_interval():
    assert games_played.voters(2).shape == (400, 2)
    assert games_played.voters(5).shape == (200, 5)
    assert bool((games_played.voters(5).abs() <= 1).all())
    assert float(vote(games_played.voters(2)[:, :, None], 3.0).abs().max()) == pytest.approx(0.95)


def test_steps_differ_in_turn_and_not_together():
    cells = [Steps(eta, round(2 / eta), (1.0, -0.2), (0.3, 0.0)) for eta in (0.02, 0.01)]
    rows = pd.concat([games_played.run_steps(cell, [0]) for cell in cells])
    table = games_played.steps_table(rows, cells)
    assert table["together"].max() < 1e-12
    assert games_played.order_of(table["in turn"], table["η / n"]) == pytest.approx(1, abs=0.1)
    assert (table["players are apart by"] > 1).all()


def test_order_is_that_of_the_two_smallest_steps():
    steps = pd.Series([0.4, 0.2, 0.1])
    assert games_played.order_of(pd.Series([9.0, 4.0, 1.0]), steps) == pytest.approx(2)


def test_gaps_vanish_with_bounds_and_stay_without():
    def end(settings):
        game = Game("noise", (0.8, -0.4), settings, (0.0, 0.0))
        cell = Gap("ipo", game, learning_rate=1.0, num_rounds=100)
        part, gap = games_played.gaps_of(games_played.run_gap(cell, [0]), cell)
        assert part.tolist() == [0, 0.02, 0.1, 0.3, 1]
        return gap[-1]

    bounded = GameSettings("ipo", learning_rate=0.2, num_rounds=400, bound=2.0)
    assert end(bounded) == pytest.approx(0, abs=1e-9)
    assert end(GameSettings("ipo", learning_rate=0.05, num_rounds=400)) > 0.1


@pytest.mark.parametrize(
    "cell",
    [
        Trajectory("ipo", Game("noise", (0.8, -0.4), RULE, (0.0, 0.0))),
        Vote(2, GameSettings("ipo", bound=2.0)),
        Steps(0.005, 2000, (1.0, -0.2), (0.3, 0.0)),
        Gap("ipo", Game("noise", (0.8, -0.4), RULE, (0.0, 0.0)), 1.0),
    ],
    ids=lambda cell: type(cell).__name__,
)
def test_witnesses_are_short(cell):
    short = games_played.short(cell)
    assert short.columns == cell.columns
    assert "num_rounds=30" in repr(short)
    assert not any(f"num_rounds={number}" in repr(short) for number in (40, 500, 2000, 5000))


# ------------------------------------------------------------------- players, other Nash gaps


def player_rows() -> pd.DataFrame:
    lines = [
        {"method": "ipo", "run": run, "update": update, "domain": domain, "metric": metric}
        | {"value": value + run * (metric == "distance_players")}
        for run in (0, 1)
        for update, values in {0: (5.0, 0.4, 0.3), 20: (7.0, 0.1, 0.02)}.items()
        for (domain, metric), value in zip(
            [("all", "distance_players"), ("train", "gap_upper"), ("train", "gap_lower")],
            values,
            strict=True,
        )
    ]
    begun = [("red", 0.5), ("green", 0.6)]
    lines += [
        {"method": "ipo", "run": 0, "update": 0, "domain": color, "metric": "return_exact"}
        | {"value": value}
        for color, value in begun
    ]
    return pd.DataFrame(lines)


def test_growth_is_counted_from_each_runs_own_start():
    growth = algorithm.growth(player_rows())
    assert set(growth["metric"]) == {"distance_players"}
    assert growth[growth["update"] == 0]["value"].tolist() == [0, 0]
    assert growth[growth["update"] == 20]["value"].tolist() == [2, 2]
    assert algorithm.mean_of_players(growth, 20)["ipo", "distance_players"] == 2


def test_gaps_of_keys_are_relative_to_the_best_return():
    """At the start the worse colour has 0.5, and 0.4 is missing to the best: that is 0.9."""
    gap = algorithm.keys_gap(player_rows(), "lower")
    assert gap.index.tolist() == [0, 1]
    assert gap.tolist() == pytest.approx([0.3 / 0.9, 0.02 / 0.9])


def test_gaps_of_lqr_fall():
    gap = algorithm.lqr_gap("ipo_fixed_phi")
    assert gap.index[0] == 0
    assert gap.index[-1] == 1
    assert 0 <= gap.iloc[-1] < 0.01 * gap.iloc[0]
