"""Bad input to every public function of ``ipo``, and of what is like it: an error that names it.

A row is something callable, good arguments, and for each parameter the kind of value that it must
refuse. What is public is found by walking the package: without a row, or a reason in ``TRUSTING``
why it takes what it is given, a new function fails here, and so does a new parameter.
"""

import functools
import importlib
import inspect
import math
import os
import pkgutil
import re
import time
import types
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pandas as pd
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from small import paper_problem, random_gain

import ipo
from experiments import keys, tables, visits
from experiments import lqr as lqr_experiments
from experiments.chapter import Chapter
from experiments.doors import hooking, pulling, success, training
from experiments.experiment import Experiment
from experiments.games import scalar_control
from experiments.pictures import DoorPicture
from experiments.store import Store
from experiments.witness import side_by_side
from ipo import game, lqr, lqr_learners, optimizers, own_domains, ppo, rollouts, stats
from ipo.causality import icp, predictors, regressions, scm, small_games
from ipo.dense_in_numpy import DenseInNumpy
from ipo.distributions import Categorical
from ipo.network_players import NetworkPlayers
from ipo.networks import DenseNetwork, copied, of_run
from ipo.own_domains import copies, networks
from ipo.own_domains import policy as policies
from ipo.worlds import (
    colored_keys,
    cued_maze,
    door,
    many_doors,
    minigrid_tables,
    one_door,
    tabular,
    vector_environments,
)
from ipo.worlds.networks import DenseOnTable, GridNetwork, OnTable

NAN, INF = math.nan, math.inf

# ------------------------------------------------------------- kinds: what must be refused, and why

Bad = tuple[str, Any]  # the kind of fault, a value


def bad(fault: str, *values: Any) -> list[Bad]:
    return [(fault, value) for value in values]


NUMBER = bad("not finite", NAN, INF, -INF) + bad("kind of object", "x", [1.0], True)
POSITIVE = NUMBER + bad("range", 0, -1)
NON_NEGATIVE = NUMBER + bad("range", -0.1)
PROBABILITY = NUMBER + bad("probability", -0.1, 1.1)
WHOLE = bad("kind of object", 1.5, "3", True, [2])
COUNT = WHOLE + bad("range", 0, -1)
NATURAL = WHOLE + bad("range", -1)
SEED = NATURAL + bad("range", 2**32)
SEEDS = bad("kind of object", 3, "01", [0.5], [True]) + bad("range", [-1], [2**32], [1, 1], [])
NUMBERS = bad("kind of object", 3, "x", ["x"]) + bad("not finite", [NAN])
FLAG = bad("flag", "no", 1, None)
CHOICE = bad("choice", "misspelt", None, 3)
OBJECT = bad("kind of object", 3, {}, "x")
FUNCTION = bad("kind of object", 3, "x")
LIST = bad("kind of object", 3, "x") + bad("sample size", [])


def array(without: str = "") -> Callable[[Any], list[Bad]]:
    """Arrays and tensors that are almost the good one; ``without`` some of them, by name."""

    def near(good: Any) -> list[Bad]:
        tensor = isinstance(good, torch.Tensor)
        join = torch.cat if tensor else np.concatenate
        changed = {
            "list": ("kind of object", good.tolist()),
            "number": ("kind of object", 3),
            "axes": ("shape", good[None]),
            "longer": ("shape", join([good, good[..., :1]], -1)),
            "runs": ("shape", join([good, good[:1]], 0)),
            "empty": ("sample size", good[:0]),
        }
        for name, value in (("nan", NAN), ("inf", INF)):
            spoilt = (
                good.clone(memory_format=torch.contiguous_format)
                if tensor
                else np.array(good, dtype=float)
            )
            spoilt.reshape(-1)[0] = value
            changed[name] = ("not finite", spoilt)
        if tensor:
            changed["integers"] = ("kind of object", good.long())
            changed["single"] = ("other type", good.float())
        else:
            changed["text"] = ("kind of object", good.astype(str))
        return [case for name, case in changed.items() if name not in without.split()]

    return near


# What a name means, means the same everywhere; rows say where one does not.
BY_NAME = {
    r"(num|dim)_\w+|max_\w+s|\w*size|width|height|updates|\w+_once|\w+_every": COUNT,
    r"learning_rate|bound|max_gradient_norm|contraction|clip|\w+_clip|\w+_epsilon": POSITIVE,
    r"weight_decay|(phi|gain)_scale|\w+_weight|(\w+_)?penalty|ridge|std": NON_NEGATIVE,
    r"discount|gae_lambda|part": PROBABILITY,
    r"method|optimizer|order|side|color\w*|camera|choice|time_outs|precision|\w+_a\w+s": CHOICE,
    r"reward_scale": CHOICE,
    r"seeds": SEEDS,
    r"\w+_rewards|clip_values|variable_phi|skip_last_frames|early_stopping": FLAG,
    r"device": bad("choice", "misspelt") + bad("kind of object", 3),
    r"problem|settings|task|rng|random|generator|params|model|experiment": OBJECT,
    r"env|environments|alone|trained": OBJECT,
}

SHIFT = bad("shape", (0.0,), (0.0, 0.0, 0.0)) + bad("not finite", (NAN, 0.0), (0.0, INF))

# ------------------------------------------------------------------------------- what is refused by


@dataclass(frozen=True)
class Row:
    """``kinds`` of bad values by parameter; a text instead says why a parameter takes anything."""

    function: Callable
    good: dict[str, Any]
    kinds: dict[str, Any]

    @property
    def name(self) -> str:
        return f"{self.function.__module__}.{self.function.__qualname__}"


