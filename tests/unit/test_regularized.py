"""The regularisers' arms, the rule that chooses weights, and what the chapters show of them."""

from dataclasses import asdict, replace

import numpy as np
import pandas as pd
import pytest
import torch
from small import assert_close, paper_problem, random_gain

from experiments import keys, lqr
from experiments.regularized import linear, trials
from experiments.regularized.networks import RegularizedSettings
from experiments.regularized.trials import KEYS, largest_harmless
from ipo.lqr import training_costs
from ipo.lqr_learners import published_lqr


@pytest.mark.parametrize(
    ("losses", "expected"),
    [
        ({0: 1.0, 1: 1.01, 10: 1.5}, 1),  # as good as none
        ({0: 1.0, 1: 1.5, 10: 2.0}, 0),  # all do harm
        ({0: 1.0, 1: 0.5, 10: 0.9}, 1),  # the best may have a regulariser
        ({0: 1.0, 1: 1.5, 10: 1.01}, 10),  # the largest counts, whatever lies between
    ],
)
def test_the_rule_by_hand(losses, expected):
    assert largest_harmless(losses, 0.02) == expected


def made_up(baseline: float, one: float) -> pd.DataFrame:
    """Values of two runs of PPO, of IPO and of every arm of the grid; ``one`` of weight 10."""
    arms = dict.fromkeys([KEYS.baseline, KEYS.ipo, *KEYS.settings], (0.5, 0.4))
    arms |= {KEYS.baseline: (baseline, 0.6), "ppo_scale_penalty10": (one, 0.8)}
    return pd.DataFrame(
        {"method": arm, "run": run, "training": training, "new": new + run / 10}
        for arm, (training, new) in arms.items()
        for run in range(2)
    ).set_index(["method", "run"])


def test_chosen_is_what_training_domains_choose():
    nothing = dict.fromkeys(KEYS.grid, 0.0)
    assert KEYS.chosen(made_up(0.9, 0.89)) == nothing | {"scale_penalty": 10.0}
    assert not any(KEYS.chosen(made_up(0.9, 0.87)).values())


def test_the_table_says_what_is_chosen_and_how_far_it_is_from_others():
    table = KEYS.table(made_up(0.9, 0.89)).set_index(["regulariser", "weight"])
    row = table.loc["IRMv1", "10"]
    assert row["in training"] == "0.890 ± 0.000" and row["new domain"] == "0.850 ± 0.050"
    assert row["difference to none"] == "+0.200 [+0.200, +0.200]"
    assert row["difference to IPO"] == "+0.400 [+0.400, +0.400]"
    assert table.index[table["chosen"] == "✓"].tolist() == [("IRMv1", "10")]


def test_the_rule_chooses_in_each_place_for_itself():
    places = {2: made_up(0.9, 0.89), 5: made_up(0.9, 0.87)}
    table = KEYS.chosen_table(places, "domains").set_index(["domains", "regulariser"])
    assert len(table) == 2 * len(KEYS.grid)
    chosen, none = table.loc[(2, "IRMv1")], table.loc[(5, "IRMv1")]
    assert chosen["weight"] == "10" and chosen["difference to IPO"] == "+0.400 [+0.400, +0.400]"
    assert none["weight"] == "none" and none["difference to IPO"] == "–"


def test_arms_differ_from_the_published_baseline_in_one_setting_alone():
    for cells, plain in (
        (trials.keys_arms(20), keys.published("ppo")),
        (trials.lqr_cells(5, 1000, 5000), published_lqr("gradient_descent")),
    ):
        assert len({cell.label for cell in cells}) == len(cells)
        for cell in cells:
            own, usual = asdict(cell.settings), asdict(plain)
            changed = {key: own[key] for key in own if own[key] != usual.get(key, 0)}
            ((name, weight),) = changed.items()
            assert name in trials.NAMES and cell.label.endswith(f"_{name}{weight:g}")


def test_values_of_the_new_domain_are_not_of_training():
    rows = [
        {"method": "ppo", "run": 0, "domain": color, "metric": "return_exact", "value": value}
        for color, value in {"red": 0.5, "green": 0.75, "blue": 9.0, "grey": 0.25}.items()
    ]
    values = trials.keys_values(pd.DataFrame(rows))
    assert values.loc["ppo", 0].to_dict() == {"training": 0.625, "new": 0.25}


