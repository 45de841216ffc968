"""The training loop: rollouts by hand, normalised rewards, splits of copies, and going on."""

import math

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode
from torch import Tensor

from ipo.distributions import Gaussian
from ipo.networks import DenseNetwork, copied
from ipo.ppo import METHODS, PPOSettings, Training
from ipo.rollouts import Collector, RewardNormalizer, Step
from ipo.worlds.vector_environments import FromGymnasium

SMALL = {"num_envs": 4, "num_steps": 16, "minibatch_size": 16, "num_updates": 4, "num_epochs": 2}


class Counting:
    """Each copy counts its steps, is paid its action, and runs out of time after ``horizon``."""

    def __init__(self, num_runs: int, num_copies: int, horizon: int = 5) -> None:
        self.shape, self.horizon = (num_runs, num_copies), horizon

    def reset(self) -> Tensor:
        self.count = torch.zeros(self.shape)
        return self.count.unsqueeze(-1)

    def step(self, actions: Tensor) -> Step:
        last = self.count + 1
        truncated = last == self.horizon
        self.count = torch.where(truncated, 0.0, last)
        never = torch.zeros_like(truncated)
        reward = actions.squeeze(-1)
        return Step(self.count.unsqueeze(-1), reward, never, truncated, last.unsqueeze(-1))

    def state(self) -> dict:
        return {"count": self.count}

    def restore(self, state: dict) -> None:
        self.count = state["count"]


def counting(domains, num_copies, generators):
    return Counting(len(generators), sum(num_copies))


NETWORK = DenseNetwork(1, 1, hidden=(8,))


def trainings(settings: PPOSettings, seeds=(0, 1)) -> Training:
    return Training(NETWORK, counting, 2, settings, list(seeds))


# --------------------------------------------------------------------------------- rollouts


def policy(observation: Tensor) -> tuple[Tensor, Tensor]:
    """Means 0, deviations 1, and a critic that says 10 everywhere."""
    zero = torch.zeros_like(observation)
    return torch.cat([zero, zero + 1], -1), zero.squeeze(-1) + 10


def rollout(time_outs: str, gae_lambda: float = 0.0):
    """By default A_t = delta_t."""
    collector = Collector(Counting(1, 2, horizon=3), 4, 0.5, gae_lambda, time_outs)
    return collector.collect(policy, Gaussian, [np.random.default_rng(0)])


@pytest.mark.parametrize(
    ("time_outs", "at_the_time_out"),
    [
        ("bootstrap", lambda r: r + 0.5 * 10 - 10),
        ("terminal", lambda r: r - 10),
        ("no_advantage", lambda r: torch.zeros_like(r)),
    ],
)
def test_what_a_time_out_is_worth(time_outs, at_the_time_out):
    found = rollout(time_outs)
    rewards = found.actions.squeeze(-1)
    expected = rewards + 0.5 * 10 - 10
    expected[..., 2] = at_the_time_out(rewards[..., 2])
    torch.testing.assert_close(found.advantages, expected)
    torch.testing.assert_close(found.returns, found.values + found.advantages)
    density = Gaussian.log_probability(policy(found.observations)[0], found.actions)
    torch.testing.assert_close(found.log_probabilities, density)


def test_no_advantage_flows_over_a_step_that_is_left_out():
    """The third step of four is the time-out; the last has only its own error."""
    found = rollout("no_advantage", gae_lambda=0.5)
    errors = found.actions.squeeze(-1) + 0.5 * 10 - 10
    expected = errors.clone()
    expected[..., 0] += 0.25 * errors[..., 1]
    expected[..., 2] = 0.0
    torch.testing.assert_close(found.advantages, expected)


# ------------------------------------------------------------------------ normalised rewards


def slow_normalizer(rewards, ended, discount, clip):
    """One run, step by step, with all discounted returns kept in a list."""
    G, seen, scaled = np.zeros(len(rewards)), [], []
    for reward, over in zip(rewards.T, ended.T, strict=True):
        G = discount * G + reward
        seen.extend(G)
        scaled.append(np.clip(reward / np.sqrt(np.var(seen) + 1e-8), -clip, clip))
        G = np.where(over, 0.0, G)
    return np.stack(scaled, -1)


def test_rewards_are_normalised_as_step_by_step_and_piece_by_piece():
    random = np.random.default_rng(0)
    rewards, ended = random.normal(3, 2, (2, 3, 40)), random.random((2, 3, 40)) < 0.1
    expected = np.stack(
        [slow_normalizer(r, e, 0.9, 1.5) for r, e in zip(rewards, ended, strict=True)]
    )
    whole = RewardNormalizer(2, [3], 0.9, 1.5)(torch.tensor(rewards), torch.tensor(ended))
    np.testing.assert_allclose(whole, expected)
    assert np.abs(expected).max() == 1.5, "nothing was clipped: the test is too weak"
    pieces = RewardNormalizer(2, [3], 0.9, 1.5)
    parts = [
        pieces(torch.tensor(r), torch.tensor(e))
        for r, e in zip(np.split(rewards, 4, -1), np.split(ended, 4, -1), strict=True)
    ]
    np.testing.assert_allclose(torch.cat(parts, -1), expected)