def row(function: Callable, good: dict[str, Any] | None = None, /, **kinds: Any) -> Row:
    """Parameters that are not given have the kind of their name, or are arrays."""
    good, every = good or {}, {}
    for name in parameters(function):
        meant = [kind for pattern, kind in BY_NAME.items() if re.fullmatch(pattern, name)]
        kind = array() if isinstance(good.get(name), np.ndarray | torch.Tensor) else None
        every[name] = kinds.pop(name, kind or (meant[0] if meant else None))
    assert not kinds, f"{function} has no parameters {list(kinds)}"
    return Row(function, good, every)


def never(*arguments: object) -> Any:
    raise AssertionError("nothing must be drawn, made or trained")


def rows() -> Iterator[Row]:
    """Everything public that checks what it gets; in the order of the package's files."""
    yield from rows_of_lqr()
    yield from rows_of_learning()
    yield from rows_of_causality()
    yield from rows_of_worlds()
    yield from rows_of_experiments()
    yield from rows_of_tables()


def rows_of_lqr() -> Iterator[Row]:
    problem = paper_problem()  # R = 2, E = 3, n_x = n_u = 4, n_o = 10
    K, W, start = random_gain(problem), problem.W_test, torch.ones(2, 4).double()
    in_domain = {"K": K, "problem": problem, "W": W}
    sizes = {"seeds": [0], "num_domains": 2, "dim_distractor": 6, "dim_state": 4}
    yield row(
        lqr.sample_problem,
        sizes,
        dim_distractor=COUNT + bad("range", 3),
        dtype="torch refuses what is none",
    )
    of_problem = {field.name: getattr(problem, field.name) for field in fields(problem)}
    yield row(lqr.LQR, of_problem, **dict.fromkeys(of_problem, array("runs")))
    yield row(problem.run, {"r": 0}, r=NATURAL + bad("range", 2))
    random = np.random.RandomState(0)
    yield row(
        lqr.random_orthogonal,
        {"random": random, "num_rows": 3, "num_columns": 2},
        num_columns=COUNT + bad("range", 4),
    )
    for function in (lqr.expected_cost, lqr.spectral_radius):
        yield row(function, in_domain)
    yield row(lqr.training_costs, {"K": K, "problem": problem})
    for function in (lqr.riccati_gain, lqr.row_space, lqr.minimum_norm_gain, lqr.invariant_gain):
        yield row(function, {"problem": problem})
    yield row(lqr.oracle_cost)
    basis = lqr.row_space(problem)
    yield row(lqr.project, {"K": K, "basis": basis}, K=array("single"), basis=array("longer"))
    yield row(lqr.simulate, in_domain | {"start": start, "num_steps": 3}, num_steps=NATURAL)
    settings = lqr_learners.LQRSettings("ipo_fixed_phi", num_iterations=2)
    yield row(lqr_learners.LQRSettings, {"method": "ipo_fixed_phi"}, num_iterations=NATURAL)
    yield row(lqr_learners.published_lqr)
    of_runs = SEEDS + bad("shape", [0], [0, 1, 2])
    training = {"problem": problem, "settings": settings, "start": K, "seeds": [0, 1]}
    refused = {"seeds": of_runs}
    for learner in lqr_learners.LEARNERS.values():
        yield row(learner, training, **refused)
    late = bad("kind of object", 3, [0.5]) + bad("range", [3], [-1])
    yield row(lqr_learners.train, training, **refused, checkpoints=late)
    values = bad("sample size", [], [1.0]) + bad("not finite", [1.0, NAN], [1.0, INF])
    values += bad("shape", [[1.0, 2.0]], [[1.0], [2.0]]) + bad("kind of object", "ab", ["a", "b"])
    two = {"values": [1.0, 2.0], "baseline": [2.0, 3.0]}
    yield row(stats.mean_interval, two, values=values)
    unpaired = values + bad("shape", [1.0, 2.0, 3.0])
    yield row(stats.paired_difference, two, values=values, baseline=unpaired)
    many = NUMBERS[:2] + bad("not finite", [NAN]) + bad("probability", [0.1, 1.1], [-0.1])
    yield row(stats.holm, {"p": [0.1, 0.2]}, p=many)
    yield row(
        stats.power, {"effect": 1.0, "spread": 2.0, "num_runs": 10}, effect=NUMBER, spread=POSITIVE
    )
    yield row(stats.runs_needed, {"effect": 1.0, "spread": 2.0}, effect=POSITIVE, spread=POSITIVE)
    improvement = {"costs": [1.0, 2.0], "baseline": [1.0, 2.0]}
    yield row(stats.probability_of_improvement, improvement, costs=values, baseline=values)


