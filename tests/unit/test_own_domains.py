"""Training and comparing in one's own domains: both kinds of actions, controls, clear errors."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces

from ipo.own_domains import (
    check_domains,
    compare,
    default_settings,
    evaluate_policy,
    train_policy,
)

TINY = {"num_updates": 1, "num_steps": 16, "num_epochs": 1, "minibatch_size": 16}


class Line(gymnasium.Env):
    """Ten steps; the reward is the action's effect, plus the domain's number in the first step."""

    def __init__(self, number=0.0, action_space=None, observation_space=None):
        self.number = number
        self.action_space = action_space or spaces.Discrete(2)
        self.observation_space = observation_space or spaces.Box(-1, 1, (3,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time = 0
        return self.observation_space.sample() * 0, {}

    def step(self, action):
        self.time += 1
        reward = 1.0 + (self.number if self.time == 1 else 0.0)
        return self.observation_space.sample() * 0, reward, self.time == 10, False, {}


def lines(*numbers, **options):
    return {f"line {n}": lambda n=n: Line(n, **options) for n in numbers}


@pytest.mark.parametrize("method", ["ppo", "ipo", "ensemble"])
@pytest.mark.parametrize("actions", [spaces.Discrete(2), spaces.Box(-1, 1, (2,), np.float32)])
def test_trains_and_evaluates_both_kinds_of_actions(method, actions):
    domains = lines(0, 1, action_space=actions)
    policy = train_policy(domains, method, seeds=[0, 3], **TINY)
    rows = evaluate_policy(policy, domains | lines(5, action_space=actions), num_episodes=2)
    assert list(rows.columns) == ["method", "run", "domain", "metric", "value"]
    # Every episode has ten steps; the domain's number is added once.
    assert set(zip(rows["domain"], rows["value"], strict=True)) == {
        ("line 0", 10.0),
        ("line 1", 11.0),
        ("line 5", 15.0),
    }
    assert set(rows["run"]) == {0, 3}
    assert len(policy.players) == {"ppo": 1, "ipo": 2, "ensemble": 2}[method]


def test_a_run_is_the_same_whatever_runs_are_beside_it():
    domains = {f"pole {d}": lambda: gymnasium.make("CartPole-v1") for d in range(2)}
    both = train_policy(domains, "ipo", seeds=[1, 4], **TINY)
    alone = train_policy(domains, "ipo", seeds=[4], **TINY)
    for one, other in zip(both.players, alone.players, strict=True):
        for name in one:
            assert torch.allclose(one[name][1], other[name][0], atol=1e-6), name


def test_controls_have_equal_frames_and_the_rates_they_are_named_after():
    for n in (2, 3, 4, 5):
        sizes = set()
        for method in ("ppo", "ipo", "ensemble"):
            copies = default_settings(method, n).copies_of_players(n)
            sizes.add(sum(map(sum, copies)))
        assert len(sizes) == 1
    rows = compare(lines(0, 1), lines(2), seeds=[0], controls=True, num_episodes=1, **TINY)
    assert set(rows["method"]) == {"ppo", "ipo", "ppo_lr0.0005", "ipo_lr0.001", "ensemble"}
    assert set(rows["domain"]) == {"line 0", "line 1", "line 2"}
    without = compare(lines(0, 1), lines(2), seeds=[0], num_episodes=1, **TINY)
    assert set(without["method"]) == {"ppo", "ipo"}


def test_acts_in_an_environment():
    policy = train_policy(lines(0, 1), "ipo", seeds=[0, 1], **TINY)
    env = Line()
    observation, _ = env.reset(seed=0)
    action = policy.act(observation, run=1)
    assert env.action_space.contains(np.int64(action))


BOX = spaces.Box(-1, 1, (2,), np.float32)


@pytest.mark.parametrize(
    ("domains", "error", "message"),
    [
        ([Line], TypeError, "must map names"),
        ({"a": Line(), "b": Line}, TypeError, r"domains\['a'\] = .*must be a function"),
        ({"a": Line}, ValueError, r"domains = \['a'\]: must be at least 2"),
        (
            lines(0) | lines(1, action_space=BOX),
            ValueError,
            r"line 1'\]: has action space Box.*must have that of 'line 0', Discrete\(2\)",
        ),
        (
            lines(0) | lines(1, action_space=spaces.Discrete(3)),
            ValueError,
            r"has action space Discrete\(3\)",
        ),
        (
            lines(0) | lines(1, observation_space=BOX),
            ValueError,
            r"line 1'\]: has observation space Box.*\(2,\).*\(3,\)",
        ),
        (
            lines(0, 1, observation_space=spaces.Discrete(4)),
            ValueError,
            "must be vectors",
        ),
        (
            lines(0, 1, observation_space=spaces.Box(0, 1, (2, 2), np.float32)),
            ValueError,
            "must be vectors",
        ),
        (
            lines(0, 1, action_space=spaces.MultiDiscrete([2, 2])),
            ValueError,
            "must be Discrete from 0",
        ),
        (
            lines(0, 1, action_space=spaces.Discrete(2, start=1)),
            ValueError,
            "must be Discrete from 0",
        ),
    ],
)
def test_domains_that_do_not_fit_are_errors_before_any_training(domains, error, message):
    with pytest.raises(error, match=message):
        train_policy(domains, "ipo", **TINY)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: train_policy(lines(0, 1), "ipoo"), "did you mean 'ipo'"),
        (lambda: train_policy(lines(0, 1), seeds=[]), "seeds"),
        (lambda: train_policy(lines(0, 1), num_updates=0), "num_updates = 0"),
        (lambda: compare(lines(0), lines(1)), "train_domains.*must be at least 2"),
        (
            lambda: compare(lines(0, 1), lines(2, observation_space=BOX)),
            "line 2'.*has observation space",
        ),
    ],
)
def test_bad_settings(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_shared_spaces_are_returned():
    observations, actions = check_domains("domains", lines(0, 1))
    assert observations.shape == (3,)
    assert actions == spaces.Discrete(2)