def test_rewards_of_a_domain_can_have_a_scale_of_their_own():
    """The rewards of the third copy are a hundred times as large."""
    random = np.random.default_rng(0)
    rewards, ended = random.normal(3, 2, (1, 3, 40)), random.random((1, 3, 40)) < 0.1
    rewards[:, 2] *= 100

    def normalised(reward_scale):
        changes = {"num_envs": (2, 1), "normalize_rewards": True, "reward_scale": reward_scale}
        settings = PPOSettings("ppo", **(SMALL | changes))
        (collector,) = trainings(settings, [0]).collectors
        return collector.normalizer(torch.tensor(rewards), torch.tensor(ended))[0].numpy()

    parts = [slow_normalizer(rewards[0, own], ended[0, own], 0.99, 10) for own in ([0, 1], [2])]
    np.testing.assert_allclose(normalised("domain"), np.concatenate(parts))
    whole = slow_normalizer(rewards[0], ended[0], 0.99, 10)
    np.testing.assert_allclose(normalised("player"), whole)
    assert np.abs(whole[:2]).max() < 0.1 * np.abs(parts[0]).max()


def test_scales_are_those_of_all_copies():
    with pytest.raises(ValueError, match=r"scales = \[2, 2\]: must be 3 copies in all"):
        Collector(Counting(1, 3), 4, 0.9, 0.9, reward_clip=10.0, scales=[2, 2])


# -------------------------------------------------------------------------- copies of domains


@pytest.mark.parametrize(
    ("method", "num_envs", "copies"),
    [
        ("ppo", 32, [[16, 16]]),
        ("ipo", 32, [[16], [16]]),
        ("ensemble", 32, [[8, 8], [8, 8]]),
        ("ppo", (24, 8), [[24, 8]]),
        ("ipo", (24, 8), [[24], [8]]),
        ("ensemble", (24, 8), [[12, 4], [12, 4]]),
        ("in_turn", (24, 8), [[24], [8]]),
    ],
)
def test_copies_are_shared_among_players(method, num_envs, copies):
    assert PPOSettings(method, num_envs=num_envs).copies(2) == copies


def test_players_with_unequal_rollouts_make_the_same_number_of_steps():
    settings = PPOSettings("ipo", **(SMALL | {"num_envs": (3, 1), "num_minibatches": 8}))
    assert settings.size_of_minibatches(3 * 16) == 6
    assert settings.size_of_minibatches(1 * 16) == 2
    training = trainings(settings)
    training.update()
    steps = [own.state_dict()["state"][0]["step"].item() for own in training.learners.optimizers]
    assert steps == [8 * settings.num_epochs] * 2
    assert training.num_frames == 4 * 16


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"num_envs": 5}, "num_envs = 5: must be a multiple of 2"),
        ({"num_envs": (4,)}, r"num_envs = \(4,\): must name a multiple of 1 for each of 2 domains"),
        ({"minibatch_size": 1000}, "minibatch_size = 1000: must be at most 32"),
        ({"num_minibatches": 33}, "num_minibatches = 33: must be at most 32"),
    ],
)
def test_settings_that_make_no_sense_are_refused(change, error):
    with pytest.raises(ValueError, match=error):
        trainings(PPOSettings("ipo", **(SMALL | change)))


# ------------------------------------------------------------------------------ going on


def flat(training: Training) -> Tensor:
    return torch.cat([w.detach().flatten() for p in training.players for w in p.values()])


@pytest.mark.parametrize(
    ("method", "more"),
    [
        *((method, {}) for method in METHODS),
        ("ppo", {"reward_scale": "domain"}),
        ("ipo", {"variable_phi": True}),
    ],
)
def test_a_restored_training_goes_on_as_if_nothing_had_happened(method, more):
    changes = {"normalize_rewards": True, "normalize_advantages": "rollout", "num_steps": 18}
    settings = PPOSettings(method, **(SMALL | changes | more))
    whole = trainings(settings)
    for _ in range(4):
        whole.update()
    first = trainings(settings)
    for _ in range(2):
        first.update()
    second = trainings(settings)
    second.restore(first.state())
    for _ in range(2):
        second.update()
    assert torch.equal(flat(second), flat(whole))
    moves = 1 + settings.variable_phi
    assert second.num_frames == whole.num_frames == 4 * moves * 4 * 18
    assert not torch.equal(flat(first), flat(whole))