def rows_of_learning() -> Iterator[Row]:
    leaves, generators = [torch.zeros(2, 3)], [np.random.default_rng(run) for run in range(2)]
    yield row(
        optimizers.make_optimizer,
        {"name": "adam", "weights": leaves, "learning_rate": 0.1},
        name=CHOICE,
        weights=LIST,
    )
    ownership = {"method": "ipo", "num_domains": 2}
    yield row(game.moves, ownership)
    yield row(
        game.play_round,
        {"num_moves": 2, "respond": never},
        respond="called at once",
        move_phi="called at once",
    )
    starts, costs = torch.zeros(2, 3, 4), torch.ones(2, 3)
    optimizer = functools.partial(optimizers.make_optimizer, "plain", learning_rate=0.1)
    players = {"starts": starts, "optimizer": optimizer}
    yield row(
        game.LinearPlayers, players, starts=array("axes longer runs single"), optimizer=FUNCTION
    )
    cost = torch.Tensor.sum
    yield row(
        game.LinearPlayers(**players).round,
        {"costs": [cost] * 3},
        costs=bad("shape", [cost], [cost] * 4),
        move_phi="called at once",
    )
    both = {"costs": costs, "best_costs": costs}
    fits = array("single")
    yield row(game.nash_gap, both, costs=fits, best_costs=fits)

    grid, dense = GridNetwork(), DenseNetwork(3, 2, hidden=(4,))
    in_numpy = DenseInNumpy(3, 2, hidden=(4,))
    yield row(
        DenseNetwork,
        {"num_observations": 3, "num_actions": 2},
        distribution=bad("kind of object", "Gaussian", Categorical(), None),
        hidden=bad("kind of object", 64, "64", [1.5]) + bad("range", [0], [64, -1]),
    )
    yield row(GridNetwork, width=POSITIVE)
    images = torch.zeros(5, 7, 7, 3)
    on_table = OnTable(grid, images)
    fits = array("longer runs single")
    yield row(OnTable, {"network": grid, "table": images}, network=OBJECT, table=fits)
    few = torch.zeros(5, 3)
    of_table = DenseOnTable(few, 2, (4,))
    sizes = bad("kind of object", 64, [1.5]) + bad("range", [0])
    good = {"table": few, "num_actions": 2, "hidden": (4,)}
    yield row(DenseOnTable, good, table=fits, hidden=sizes)
    yield row(grid.start, {"generators": generators}, generators=LIST + bad("shape", [0]))
    of_dense = [(network, dense) for network in (dense, in_numpy, of_table)]
    for network, good in ((grid, grid), (on_table, grid), *of_dense):
        of_others = [DenseNetwork(2, 2).start(generators)]
        refused = LIST + bad("shape", of_others, [{}]) + bad("kind of object", [3], [{"a": 3}])
        yield row(network.frozen, {"players": [good.start(generators)]}, players=refused)
    yield row(on_table.average, {"players": [grid.start(generators)]}, players=refused)
    yield row(of_table.average, {"players": [dense.start(generators)]}, players=refused)
    yield row(copied, {"players": [grid.start(generators)]}, players=bad("kind of object", 3, [3]))
    one = {"players": [grid.start(generators)], "run": 0}
    yield row(of_run, one, players=LIST, run=NATURAL + bad("range", len(generators)))

    scales = LIST + bad("range", [0, 4])
    good = {"num_runs": 2, "scales": [3], "discount": 0.9, "clip": 10.0}
    yield row(rollouts.RewardNormalizer, good, scales=scales)
    make = functools.partial(gymnasium.make, "CartPole-v1")
    envs = SyncVectorEnv([make] * 4, autoreset_mode=AutoresetMode.SAME_STEP)
    others = SyncVectorEnv([make] * 4)
    environments = vector_environments.FromGymnasium(envs, 2, seed=0)
    yield row(
        vector_environments.FromGymnasium,
        {"envs": envs, "num_runs": 2, "seed": 0},
        envs=bad("kind of object", others),
        num_runs="checked by who makes them",
        seed="checked by who makes them",
    )
    yield row(
        rollouts.Collector,
        {"environments": environments, "num_steps": 2, "discount": 0.9, "gae_lambda": 0.9},
        scales=scales,
    )
    copies = COUNT + bad("range", (), (0, 4), (4, 2.0))
    yield row(ppo.PPOSettings, {"method": "ipo"}, num_envs=copies)
    settings = ppo.PPOSettings("ipo", num_envs=4, minibatch_size=2, num_steps=4)
    for function in (settings.moves, settings.copies):
        yield row(function, {"num_domains": 2})
    yield row(settings.size_of_minibatches, {"num_frames": 8})
    copies = LIST + bad("range", [0, 4])
    yield row(settings.collector, {"environments": environments, "copies": [4]}, copies=copies)
    starts = [dense.start(generators)]
    yield row(
        NetworkPlayers,
        {"network": dense, "starts": starts, "optimizer": settings.optimizer},
        network=OBJECT,
        starts=LIST + bad("kind of object", [3]),
        optimizer=FUNCTION,
    )
    training = {"network": dense, "make_environments": never, "num_domains": 2}
    yield row(
        ppo.Training,
        training | {"settings": settings, "seeds": [0, 1]},
        network=OBJECT,
        make_environments=FUNCTION,
    )
    network = own_domains.network_for(envs.single_observation_space, envs.single_action_space)
    begun = ppo.Training(network, lambda *_: environments, 2, settings, [0, 1])
    yield row(begun.update, only=WHOLE + bad("range", -1, 2))
    weights = copied(begun.players)
    others = bad("shape", weights[:1], [dense.start(generators)] * 2, [weights[0], {}])
    yield row(begun.learners.set, {"players": weights}, players=others)

    yield from rows_of_own_domains(make)


def rows_of_own_domains(make: Callable[[], gymnasium.Env]) -> Iterator[Row]:
    domains = {"a": make, "b": make}
    no_domains = bad("kind of object", 3, [make], {"a": 3, "b": make}, {"a": lambda: None})
    two = no_domains + bad("sample size", {"a": make})
    spaces = dict(zip(("observations", "actions"), copies.check_domains("", domains), strict=True))
    network = policies.network_for(**spaces)
    players = [network.start([np.random.default_rng(0)])]
    policy = own_domains.Policy("ipo", (0,), **spaces, network=network, players=players)
    wrong = bad("shape", DenseNetwork(3, 2, Categorical), network_for_pictures())
    yield row(
        own_domains.train_policy,
        {"domains": domains, "num_updates": 1},
        domains=two,
        method=CHOICE[:1],
        settings=OBJECT,
        network=OBJECT + wrong,
        label=bad("kind of object", 3),
        changes=bad("range", {"num_updates": 0}),
    )
    yield row(
        own_domains.evaluate_policy,
        {"policy": policy, "domains": domains},
        policy=OBJECT,
        domains=no_domains + bad("sample size", {}),
        seed=SEED,
    )
    yield row(
        own_domains.compare,
        {"train_domains": domains, "test_domains": {"c": make}},
        train_domains=two,
        test_domains=no_domains + bad("overlapping names", {"b": make}),
        controls=FLAG,
        changes=bad("range", {"num_updates": 0}),
    )
    yield row(
        policy.act,
        {"observation": np.zeros(4), "run": 0},
        observation=bad("shape", np.zeros(3)),
        run=NATURAL + bad("range", 1),
    )
    yield row(
        networks.ImageNetwork,
        {"shape": (8, 8, 3), "num_actions": 2},
        shape=bad("shape", (8, 8), (0, 8, 3)),
        distribution=FUNCTION,
        hidden=bad("range", (0,)),
    )


