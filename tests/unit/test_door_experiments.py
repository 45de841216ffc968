"""Evaluation of policies on doors: the same doors for everyone, and rows as agreed."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from experiments.doors import players as door_players
from experiments.doors import training as door_training
from experiments.doors.success import (
    EVALUATION_SEED,
    Cell,
    door_seeds,
    evaluate,
    evaluation_doors,
    load_players,
)
from experiments.doors.training import (
    CELLS,
    NETWORK,
    TRAIN_FRICTIONS,
    last_info,
    made_for,
    make_doors,
    new_training,
    policy_path,
    published_door,
)
from experiments.policies import save_policy
from ipo.networks import DenseNetwork
from ipo.worlds.many_doors import VectorDoor
from ipo.worlds.one_door import DoorEnv


@pytest.fixture
def policies(tmp_path):
    """Of two runs of IPO, untrained."""
    for seed in (0, 1):
        players = [NETWORK.start([np.random.default_rng([seed, d])]) for d in range(2)]
        path = policy_path(tmp_path, "ipo", seed, 95, "last")
        save_policy(path, players, made_for(CELLS["ipo"], seed, 95, "last"))
    return tmp_path


def cell(**changes) -> Cell:
    options = {"trained": CELLS["ipo"], "updates": 95, "choice": "last", "frictions": (0.0, 1.5)}
    return Cell(**(options | {"num_doors": 3} | changes))


def test_a_row_for_every_run_friction_and_door(policies):
    rows = evaluate(cell(), [0, 1], policies)
    assert len(rows) == 2 * 2 * 3
    assert list(rows.columns) == [
        *cell().columns, "run", "domain", "door", "metric", "value",
    ]  # fmt: skip
    assert set(rows["steps"]) == {95 * 4096 * 32}
    assert set(rows["domain"]) == {"0.0", "1.5"}
    assert set(rows["value"]) <= {0.0, 1.0}
    fewer = evaluate(cell(num_doors=2), [1], policies)["value"]
    same = rows[(rows["run"] == 1) & (rows["door"] < 2)]["value"]
    assert list(fewer) == list(same)


def test_a_player_alone(policies):
    rows = evaluate(cell(player=1), [0], policies)
    assert set(rows["method"]) == {"ipo_player_1"}
    (alone,) = load_players(cell(player=1), 0, policies)
    together = load_players(cell(), 0, policies)
    assert all(torch.equal(alone[name], together[1][name]) for name in alone)


def test_the_same_doors_at_every_friction(monkeypatch):
    """A hook that never moves opens nothing; the door that it meets is the one of the table."""
    table = evaluation_doors(3)
    seen = []

    class Spy(VectorDoor):
        def close(self, **options):
            seen.append(self.params)
            super().close(**options)

    monkeypatch.setattr(door_training, "VectorDoor", Spy)
    players = [NETWORK.start([np.random.default_rng(0)])]
    for friction in (0.0, 1.5):
        last_info(players, friction, 3, EVALUATION_SEED, max_steps=2)["opened"]
    for doors, friction in zip(seen, (0.0, 1.5), strict=True):
        assert [door.friction for door in doors] == [friction] * 3
        assert [door.width for door in doors] == list(table["width"])
        np.testing.assert_allclose([door.lever_arm for door in doors], table["lever_arm"])


def test_a_door_of_the_evaluation_can_be_made_alone():
    """One by one they are the same as side by side, from the same starts."""
    vector = VectorDoor([0.5] * 3)
    observations, _ = vector.reset(seed=EVALUATION_SEED)
    for door, seed in enumerate(door_seeds(3)):
        env = DoorEnv(0.5)
        observation, _ = env.reset(seed=seed)
        np.testing.assert_array_equal(observation, observations[door])
        row = evaluation_doors(3).iloc[door]
        assert env.params.height == row["height"]
        np.testing.assert_allclose(env.handle_shift, [row["shift_y"], row["shift_z"]])


def test_runs_of_the_same_seed_have_the_same_doors_without_friction():
    """Whether one player owns all doors, or each player those of one friction."""

    def first_doors(domains, copies):
        doors = make_doors(domains, copies, [np.random.default_rng(3)])
        doors.reset()
        return doors.envs.params[:4]

    assert first_doors([0, 1], [4, 2]) == first_doors([0], [4])


def test_the_wide_network_has_as_many_weights_as_two():
    def size(label):
        return sum(math.prod(shape) for shape in CELLS[label].network.weight_shapes.values())

    assert size("ppo_wide_same_doors") == pytest.approx(2 * size("ipo"), rel=0.01)


def doors_of(label, num_envs=(4, 2)):
    """Of every domain, in their order, with the starts: the first ones of a training."""
    settings = replace(CELLS[label].settings, num_envs=num_envs, num_steps=8, num_minibatches=1)
    training = new_training(replace(CELLS[label], settings=settings), seeds=[3])
    drawn = []
    for collector in training.collectors:
        collector.environments.reset()
        own = collector.environments.envs
        drawn += zip(own.params, own.handle_shifts.tolist(), strict=True)
    return [[door for door in drawn if door[0].friction == f] for f in TRAIN_FRICTIONS]


@pytest.mark.parametrize(
    "label", ["ppo_same_doors", "ppo_by_domain", "ensemble_same_doors", "in_turn"]
)
def test_arms_with_the_same_doors_have_those_of_ipo(label):
    assert doors_of(label) == doors_of("ipo")
    if label != "in_turn":
        assert doors_of(label) != doors_of(CELLS[label].settings.method)


def test_the_arm_with_as_many_doors_of_both_has_those_of_ipo_and_more():
    """It has fewer without friction: the first ones."""
    assert CELLS["ppo_16_16"].settings.num_envs == (16, 16)
    without, with_friction = doors_of("ppo_16_16", (3, 3))
    of_ipo = doors_of("ipo")
    assert without == of_ipo[0][:3]
    assert with_friction[:2] == of_ipo[1]


def test_the_arm_with_rewards_by_domain_divides_its_copies_as_the_domains_are():
    (collector,) = new_training(CELLS["ppo_by_domain"], seeds=[0]).collectors
    assert collector.normalizer.scales == [24, 8]


def test_the_published_settings():
    ppo, ipo = published_door("ppo"), published_door("ipo")
    assert (ppo.learning_rate, ipo.learning_rate) == (1e-3, 5e-4)
    assert ppo.num_updates * 32 * ppo.num_steps == pytest.approx(25e6, rel=0.01)
    assert ppo.size_of_minibatches(32 * 4096) == 512
    assert [ipo.size_of_minibatches(n * 4096) for (n,) in ipo.copies(2)] == [384, 128]
    assert CELLS["ensemble"].settings.copies(2) == [[12, 4], [12, 4]]


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"choice": "worst"}, "choice = 'worst': must be one of best, last"),
        ({"updates": 94}, r"updates = 94: must be one of \(95, 190\), after which"),
        ({"player": 2}, "player = 2: must be None or less than 2"),
        ({"trained": CELLS["ppo"], "player": 1}, "player = 1: must be None or less than 1"),
    ],
)
def test_an_evaluation_that_makes_no_sense_is_refused(change, error):
    with pytest.raises(ValueError, match=error):
        cell(**change)


def test_a_policy_of_the_wrong_size_or_run_is_refused(tmp_path, policies):
    small = DenseNetwork(15, 6, hidden=(8,)).start([np.random.default_rng(0)])
    path = policy_path(policies, "ipo", 0, 95, "last")
    save_policy(path, [small], made_for(CELLS["ipo"], 0, 95, "last"))
    with pytest.raises(ValueError, match=r"actor1.weight of player 0 has shape .*, needs"):
        evaluate(cell(), [0], policies)
    policy_path(policies, "ipo", 1, 95, "last").rename(path)
    with pytest.raises(ValueError, match="made for something else: seed = 1, asked for 0"):
        evaluate(cell(), [0], policies)
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(ValueError, match="is cut short or changed"):
        evaluate(cell(), [0], policies)


def test_a_policy_of_another_cell_is_refused(policies):
    settings = published_door("ipo", learning_rate=1e-3)
    other = door_training.Cell("ipo", settings)
    with pytest.raises(ValueError, match=r"settings\.settings\.learning_rate = 0\.0005, asked for"):
        evaluate(cell(trained=other), [0], policies)
    gap = door_players.Cell(other, 95)
    with pytest.raises(ValueError, match=r"was made with .*learning_rate=0\.0005.*, not with"):
        door_players.load_players(policies, gap, 0)
    slice_ = door_players.short(door_players.Cell(CELLS["ipo"], 95))
    assert len(door_players.load_players(policies, slice_, 0)) == 2


def test_a_training_whose_policies_have_no_place_does_not_begin(policies, tmp_path):
    settings = published_door("ipo", learning_rate=1e-3)
    with pytest.raises(ValueError, match=r"ipo_0_95_last.*: was made for something else"):
        door_training.train_run(door_training.Cell("ipo", settings), [0], tmp_path, policies)


@pytest.mark.parametrize("label", ["../ipo", "a/b", "/ipo"])
def test_a_label_with_a_path_in_it_is_refused(tmp_path, label):
    with pytest.raises(ValueError, match=r"label = .*: must be the name of a file"):
        door_training.Cell(label, published_door("ipo"))
    with pytest.raises(ValueError, match=r"label = .*: must be the name of a file"):
        policy_path(tmp_path, label, 0, 95)