def test_moments_of_each_weight_as_they_once_were_are_refused():
    training = trainings(PPOSettings("ppo", **SMALL))
    training.update()
    state = training.state()
    zeros = [torch.zeros_like(w) for w in training.players[0].values()]
    state["optimizers"][0] = [
        {"step": torch.tensor(1.0), "exp_avg": zero, "exp_avg_sq": zero} for zero in zeros
    ]
    with pytest.raises(ValueError, match="moments of shapes"):
        training.restore(state)


@pytest.mark.parametrize("d", [0, 1])
def test_a_player_who_goes_on_alone_collects_and_learns_alone(d):
    settings = PPOSettings("ipo", **(SMALL | {"num_steps": 18}))
    training = trainings(settings)
    training.update()
    before, seen = copied(training.players), [own.observation for own in training.collectors]
    training.update(only=d)
    for e, (old, new) in enumerate(zip(before, training.players, strict=True)):
        assert all(torch.equal(old[name], new[name]) for name in old) == (e != d)
    moved = [own.observation is not o for own, o in zip(training.collectors, seen, strict=True)]
    assert moved == [e == d for e in range(2)]
    assert training.num_frames == (4 + 2) * 18


def test_a_round_is_a_move_of_every_player_in_turn():
    settings = PPOSettings("ipo", **SMALL)
    together, in_turn = trainings(settings), trainings(settings)
    together.update()
    for d in range(2):
        in_turn.update(only=d)
    assert torch.equal(flat(together), flat(in_turn))


def test_training_goes_on_from_other_players():
    settings = PPOSettings("ipo", **SMALL)
    training, other = trainings(settings), trainings(settings, (2, 3))
    training.learners.set(other.players)
    assert torch.equal(flat(training), flat(other))
    training.update()
    assert not torch.equal(flat(training), flat(other))


def test_training_raises_what_is_rewarded():
    """The reward is the action: means must grow."""
    settings = PPOSettings(
        "ipo",
        **(SMALL | {"num_updates": 20, "learning_rate": 0.01, "normalize_advantages": "rollout"}),
    )
    *_, (_, players) = trainings(settings).reports()
    mean = NETWORK.frozen(players)(torch.ones(2, 1, 1))[0][..., 0]
    assert (mean > 0.5).all()


def test_runs_do_not_mix():
    settings = PPOSettings("ipo", **SMALL)
    together = trainings(settings, (0, 1))
    alone = trainings(settings, (1,))
    for training in (together, alone):
        training.update()
    for d in range(2):
        for name, weight in alone.players[d].items():
            torch.testing.assert_close(together.players[d][name][1:], weight, rtol=0, atol=1e-6)


# --------------------------------------------------------------------------- gymnasium's own


def vector(mode: AutoresetMode = AutoresetMode.SAME_STEP, num_envs: int = 4):
    return gym.make_vec(
        "Pendulum-v1",
        num_envs=num_envs,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": mode},
    )


def test_gymnasiums_environments_get_streams_of_their_own():
    first, again = (FromGymnasium(vector(), 2, seed=3).reset() for _ in range(2))
    assert torch.equal(first, again)
    assert first.shape == (2, 2, 3)
    other = FromGymnasium(vector(), 2, seed=4).reset()
    assert len({tuple(row.tolist()) for row in torch.cat([first, other]).flatten(0, 1)}) == 8


def test_gymnasiums_environments_may_have_a_seed_each():
    every = FromGymnasium(vector(), 2, seed=[5, 6, 7, 8]).reset().flatten(0, 1)
    turned = FromGymnasium(vector(), 2, seed=[8, 7, 6, 5]).reset().flatten(0, 1)
    assert torch.equal(every, turned.flip(0))
    with pytest.raises(ValueError, match="seed: 3 seeds, must be one for each of 4"):
        FromGymnasium(vector(), 2, seed=[5, 6, 7])


def test_continuous_actions_reach_gymnasiums_environments():
    copies = FromGymnasium(vector(), 2, seed=0)
    copies.reset()
    step = copies.step(torch.tensor([[[0.0], [2.0]], [[-2.0], [0.0]]]))
    assert step.reward.shape == (2, 2)
    assert math.isclose(float(copies.envs.envs[1].unwrapped.last_u), 2.0)


@pytest.mark.parametrize(
    ("envs", "num_runs", "error"),
    [
        (vector(AutoresetMode.NEXT_STEP), 1, "must have SAME_STEP"),
        (vector(), 3, "4 copies, must be a multiple of 3 runs"),
    ],
)
def test_vector_environments_that_do_not_fit_are_refused(envs, num_runs, error):
    with pytest.raises(ValueError, match=error):
        FromGymnasium(envs, num_runs, seed=0)