def network_for_pictures() -> networks.ImageNetwork:
    return networks.ImageNetwork((8, 8, 3), 2, Categorical)


def rows_of_causality() -> Iterator[Row]:
    rng, draws = np.random.default_rng(0), torch.Generator().manual_seed(0)
    x = torch.randn(3, 2, 20, 4, generator=draws, dtype=torch.float64)  # E, R, N, d
    features, targets = list(x), list(x.sum(-1))
    labels = [(y > 0).double() for y in targets]
    data = {"features": features, "targets": targets}

    def lists(good: list) -> list[Bad]:
        faults = array("axes single")(good[1])
        return LIST + bad("shape", good[:2]) + [(why, [good[0], v, good[2]]) for why, v in faults]

    yield row(predictors.check_domains, data, features=lists, targets=lists)
    yield row(predictors.Regression.from_samples, data, features=lists, targets=lists)
    classes = lambda good: lists(good) + bad("kind of object", targets)  # noqa: E731
    with_labels = data | {"targets": labels}
    yield row(predictors.Classification, with_labels, features=lists, targets=classes)
    one = {"features": [x[0] for x in features], "targets": [y[0] for y in targets]}

    def lists_of_one(good: list) -> list[Bad]:
        return lists(good) + bad("sample size", [part[:1] for part in good], good[:1])

    dependent = [torch.cat([part, part[:, :1]], 1) for part in one["features"]]
    yield row(
        icp.icp,
        one,
        features=lambda good: lists_of_one(good) + bad("shape", dependent),
        targets=lists,
        alpha=POSITIVE + bad("probability", 1.0, 1.5),
    )
    task = predictors.Regression.from_samples(**data)
    parts = {field.name: getattr(task, field.name) for field in fields(task)}
    yield row(predictors.Regression, parts, **dict.fromkeys(parts, array("runs")))
    for own in (task, predictors.Classification(features, labels)):
        yield row(own.domain, {"e": 0}, e=NATURAL + bad("range", 3))
    shares = bad("shape", [1.0], [1.0] * 4) + bad("range", [1.0, 1.0, 0.0], [1.0, 1.0, -1.0])
    yield row(task.pooled, shares=shares + bad("not finite", [1, NAN, 1], [1, INF, 1]) + OBJECT)
    yield row(predictors.PredictorSettings, num_iterations=NATURAL)
    settings = predictors.PredictorSettings(num_iterations=1)
    for method in predictors.PREDICTOR_METHODS.values():
        good = {"task": task, "settings": settings}
        alone = bad("sample size", task.domain(0)) if "game" in method.__name__ else []
        yield row(method, good, task=OBJECT + alone)

    gains, betas = torch.ones(2, 2), torch.ones(2, 3)
    loose = array("axes runs single")
    at = {"gains": gains, "beta": torch.ones(2)}
    yield row(
        scalar_control.stationary_cost, at, gains=loose, beta=array("axes longer runs single")
    )
    yield row(scalar_control.costs, {"betas": betas}, betas=array("longer runs single"))
    unseen = {"gains": gains, "betas": betas[0]}
    fits = array("longer runs single")
    yield row(scalar_control.unseen_cost, unseen, gains=array("runs single"), betas=fits)

    draw = {"rng": rng, "size": 3}
    yield row(scm.Normal, mean=NUMBER)
    for noise in (scm.uniform, scm.Normal().__call__):
        yield row(noise, draw)
    weights = bad("not finite", {"x": NAN}, {"x": INF}) + bad("kind of object", 3, "x", {"x": "y"})
    yield row(scm.Linear, {"coefficients": {}}, coefficients=weights, noise=OBJECT)
    text = bad("kind of object", 3, "x", (3,))
    mechanism = {"parents": ("x",), "function": np.add}
    yield row(scm.Mechanism, mechanism, parents=text, function=FUNCTION, noise=FUNCTION)
    yield row(
        scm.bernoulli,
        {"parents": (), "probability": never},
        parents=text,
        probability=bad("kind of object", 2, 0.5),
    )
    cause = scm.Linear({})
    cycle = bad("choice", {"a": scm.Linear({"b": 1.0})}, {"a": scm.Linear({"a": 1.0})})
    yield row(
        scm.SCM,
        {"assignments": {"x": cause}},
        assignments=bad("kind of object", 3, {"x": 3}) + bad("sample size", {}) + cycle,
    )
    model = scm.SCM({"x": cause, "y": scm.Linear({"x": 1.0}), "z": scm.Linear({"y": 1.0})})
    unknown = bad("choice", {"q": cause})
    yield row(model.parents, {"name": "x"}, name=bad("choice", "q", 3, None))
    yield row(model.descendants, {"name": "x"}, name=bad("choice", "q", 3, None))
    yield row(model.sample, {"num_samples": 5, "rng": rng})
    yield row(model.intervene, assignments=[(w, {"x": v}) for w, v in OBJECT] + unknown)
    yield row(model.do, values=[(w, {"x": v}) for w, v in NUMBER] + bad("choice", {"q": 1.0}))
    noises = [(w, {"x": v}) for w, v in OBJECT] + bad("choice", {"q": scm.Normal()})
    yield row(model.with_noise, noises=noises)
    curved = scm.SCM({"x": scm.Mechanism((), np.abs)})
    yield row(scm.moments, {"model": model}, model=OBJECT + bad("kind of object", curved))
    frame = model.sample(20, rng)
    names = bad("choice", ["q"], ["y"]) + bad("kind of object", 3, "xy")
    yield row(
        scm.population_regression,
        {"covariance": frame.cov(), "target": "y", "predictors": ["x"]},
        covariance=OBJECT,
        target=bad("choice", "q", "x") + bad("kind of object", 3),
        predictors=names,
    )
    samples = bad("sample size", [], [frame], [frame, frame[:1]], [frame[:1], frame[:1]])
    samples += bad("not finite", [frame, frame * NAN], [frame * INF, frame])
    samples += bad("choice", [frame, frame[["x"]]]) + OBJECT
    yield row(
        scm.same_conditional,
        {"samples": [frame, frame], "target": "y", "given": ["x"]},
        samples=samples,
        target=bad("choice", "q", "x") + bad("kind of object", 3),
        given=names,
    )

    spurious = torch.tensor([[0.5, -0.5], [0.1, 0.2]])
    few = lambda good: array("runs longer single")(good) + bad("sample size", good[:, :1])  # noqa: E731
    outside = lambda good: few(good) + bad("probability", 3 * good)  # noqa: E731
    good = {"spurious": spurious}
    yield row(regressions.correlated_noise, good, spurious=outside, causal=NUMBER)
    yield row(regressions.effect_of_target, good, spurious=few, causal=NUMBER)
    costs = regressions.correlated_noise(spurious).costs
    policy, players = torch.zeros(2, 2), torch.zeros(2, 2, 2)
    of_domains = LIST + bad("kind of object", [3, 3])
    yield row(small_games.GameSettings, {"method": "ipo"}, num_rounds=NATURAL)
    settings = small_games.GameSettings("ipo", num_rounds=2)
    playing = {"costs": costs, "start": policy, "settings": settings}
    loose = array("axes longer runs single")
    starts = lambda good: loose(good) + bad("shape", torch.zeros(2, 3, 2))  # noqa: E731
    refused = {"costs": of_domains, "start": starts}
    late = bad("kind of object", 3, [0.5]) + bad("range", [3], [-1])
    yield row(small_games.play, playing, **refused, checkpoints=late)
    yield row(small_games.last, playing, **refused)
    flat, stacked = array("longer runs single"), array("longer runs single")
    at = {"costs": costs, "policy": policy}
    yield row(small_games.downhill, at, costs=of_domains, policy=flat)
    at = {"costs": costs, "players": players}
    fits = lambda good: stacked(good) + bad("shape", good[:, :1])  # noqa: E731
    yield row(small_games.residual, at, costs=of_domains, players=stacked)
    alone = at | {"alone": small_games.GameSettings("pooled", num_rounds=1)}
    yield row(small_games.gap, alone, costs=of_domains, players=fits)
    vote = {"optima": players, "bound": 1.0}
    yield row(small_games.vote, vote, optima=loose)