# ---------------------------------------------------------------------------- the costs of LQR


def regularized(K: torch.Tensor, problem, **changes: float) -> torch.Tensor:
    settings = linear.RegularizedLQRSettings("gradient_descent", **changes)
    generators = [np.random.default_rng(run) for run in (0, 1)]
    return linear.regularized_cost(K, problem, settings, generators)


def test_penalty_on_the_variance_of_costs():
    problem = paper_problem()
    K = random_gain(problem)
    costs = training_costs(K, problem)
    expected = costs.mean(1) + 0.3 * (costs - costs.mean(1, keepdim=True)).square().mean(1)
    assert_close(regularized(K, problem, variance_penalty=0.3), expected)


def test_penalty_on_the_slope_of_costs_in_a_factor_on_the_controller():
    problem = paper_problem()
    K = random_gain(problem)
    w = torch.ones(2, 1, 1, dtype=K.dtype, requires_grad=True)
    costs = training_costs(w * K, problem)
    slopes = [torch.autograd.grad(J.sum(), w, retain_graph=True)[0] for J in costs.unbind(1)]
    penalty = torch.stack([slope.flatten() for slope in slopes], 1).square().mean(1)
    found = regularized(K, problem, scale_penalty=0.3) - costs.mean(1).detach()
    assert_close(found, 0.3 * penalty, rtol=1e-3)  # a difference of costs instead of a derivative


def test_dropout_leaves_out_whole_observations_of_each_run():
    """Columns of the gain, for the gradient of what is left out is zero, in all rows."""
    problem = paper_problem()
    K = random_gain(problem).requires_grad_()
    (slope,) = torch.autograd.grad(regularized(K, problem, dropout=0.5).sum(), K)
    out = slope == 0
    assert (out.all(1) == out.any(1)).all() and out.any() and not out.all()
    assert not torch.equal(out[0], out[1])


@pytest.mark.parametrize("name", trials.NAMES)
def test_runs_of_lqr_do_not_mix(name):
    changes = {name: 0.2, "num_iterations": 5}
    settings = linear.RegularizedLQRSettings("gradient_descent", **changes)
    problem, gain = paper_problem(), linear.regularized_gain
    together = gain(problem, settings, [3, 4])
    assert_close(together[1:], gain(problem.run(1), settings, [4]))
    plain = gain(problem, replace(settings, **{name: 0.0}), [3, 4])
    assert not torch.allclose(together, plain)


def test_other_methods_have_no_regularizers():
    with pytest.raises(ValueError, match="method = 'ipo_fixed_phi': must be 'gradient_descent'"):
        linear.RegularizedLQRSettings("ipo_fixed_phi", dropout=0.1)


def test_weight_decay_alone_is_gradient_descent_as_ever():
    """Whose gradient is written out: it is half of the time, and the rows are those of before."""
    cell = trials.lqr_cells(2, 20, 10)[0]
    plain = lqr.published_cell("gradient_descent", 2, 20, 10)
    decayed = replace(plain.settings, weight_decay=cell.settings.weight_decay)
    theirs = lqr.run_cell(replace(plain, settings=decayed), [0, 1])
    assert linear.run_cell(cell, [0, 1])["value"].tolist() == theirs["value"].tolist()


@pytest.mark.parametrize("kind", [linear.RegularizedLQRSettings, RegularizedSettings])
@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("dropout", value) for value in (-0.1, 1.0, float("nan"))),
        *(
            (f"{of}_penalty", value)
            for of in ("variance", "scale")
            for value in (-1.0, float("inf"))
        ),
        ("weight_decay", -1.0),
        ("learning_rate", 0.0),  # of what it inherits
    ],
)
def test_bad_weights_are_refused(kind, name, value):
    method = "ppo" if kind is RegularizedSettings else "gradient_descent"
    with pytest.raises(ValueError, match=f"{name} = "):
        kind(method, **{name: value})


def test_a_run_that_leaves_the_stable_set_stays_out_and_its_cost_says_so():
    cell = trials.lqr_cells(2, 20, 10)[-1]
    rows = linear.run_cell(cell, list(range(10)))
    values = trials.lqr_values(rows)
    lost = np.isinf(values["training"])
    assert 0 < lost.sum() < len(lost)
    assert trials.LQR.spread(values["training"]) == f"infinite in {lost.sum()} of 10 runs"