def rows_of_worlds() -> Iterator[Row]:
    params, shift = door.DoorParams(), (0.0, 0.0)
    rng = np.random.default_rng(0)
    limits = {
        size.name: NUMBER + bad("range", low - 1, high + 1)
        for size in fields(door.DoorParams)
        for low, high in [size.metadata["limits"]]
    }
    yield row(
        cued_maze.cued_maze,
        {"cue": 0.5},
        cue=NUMBER + bad("range", -1.1, 1.1),
        landmark=PROBABILITY,
        corridor=COUNT,
        horizon=COUNT,
    )
    yield row(door.DoorParams, **limits)
    yield row(door.DoorParams.sample, {"generator": rng}, friction=POSITIVE[:6])
    yield row(door.build_door, {"params": params}, timestep=POSITIVE, handle_shift=SHIFT + OBJECT)
    env = one_door.DoorEnv(params=params)
    env.reset(seed=0)
    times = POSITIVE + bad("range", 0.003, 1.0)
    yield row(
        one_door.DoorEnv,
        {},
        friction=NUMBER + bad("range", -1.0),
        timestep=times,
        render_mode=bad("choice", "human", 3),
        draw=FUNCTION,
    )
    yield row(env.reset, seed=SEED, options="none are used")
    still = np.zeros(6)
    yield row(env.step, {"action": still}, action=array("axes longer runs empty list"))
    yield row(door.substeps, {"timestep": 0.004}, timestep=times)
    yield row(
        many_doors.VectorDoor,
        {"doors": [0.0]},
        doors=LIST + bad("not finite", [NAN], [INF]) + bad("range", [-1.0]) + OBJECT,
        timestep=times,
    )
    doors = many_doors.VectorDoor([params, params])
    doors.reset(seed=0)
    yield row(doors.reset, seed=SEED[1:] + bad("shape", [0], [0, 1, 2]), options="none are used")
    both = np.zeros((2, 6))
    yield row(doors.step, {"actions": both}, actions=array("list"))
    alone = many_doors.VectorDoor([params])
    alone.reset(seed=0)
    state = bad("shape", alone.state()) + bad("kind of object", 3, [])
    yield row(doors.restore, {"state": doors.state()}, state=state)
    yield row(hooking.Hooking)
    at = {"params": params, "handle_shift": shift}
    yield row(hooking.Hooking().begin, at, handle_shift=SHIFT + OBJECT)
    episode = {"env": env, "act": never, "observation": np.zeros(15)}
    yield row(pulling.strategy, episode, act=FUNCTION, observation="given to ``act`` only")
    yield row(pulling.strategy_of_part)
    parts = bad("probability", [2.0], [-0.5]) + bad("not finite", [NAN])
    yield row(pulling.strategy_of_policy, parts=parts + bad("kind of object", 3, "x"))

    yield row(colored_keys.ColoredKeysEnv, size=COUNT + bad("range", 4), kwargs="of MiniGrid")
    small = colored_keys.ColoredKeysEnv(max_steps=3)
    task = line_of_states()
    no_grid = OBJECT + bad("kind of object", gymnasium.make("CartPole-v1"))
    yield row(minigrid_tables.tabulate, {"env": small}, env=no_grid)
    yield row(minigrid_tables.goal_reward, {"env": small}, env=no_grid)
    yield row(minigrid_tables.state_of, {"task": task, "env": small}, env=no_grid)
    parts = {field.name: getattr(task, field.name) for field in fields(task)}
    loose = dict.fromkeys(("goal_reward", "images"), array("axes longer runs"))
    loose |= {"start": array("axes"), "next_state": array("longer runs")}
    kinds = {name: loose.get(name, array("longer")) for name in parts}
    yield row(tabular.TabularTask, parts, **kinds)
    longer = tabular.TabularTask(**parts | {"goal_reward": np.ones(9)})
    yield row(
        tabular.TabularDomains,
        {"tasks": [task]},
        tasks=LIST + bad("kind of object", [3]) + bad("shape", [task, longer]),
    )
    yield row(
        tabular.TabularDomains([task]).__call__,
        {"domains": [0], "num_copies": [2], "generators": [rng]},
        domains=LIST + bad("range", [1], [-1]) + bad("shape", [0, 0]),
        num_copies=COUNT[1:3] + bad("range", 0, [0]) + bad("shape", [1, 1]),
        generators=LIST + bad("kind of object", [3]),
    )
    policy = np.full((3, 2, 2), 0.5)
    wrong = bad("probability", 2 * policy, policy - [1, -1], np.zeros((3, 2, 2)))
    policies = lambda good: array("runs")(good) + wrong  # noqa: E731
    at = {"task": task, "policy": policy}
    for function in (tabular.expected_return, tabular.values, visits.occupancy):
        yield row(function, at, policy=policies)
    states = np.zeros(len(task.start), bool)
    yield row(visits.reach, at | {"states": states}, policy=policies, states=array("nan inf"))
    yield row(tabular.optimal_policy, {"task": task})


def line_of_states() -> tabular.TabularTask:
    """Three states in a row, two actions, two observations; the goal is at the end."""
    done = np.array([[False, False], [False, True], [True, True]])
    return tabular.TabularTask(
        next_state=np.array([[0, 1], [0, 1], [2, 2]]),
        goal=done,
        done=done,
        goal_reward=np.ones(4),
        start=np.array([1.0, 0.0, 0.0]),
        observation=np.array([0, 1, 1]),
        images=np.zeros((2, 7, 7, 3)),
        progress=np.zeros(3),
        position=np.zeros((3, 2)),
        signature=np.zeros(3),
    )


def rows_of_experiments() -> Iterator[Row]:
    """What a notebook calls first."""
    experiment = Experiment(never, lqr_experiments.Cell)
    yield row(
        Experiment,
        {"run": never, "cell": lqr_experiments.Cell},
        run=FUNCTION,
        cell=OBJECT,
        short=FUNCTION,
        near_the_end=FUNCTION,
        seeds=bad("kind of object", 3, "01", (0.5,)) + bad("range", (-1,), (0, 0), ()),
        reads=FUNCTION,
    )
    cell = lqr_experiments.Cell("oracle", 2, 20, None)
    yield row(
        Store(Path(os.devnull) / "rows", "rows").fill,
        {"experiment": experiment, "cells": [cell], "seeds": [0]},
        cells=LIST + bad("kind of object", [3]),
        num_workers=WHOLE + bad("range", 0),
    )
    yield row(
        Chapter,
        {"name": "lqr", "experiments": {}, "results_dir": None},
        name=bad("kind of object", 3, None),
        experiments=bad("kind of object", 3, {"a": 3}),
        results_dir=bad("kind of object", 3),
    )
    yield row(DoorPicture, {"params": door.DoorParams()})
    yield row(
        lqr_experiments.Cell,
        {"label": "ipo", "num_domains": 2, "dim_distractor": 20, "settings": None},
        label=bad("kind of object", 3),
    )
    settings = keys.published("ppo")
    yield row(
        keys.Cell,
        {"label": "ppo", "settings": settings},
        label=bad("kind of object", 3),
        train_colors=bad("choice", ("red", "gren"), ("red", "red")) + bad("sample size", ()),
        width=POSITIVE,
    )
    trained = {"label": "ppo", "settings": settings, "saved_after": (1,)}
    yield row(
        training.Cell,
        trained,
        label=bad("kind of object", 3),
        saved_after=bad("range", (0,), (21,)) + bad("kind of object", 3, (0.5,)),
    )
    yield row(
        success.Cell,
        {"trained": training.Cell(**trained), "updates": 1},
        updates=COUNT + bad("range", 2),
        player=NATURAL,
        frictions=bad("kind of object", 3, ("x",)) + bad("range", (-1.0,), ()),
    )


def rows_of_tables() -> Iterator[Row]:
    """Where pandas would leave something out, or count it twice, and show a number all the same."""
    where = {"method": ["a", "a", "b", "b"], "metric": "cost", "run": [0, 1, 0, 1]}
    rows = pd.DataFrame(where | {"value": [1.0, 2.0, 3.0, INF]})
    unfit = OBJECT + bad("sample size", rows[:0])
    unfit += bad("range", rows.assign(value=[1.0, NAN, 3.0, 4.0]), rows.assign(run=0))
    unfit += bad("kind of object", rows.drop(columns="run"), rows.drop(columns="value"))
    values = OBJECT + bad("range", pd.Series([1.0, NAN])) + bad("sample size", pd.Series([]))
    for function in (tables.mean_and_std, tables.mean_and_interval):
        yield row(function, {"values": rows["value"][:3]}, values=values, digits=NATURAL)
    yield row(
        tables.show,
        {"frame": rows},
        frame=OBJECT,
        formats=bad("choice", {"misspelt": "{:.1f}"}) + bad("kind of object", 3),
    )
    yield row(
        tables.costs,
        {"folder": Path(os.devnull) / "rows", "names": ["main"]},
        folder=bad("kind of object", 3),
        names=bad("kind of object", 3, "main", [3]) + bad("choice", ["misspelt"]),
    )
    yield row(tables.beside_shipped, {"live": rows, "shipped": rows}, live=unfit, shipped=unfit)
    by = bad("choice", ["misspelt"]) + bad("kind of object", 3, "run") + bad("sample size", [])
    pair = {"live": rows, "shipped": rows, "by": ["method"]}
    yield row(tables.largest_differences, pair, live=unfit, shipped=unfit, by=by)
    yield row(
        tables.by_method,
        {"rows": rows, "columns": "metric", "names": {"a": "A"}},
        rows=unfit,
        columns=bad("choice", "misspelt") + bad("kind of object", 3),
        names=OBJECT[::2],
        digits=NATURAL,
    )
    yield row(
        tables.chosen_by,
        {"rows": rows.assign(problem="p", penalty=1.0), "criterion": "cost"},
        rows="whatever is in them is chosen from, or nothing",
        criterion=CHOICE,
    )
    pair = {"recorded": rows, "rows": rows}
    yield row(side_by_side, pair, recorded=OBJECT + bad("sample size", rows[:0]), rows=OBJECT)


# ------------------------------------------------------- what is public, and need not be checked

LOOP = "called in every step of a training: its arrays come from what was checked when it began"
RECORD = "a record of what was computed; nobody makes one by hand"
STATE = "what state() gave; check-points have a digest"
TRUSTING = {
    r"ipo\.(checks|notebooks)\..*": "is a check itself; in test_bad_input.py",
    r"ipo\.distributions\..*": LOOP,
    r"ipo\.game\.average": LOOP,
    r"ipo\.(game\.slope|optimizers\.(clip_gradient|descend|differentiate|step))": LOOP,
    r"ipo\.lqr\.feedback_(costs|slopes)": LOOP,
    r"ipo\.lqr_learners\.(Domain|Pooled)Cost.*": LOOP,
    r"ipo\.lqr\.(LQR\.to|split_domains)": "torch's own conversion and view, by a new name",
    r"ipo\.lqr_learners\.Learner": RECORD,
    r"ipo\.(worlds\.)?networks\.\w+\.(__call__|after_pooling|vjp)": LOOP,
    r"ipo\.networks\.(averaged|chosen_rows|dense|Tanh.*)": LOOP,
    r"ipo\.dense_in_numpy\.(DenseInNumpy|DenseInNumpy\.vjp)": "as in ipo.networks",
    r"ipo\.worlds\.networks\.TableNetwork\.average": "that of OnTable and DenseOnTable",
    r"ipo\.worlds\.networks\.OnTable\.start": "hands on what it is given",
    r"ipo\.own_domains\.copies\.check_domains": "is a check itself; train_policy shows it",
    r"ipo\.own_domains\.copies\.(Copies.*|is_\w+|dtype_of|clipped)": "of checked domains",
    r"ipo\.own_domains\.policy\.(Policy|Policy\.save|network_for)": "of checked spaces",
    r"ipo\.own_domains\.policy\.Policy\.load": "every flip of a bit is, in test_own_domains.py",
    r"ipo\.own_domains\.policy\.check_network": "is a check itself; train_policy shows it",
    r"ipo\.own_domains\.networks\.(\w+\.(__call__|frozen|vjp)|VectorNetwork)": "as in ipo.networks",
    r"ipo\.rollouts\.check_device": "is a check itself; Training shows it",
    r"ipo\.own_domains\.default_settings": "PPOSettings checks",
    r"ipo\.network_players\.(in_one_row|side_by_side|NetworkPlayers\.(others|vjp|step))": LOOP,
    r"ipo\.ppo\.(PPOSettings\.optimizer|Training\.(respond|improve))": LOOP,
    r"ipo\.ppo\.(minibatches|loss_gradient|gains|standardize)": LOOP,
    r"ipo\.(ppo|network_players|rollouts|worlds\.vector_environments)\.\w+\.restore": STATE,
    r"ipo\.rollouts\.(Step|Rollout)": RECORD,
    r"ipo\.(stats\.Difference|game\.Move)": RECORD,
    r"ipo\.worlds\.vector_environments\.FromGymnasium\.step": LOOP,
    r"ipo\.worlds\.seeds\.seeds_of": "of a stream and a number of environments, both checked",
    r"ipo\.rollouts\.(\w+\.step|\w+\.__call__|Collector\.collect)": LOOP,
    r"ipo\.rollouts\.(value_errors|advantages)": LOOP,
    r"ipo\.causality\.icp\.ICPResult": RECORD,
    r"ipo\.causality\.predictors\.\w+\.(risks|gradients|errors)": LOOP,
    r"ipo\.causality\.predictors\.irm_(objective|penalties)": LOOP,
    r"ipo\.causality\.scm\.(Linear|Mechanism)\.__call__": "called by SCM.sample with what it drew",
    r"ipo\.worlds\.door\.(hook_rotation|fingertip_position|target_position|reward|observe)": LOOP,
    r"ipo\.worlds\.door\.(lever|draw_start|shift_handle)": LOOP,
    r"ipo\.worlds\.tabular\.TabularEnvironments": "made by TabularDomains",
    r"ipo\.worlds\.minigrid_tables\.NotTabularError": "an error",
    r"ipo\.worlds\.tabular\.TabularEnvironments\.step": LOOP,
    r"experiments\.games\.scalar_control\.training_cost": LOOP,
    r"experiments\.doors\.hooking\.Hooking\.__call__": LOOP,
    r"experiments\.doors\.pulling\.(pulling_forces|is_inside)": LOOP,
}


def public() -> dict[str, Callable]:
    """Every function, class and method with a parameter that a caller chooses."""
    found: dict[str, Callable] = {}
    modules = [module.name for module in pkgutil.walk_packages(ipo.__path__, "ipo.")]
    games = regressions, scalar_control
    modules += [module.__name__ for module in (tables, visits, *games, hooking, pulling)]
    for module in modules:
        for name, thing in vars(importlib.import_module(module)).items():
            if getattr(thing, "__module__", None) != module or name.startswith("_"):
                continue
            if inspect.isfunction(thing):
                found[f"{module}.{name}"] = thing
            elif inspect.isclass(thing) and not getattr(thing, "_is_protocol", False):
                found[f"{module}.{name}"] = thing
                for method, function in inspect.getmembers_static(thing):
                    own = method in vars(thing) and (method[0] != "_" or method == "__call__")
                    function = getattr(function, "__func__", function)
                    if own and inspect.isfunction(function):
                        found[f"{module}.{name}.{method}"] = function
    return {name: thing for name, thing in found.items() if parameters(thing)}


def parameters(function: Callable) -> list[str]:
    try:
        names = list(inspect.signature(function).parameters)
    except ValueError:  # of an exception
        return ["args"]
    return [name for name in names if name not in ("self", "cls")]


@functools.cache
def table() -> dict[str, list[Row]]:
    by_name: dict[str, list[Row]] = {}
    for one in rows():
        by_name.setdefault(one.name, []).append(one)
    return by_name


def is_trusting(name: str) -> bool:
    return any(re.fullmatch(pattern, name) for pattern in TRUSTING)


# ------------------------------------------------------------------------------------------- tests


@pytest.mark.parametrize("name", public())
def test_everything_public_has_a_row_or_a_reason(name):
    assert (name in table()) != is_trusting(name), "needs a row of this table, or a reason"
    for one in table().get(name, ()):
        assert None not in one.kinds.values(), f"needs kinds of bad values: {one.kinds}"


def test_no_reason_is_left_over():
    for pattern in TRUSTING:
        assert any(re.fullmatch(pattern, name) for name in public()), pattern


CASES = [
    (one, parameter, kind(one.good[parameter]) if callable(kind) else kind)
    for ones in table().values()
    for one in ones
    for parameter, kind in one.kinds.items()
    if kind is not None and not isinstance(kind, str)
]


def refusal(one: Row, parameter: str, value: Any) -> Exception | None:
    """What a call with one bad value raises, if it does."""
    arguments = {**one.good, parameter: value}
    known = inspect.signature(one.function).parameters
    variadic = known[parameter].kind is inspect.Parameter.VAR_KEYWORD
    arguments = {name: own for name, own in arguments.items() if name in known}
    if variadic:
        arguments |= arguments.pop(parameter)
    try:
        result = one.function(**arguments)
        if isinstance(result, types.GeneratorType):
            next(result)
    except Exception as error:
        return error
    return None


# What a message may name instead of a parameter: an entry of it, or what it disagrees with.
ENTRIES = {
    "actions": ["action"],
    "assignments": ["intervention on", "parent of"],
    "doors": ["friction"],
    "noises": ["intervention on"],
    "name": ["variable"],
    "values": ["intervention on"],
    **{name: ["variable", "target"] for name in ("target", "predictors", "given", "samples")},
}
DISAGREEMENTS = ("shape", "sample size", "other type")


def is_clear(error: Exception | None, one: Row, parameter: str, fault: str, value: Any) -> bool:
    """Whether a message names the parameter, or the entry of it that is wrong, and the rule."""
    names = [parameter, *(value if isinstance(value, dict) else ()), *ENTRIES.get(parameter, ())]
    if fault in DISAGREEMENTS:
        names += one.kinds
    pattern = f"^({'|'.join(map(re.escape, map(str, names)))})\\b.*must"
    right_kind = isinstance(error, TypeError | ValueError)
    return right_kind and bool(re.search(pattern, str(error), re.DOTALL))


@pytest.mark.parametrize(
    ("one", "parameter", "values"), CASES, ids=[f"{one.name}-{name}" for one, name, _ in CASES]
)
def test_bad_input_is_refused_by_name(one, parameter, values):
    start = time.process_time()
    answers = [(value, fault, refusal(one, parameter, value)) for fault, value in values]
    seconds = time.process_time() - start
    unclear = [
        (value, error)
        for value, fault, error in answers
        if not is_clear(error, one, parameter, fault, value)
    ]
    assert not unclear, f"{parameter}: these are taken, or refused without its name: {unclear}"
    assert seconds < 1, "refused after some work"


def test_there_are_enough_cases():
    assert sum(len(values) for *_, values in CASES) >= 300


def test_good_arguments_are_taken():
    """Otherwise a row could be refused for something else."""
    problem = paper_problem()
    assert lqr.expected_cost(random_gain(problem), problem, problem.W_test).shape == (2,)
    tabular.expected_return(line_of_states(), np.full((3, 2, 2), 0.5))
    scalar_control.stationary_cost(torch.ones(2, 2), torch.ones(2))
