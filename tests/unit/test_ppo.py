"""PPO and IPO: against a plain loop, by hand, and against changes that must not matter.

Rollouts of continuous actions, rewards and interruptions are in ``test_training.py``.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, replace

import numpy as np
import plain_ppo
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from hypothesis import given
from hypothesis import strategies as st
from minigrid.envs import EmptyEnv
from minigrid.wrappers import ImgObsWrapper
from small import DoubleNetwork, assert_close, clipped_loss, plain_network
from torch import Tensor

from experiments.keys import published
from experiments.regularized.networks import RegularizedSettings, training_of
from ipo.distributions import Categorical, Gaussian
from ipo.game import moves
from ipo.networks import Weights, copied
from ipo.optimizers import clip_gradient
from ipo.ppo import (
    METHODS,
    PPOSettings,
    Training,
    loss_gradient,
    minibatches,
)
from ipo.rollouts import Collector, Rollout, Step, advantages, value_errors
from ipo.worlds.colored_keys import ColoredKeysEnv
from ipo.worlds.minigrid_tables import tabulate
from ipo.worlds.networks import GridNetwork, OnTable
from ipo.worlds.tabular import TabularDomains, expected_return, optimal_policy
from ipo.worlds.vector_environments import FromGymnasium

SMALL = {
    "num_updates": 3,
    "num_envs": 4,
    "num_steps": 32,
    "minibatch_size": 24,
    "learning_rate": 1e-3,
    "discount": 127 / 128,  # exact in single precision: what is left is the order of sums
}


def streams(seed: int) -> list[np.random.Generator]:
    """Of a run: for weights and actions, for resets, for minibatches."""
    return [np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(3)]


# ------------------------------------------------------------- against a plain loop

COLORS = ("red", "green")
FIRST_SEED = 17


def short_task(domain: int) -> ImgObsWrapper:
    """Time-outs come often."""
    return ImgObsWrapper(EasyKeys(color=COLORS[domain], max_steps=19))


class EasyKeys(ColoredKeysEnv):
    """The door is open from the start, so that a beginner finds the goal now and then."""

    def _gen_grid(self, width: int, height: int) -> None:
        super()._gen_grid(width, height)
        for thing in self.grid.grid:
            if thing is not None and thing.type == "door":
                thing.is_locked, thing.is_open = False, True


def of_gymnasium(
    domains: Sequence[int], num_copies: Sequence[int], generators: Sequence
) -> FromGymnasium:
    """Copies of each domain for every run; different players get different seeds."""
    each = [d for d, number in zip(domains, num_copies, strict=True) for _ in range(number)]
    makers = [lambda d=d: short_task(d) for _ in generators for d in each]
    envs = SyncVectorEnv(makers, autoreset_mode=AutoresetMode.SAME_STEP)
    return FromGymnasium(envs, len(generators), seed=FIRST_SEED + sum(domains))


def plain_runs(settings: PPOSettings, num_domains: int, seeds: Sequence[int]) -> list[list]:
    """What the plain loop makes of every run: its players after the last update."""
    movers, owned = zip(*settings.moves(num_domains), strict=True)
    copies = [settings.num_envs // sum(map(len, owned))] * len(owned)
    if settings.variable_phi:
        owned += (list(range(num_domains)),)
        copies.append(settings.num_envs // num_domains)
    finished = []
    for r, seed in enumerate(seeds):
        draws, _, orders = streams(seed)
        players = [plain_network(DoubleNetwork().start([draws])) for _ in set(movers)]
        envs, firsts = [], []
        for domains, number in zip(owned, copies, strict=True):
            fast = of_gymnasium(domains, [number] * len(domains), seeds)
            num_copies = fast.envs.num_envs // len(seeds)
            firsts.append(fast.seeds[r * num_copies : (r + 1) * num_copies])
            envs.append([short_task(d) for d in domains for _ in range(number)])
        *_, players = plain_ppo.train(players, envs, settings, draws, orders, firsts, movers=movers)
        finished.append(players)
    return finished


def assert_same_players(players: Sequence[Weights], plain: list[list]) -> None:
    """All weights of all players in all runs."""
    for run, own in enumerate(plain):
        for player, network in zip(players, own, strict=True):
            ours, theirs = plain_network(player, run).parameters(), network.parameters()
            for weight, expected in zip(ours, theirs, strict=True):
                assert_close(weight.detach(), expected.detach(), rtol=1e-9)


ARMS = {
    "one player on one domain": ("ppo", 1, {}),
    "one player on two domains": ("ppo", 2, {}),
    "published PPO": ("ppo", 2, {"time_outs": "terminal", "skip_last_frames": True}),
    "normalised advantages": ("ppo", 1, {"normalize_advantages": "minibatch"}),
    "IPO": ("ipo", 2, {}),
    "published IPO": ("ipo", 2, {"time_outs": "terminal", "skip_last_frames": True}),
    "ensemble": ("ensemble", 2, {"num_envs": 8}),
    "one domain at a time": ("in_turn", 2, {}),
    "variable Phi": ("ipo", 2, {"variable_phi": True}),
    "variable Phi, two inner rounds": ("ipo", 2, {"variable_phi": True, "num_inner_rounds": 2}),
    "weight decay": ("ppo", 2, {"weight_decay": 1.0}),
    "penalty on the variance": ("ppo", 2, {"variance_penalty": 3.0}),
    "penalty on the scale": ("ppo", 2, {"scale_penalty": 30.0}),
    "other numbers": (
        "ipo",
        2,
        {
            "clip": 0.05,
            "clip_values": False,
            "value_weight": 2.0,
            "entropy_weight": 0.1,
            "max_gradient_norm": 0.1,
            "discount": 0.875,
            "gae_lambda": 0.5,
            "num_epochs": 3,
        },
    ),
}


@pytest.mark.parametrize(("method", "num_domains", "changes"), ARMS.values(), ids=ARMS.keys())
def test_learns_what_the_plain_loop_learns(method, num_domains, changes):
    """All weights after several updates in MiniGrid, two runs at once, to nine digits."""
    settings, seeds = RegularizedSettings(method, **(SMALL | changes)), [3, 5]
    network = DoubleNetwork()
    training = training_of(network, of_gymnasium, num_domains, settings, seeds)
    *_, (num_frames, players) = training.reports()
    in_a_round = settings.num_inner_rounds + settings.variable_phi
    frames_of_all = settings.num_envs * settings.num_steps
    assert num_frames == settings.num_updates * in_a_round * frames_of_all
    assert_same_players(players, plain_runs(settings, num_domains, seeds))


def test_the_comparison_sees_goals_and_time_outs():
    """Otherwise the plain loop would agree about nothing but zeros."""
    envs = of_gymnasium([0, 1], [2, 2], [None])
    envs.reset()
    rng, rewards, ends = np.random.default_rng(0), 0.0, torch.zeros(2)
    for _ in range(SMALL["num_updates"] * SMALL["num_steps"]):
        step = envs.step(torch.tensor(rng.integers(0, 7, size=(1, 4))))
        rewards += float(step.reward.sum())
        ends += torch.stack([step.terminated.sum(), step.truncated.sum()])
    assert rewards > 0 and (ends > 0).all()


# --------------------------------------------------------- changes that must not matter


def double_on_table(domains: TabularDomains) -> OnTable:
    return OnTable(DoubleNetwork(), torch.tensor(domains.images).double())


def trained(
    domains: TabularDomains, settings: PPOSettings, seeds: Sequence[int], num_domains: int = 2
) -> list[Weights]:
    training = Training(double_on_table(domains), domains, num_domains, settings, list(seeds))
    *_, (_, players) = training.reports()
    return copied(players)


@pytest.fixture(scope="module")
def pair(keys) -> TabularDomains:
    return TabularDomains([keys["red"], keys["green"]])


@pytest.mark.parametrize("method", METHODS)
def test_stacked_runs_learn_what_separate_runs_learn(pair, method):
    settings = PPOSettings(method, **SMALL)
    together = trained(pair, settings, [4, 0, 2])
    for r, seed in enumerate([4, 0, 2]):
        alone = trained(pair, settings, [seed])
        for ours, theirs in zip(together, alone, strict=True):
            for name, weight in theirs.items():
                assert_close(ours[name][r], weight[0], rtol=1e-7)


def test_runs_of_different_seeds_differ(pair):
    (player,) = trained(pair, PPOSettings("ppo", **SMALL), [0, 1])
    assert not torch.allclose(player["actor2.weight"][0], player["actor2.weight"][1], atol=0.1)


def test_same_seeds_learn_the_same(pair):
    settings = PPOSettings("ipo", **SMALL)
    for ours, theirs in zip(
        trained(pair, settings, [0]), trained(pair, settings, [0]), strict=True
    ):
        assert all(torch.equal(ours[name], theirs[name]) for name in theirs)


@pytest.mark.parametrize("method", ["ipo", "ensemble", "in_turn"])
def test_one_domain_makes_every_method_ppo(keys, method):
    domains = TabularDomains([keys["blue"]])
    ((ppo,), (other,)) = (
        trained(domains, PPOSettings(name, **SMALL), [0, 1], num_domains=1)
        for name in ("ppo", method)
    )
    assert all(torch.equal(ppo[name], other[name]) for name in ppo)


def test_inner_rounds_are_rounds_where_phi_is_fixed(pair):
    """So K means something only where Phi is variable, or where frames are not counted."""
    many = PPOSettings("ipo", **(SMALL | {"num_updates": 4}))
    inner = PPOSettings("ipo", **(SMALL | {"num_updates": 2, "num_inner_rounds": 2}))
    for ours, theirs in zip(trained(pair, inner, [0]), trained(pair, many, [0]), strict=True):
        assert all(torch.equal(ours[name], theirs[name]) for name in theirs)


def test_players_share_phi_where_it_is_variable_and_nothing_else(pair):
    settings = PPOSettings("ipo", **(SMALL | {"variable_phi": True}))
    first, second = trained(pair, settings, [0, 1])
    shared = {name for name in first if torch.equal(first[name], second[name])}
    assert shared == {name for name in first if name.startswith("conv")}


@pytest.mark.parametrize("part", [0, 1, 2])
def test_only_the_part_whose_turn_it_is_moves(part):
    settings = PPOSettings("ipo", minibatch_size=8, num_steps=6, variable_phi=True)
    training = in_training(settings, num_players=2)
    before = [row.clone() for row in training.learners.rows]
    training.improve(part, random_frames().frames())
    moved = [not torch.equal(*rows) for rows in zip(before, training.learners.rows, strict=True)]
    assert moved == [number == part for number in range(3)]


def test_ppo_is_the_pooled_game():
    assert PPOSettings("ppo").moves(3) == moves("pooled", 3)


@pytest.mark.parametrize(
    ("method", "num_players"), [("ppo", 1), ("ipo", 3), ("ensemble", 3), ("in_turn", 1)]
)
def test_three_domains(keys, method, num_players):
    domains = TabularDomains([keys[color] for color in ("red", "green", "blue")])
    settings = PPOSettings(method, **(SMALL | {"num_envs": 9, "num_updates": 1}))
    assert len(trained(domains, settings, [0], num_domains=3)) == num_players


def test_table_learns_what_images_learn(pair):
    """Evaluating each distinct observation once changes nothing but the time it takes."""

    class OnImages(DoubleNetwork):
        def __call__(self, weights: Weights, indices: Tensor) -> tuple[Tensor, Tensor]:
            return super().__call__(weights, torch.tensor(pair.images)[indices])

    settings = PPOSettings("ipo", **SMALL)
    *_, (_, slow) = Training(OnImages(), pair, 2, settings, [0, 1]).reports()
    for ours, theirs in zip(trained(pair, settings, [0, 1]), slow, strict=True):
        for name, weight in theirs.items():
            assert_close(ours[name], weight.detach(), rtol=1e-7)


def test_reports_count_frames_and_begin_before_training(pair):
    settings = PPOSettings("ipo", **SMALL)
    reports = Training(double_on_table(pair), pair, 2, settings, [0]).reports()
    frames, players = next(reports)
    draws = streams(0)[0]
    for player in players:
        for name, weight in DoubleNetwork().start([draws]).items():
            assert torch.equal(player[name].detach(), weight)
    assert [frames, *(frames for frames, _ in reports)] == [0, 128, 256, 384]


def random_frames(
    seed: int = 0, num_runs: int = 2, num_copies: int = 4, num_steps: int = 6, num_rows: int = 5
) -> Rollout:
    """``[R, N, T]`` with indices of a table as observations."""
    rng = np.random.default_rng(seed)
    shape = num_runs, num_copies, num_steps
    values, gains = (torch.tensor(rng.normal(size=shape)) for _ in range(2))
    return Rollout(
        observations=torch.tensor(rng.integers(0, num_rows, size=shape)),
        actions=torch.tensor(rng.integers(0, 7, size=shape)),
        log_probabilities=torch.tensor(-rng.uniform(1.5, 2.5, size=shape)),
        values=values,
        advantages=gains,
        returns=values + gains,
    )


class Nowhere:
    """Environments in which nothing is collected."""

    def reset(self) -> Tensor:
        return torch.zeros(2, 4)

    def step(self, actions: Tensor) -> Step:
        raise AssertionError("nothing must be collected")


def in_training(settings: PPOSettings, num_players: int = 1) -> Training:
    """Two runs of players who learn from a table with five rows, with frames by hand."""
    table = torch.arange(5 * 147.0, dtype=torch.float64).reshape(5, 7, 7, 3) % 11
    network = OnTable(DoubleNetwork(), table)
    return Training(network, lambda *_: Nowhere(), num_players, settings, [0, 1])


def moved(
    rollout: Rollout, settings: PPOSettings, d: int = 0, num_players: int = 1
) -> tuple[list[Weights], list[Weights]]:
    """All players before and after player d's move."""
    training = in_training(settings, num_players)
    before = copied(training.players)
    training.improve(d, rollout.frames())
    return before, copied(training.players)


def test_order_of_domains_in_a_rollout_does_not_matter():
    """With one minibatch for all frames, their order is nobody's business."""
    settings = PPOSettings("ppo", minibatch_size=24, num_steps=6)
    rollout = random_frames()
    permuted = Rollout(*(x[:, [2, 3, 0, 1]] for x in rollout))
    for ours, theirs in zip(moved(rollout, settings)[1], moved(permuted, settings)[1], strict=True):
        for name, weight in theirs.items():
            assert_close(ours[name], weight, rtol=1e-10)


@pytest.mark.parametrize("d", [0, 1, 2])
def test_only_the_player_whose_turn_it_is_moves(d):
    settings = PPOSettings("ipo", minibatch_size=8, num_steps=6)
    before, after = moved(random_frames(), settings, d, num_players=3)
    for e, (old, new) in enumerate(zip(before, after, strict=True)):
        same = [torch.equal(old[name], new[name]) for name in old]
        assert not any(same) if e == d else all(same)


# --------------------------------------------------------------------------- advantages


def slow_advantages(rewards, values, next_values, ended, discount, gae_lambda) -> list[float]:
    """A_t = sum_k (gamma lambda)^k delta_(t+k), up to the first end at or after t."""
    deltas = [
        reward - value + (0 if end else discount * later)
        for reward, value, later, end in zip(rewards, values, next_values, ended, strict=True)
    ]
    gains = []
    for t in range(len(deltas)):
        gain, factor = 0.0, 1.0
        for k in range(t, len(deltas)):
            gain += factor * deltas[k]
            factor *= discount * gae_lambda
            if ended[k]:
                break
        gains.append(gain)
    return gains


@given(
    seed=st.integers(0, 10_000),
    num_steps=st.integers(1, 12),
    discount=st.floats(0, 1),
    gae_lambda=st.floats(0, 1),
)
def test_advantages_are_the_sum_by_hand(seed, num_steps, discount, gae_lambda):
    rng = np.random.default_rng(seed)
    shape = 2, 3, num_steps
    rewards = torch.tensor(rng.normal(size=shape))
    values = torch.tensor(rng.normal(size=(2, 3, num_steps + 1)))
    ended = torch.tensor(rng.random(shape) < 0.3)
    errors = value_errors(rewards, values, ended, discount)
    found = advantages(errors, ended, discount * gae_lambda)
    for place in np.ndindex(2, 3):
        rows = (x[place].tolist() for x in (rewards, values[..., :-1], values[..., 1:], ended))
        slow = slow_advantages(*rows, discount, gae_lambda)
        assert found[place].tolist() == pytest.approx(slow, rel=1e-10, abs=1e-12)


def test_advantages_of_three_steps_by_hand():
    """gamma = 1/2, lambda = 1/2; the second step ends an episode."""
    rewards, values = torch.tensor([0.0, 1.0, 0.0]), torch.tensor([2.0, 4.0, 8.0, 16.0])
    ended = torch.tensor([False, True, False])
    errors = value_errors(rewards, values, ended, 0.5)
    assert errors.tolist() == [0 + 2 - 2, 1 - 4, 0 + 8 - 8]
    assert advantages(errors, ended, 0.25).tolist() == [-0.75, -3.0, 0.0]


def test_full_lambda_is_the_discounted_sum_of_rewards_less_the_value():
    rewards, values = torch.tensor([1.0, 2.0, 3.0]), torch.tensor([5.0, 6.0, 7.0, 99.0])
    ended = torch.tensor([False, False, True])
    found = advantages(value_errors(rewards, values, ended, 0.5), ended, 0.5)
    assert found.tolist() == [1 + 1 + 0.75 - 5, 2 + 1.5 - 6, 3 - 7]


# ----------------------------------------------------------------------------- rollouts


class Script:
    """One run and one copy that answer the same whatever is done: rewards, and two ends."""

    def __init__(self, ends: Sequence[str]) -> None:
        self.ends = ends

    def reset(self) -> Tensor:
        self.t = 0
        return torch.tensor([[0]])

    def step(self, actions: Tensor) -> Step:
        end = self.ends[self.t]
        self.t += 1
        return Step(
            torch.tensor([[self.t]]),
            torch.tensor([[float(self.t)]]),
            torch.tensor([["terminated" in end]]),
            torch.tensor([["truncated" in end]]),
            torch.tensor([[100 + self.t]]),
        )


def scripted_policy(observation: Tensor) -> tuple[Tensor, Tensor]:
    """Two actions of equal probability; the value of what is seen is ten times its number."""
    return torch.zeros(1, 1, 2), 10.0 * observation


def scripted_rollout(ends: Sequence[str], time_outs: str) -> tuple[Rollout, Tensor]:
    """With lambda = 0: advantages are deltas. Also what is seen after it."""
    collector = Collector(Script(ends), len(ends), 0.5, 0.0, time_outs)
    rollout = collector.collect(scripted_policy, Categorical, [np.random.default_rng(0)])
    return rollout, collector.observation


@pytest.mark.parametrize(
    ("end", "time_outs", "future"),
    [
        ("", "bootstrap", 0.5 * 20),  # goes on: the value of observation 2
        ("", "terminal", 0.5 * 20),
        ("truncated", "bootstrap", 0.5 * 1020),  # of what was seen last, 102
        ("truncated", "terminal", 0),
        ("terminated", "bootstrap", 0),
        ("terminated", "terminal", 0),
        ("terminated, truncated", "terminal", 0),
        ("terminated, truncated", "bootstrap", 0),  # the goal in the last step of the horizon
    ],
)
def test_future_after_the_end_of_a_step(end, time_outs, future):
    rollout, last = scripted_rollout(["", end, ""], time_outs)
    assert last.tolist() == [[3]]
    assert rollout.observations.tolist() == [[[0, 1, 2]]]
    assert rollout.values.tolist() == [[[0, 10, 20]]]
    assert rollout.log_probabilities[0, 0].tolist() == pytest.approx([-math.log(2)] * 3)
    # r_t + gamma V(o_(t+1)) - V(o_t), the last one with the value after the rollout.
    assert rollout.advantages.tolist() == [[[1 + 5 - 0, 2 + future - 10, 3 + 15 - 20]]]
    assert torch.equal(rollout.returns, rollout.values + rollout.advantages)


def test_gymnasium_shows_what_was_seen_last():
    """Copies begin anew in the step in which they end; runs keep their own copies."""
    envs = of_gymnasium([0, 1], [1, 1], [None, None])
    observation = envs.reset()
    assert observation.shape == (2, 2, 7, 7, 3)
    slow = [short_task(d) for _ in range(2) for d in range(2)]
    seen = [env.reset(seed=seed)[0] for env, seed in zip(slow, envs.seeds, strict=True)]
    rng, num_ends = np.random.default_rng(0), 0
    for _ in range(60):
        assert np.array_equal(observation.flatten(0, 1), np.stack(seen))
        actions = rng.integers(0, 7, size=(2, 2))
        step = envs.step(torch.tensor(actions))
        for n, env in enumerate(slow):
            seen[n], reward, terminated, truncated, _ = env.step(actions.flat[n])
            assert np.array_equal(step.last_observation.flatten(0, 1)[n], seen[n])
            assert step.reward.flatten()[n] == np.float32(reward)
            assert bool(step.terminated.flatten()[n]) == terminated
            assert bool(step.truncated.flatten()[n]) == truncated
            if terminated or truncated:
                seen[n], _ = env.reset()
                num_ends += 1
        observation = step.observation
    assert num_ends >= 12


def test_each_action_is_as_likely_as_the_logits_say():
    logits = torch.tensor([0.0, -math.inf, math.log(2), math.log(3), -math.inf])
    actions = Categorical.sample(logits.expand(1, 60_000, 5), [np.random.default_rng(0)])
    counts = torch.bincount(actions[0], minlength=5) / 60_000
    assert counts.tolist() == pytest.approx([1 / 6, 0, 1 / 3, 1 / 2, 0], abs=0.01)


def test_no_draw_leads_beyond_the_last_action():
    class Highest:
        def random(self, size: int) -> np.ndarray:
            return np.full(size, np.nextafter(1, 0))

    logits = torch.zeros(1, 3, 7)  # in single precision their probabilities sum to less than 1
    assert Categorical.sample(logits, [Highest()]).tolist() == [[6, 6, 6]]


def test_entropy_of_equal_probabilities():
    assert Categorical.entropy(torch.zeros(1, 1, 7)).item() == pytest.approx(math.log(7))


# --------------------------------------------------------------------------------- loss


def slow_loss(logits, values, batch: Rollout, s: PPOSettings, run: int) -> float:
    """Frame by frame, in numbers of Python."""
    frames = range(values.shape[1])
    gains = [float(batch.advantages[run, i]) for i in frames]
    if s.normalize_advantages == "minibatch":
        mean = sum(gains) / len(gains)
        variance = sum((gain - mean) ** 2 for gain in gains) / (len(gains) - 1)
        gains = [(gain - mean) / (math.sqrt(variance) + 1e-8) for gain in gains]
    total = 0.0
    for i in frames:
        scores = [math.exp(score) for score in logits[run, i].tolist()]
        probabilities = [score / sum(scores) for score in scores]
        chosen = probabilities[int(batch.actions[run, i])]
        ratio = chosen / math.exp(float(batch.log_probabilities[run, i]))
        near = min(max(ratio, 1 - s.clip), 1 + s.clip)
        surprise = -sum(p * math.log(p) for p in probabilities)
        old, new = float(batch.values[run, i]), float(values[run, i])
        target = float(batch.returns[run, i])
        near_value = old + min(max(new - old, -s.clip), s.clip) if s.clip_values else new
        error = max((new - target) ** 2, (near_value - target) ** 2)
        policy_loss = -min(ratio * gains[i], near * gains[i])
        total += policy_loss - s.entropy_weight * surprise + s.value_weight * error
    return total / len(frames)


@given(
    seed=st.integers(0, 10_000),
    clip=st.floats(0.01, 1),
    entropy_weight=st.floats(0, 1),
    value_weight=st.floats(0, 1),
    clip_values=st.booleans(),
    normalize=st.sampled_from(["none", "minibatch"]),
)
def test_loss_is_that_by_hand(seed, clip, entropy_weight, value_weight, clip_values, normalize):
    settings = PPOSettings(
        "ppo",
        clip=clip,
        clip_values=clip_values,
        entropy_weight=entropy_weight,
        value_weight=value_weight,
        normalize_advantages=normalize,
    )
    batch = random_frames(seed, num_copies=2, num_steps=4).frames()
    rng = np.random.default_rng(seed)
    logits = torch.tensor(rng.normal(size=(2, 8, 7)))
    values = batch.values + torch.tensor(0.3 * rng.normal(size=(2, 8)))
    found = clipped_loss(Categorical, logits, values, batch, settings)
    expected = [slow_loss(logits, values, batch, settings, run) for run in range(2)]
    assert found.tolist() == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize(
    ("ratio", "gain", "expected"),
    [
        (1.0, 2.0, -2.0),
        (1.5, 2.0, -2.4),  # no reward for going beyond 1.2
        (1.5, -2.0, 3.0),  # but a full penalty
        (0.5, 2.0, -1.0),
        (0.5, -2.0, 1.6),  # no reward for going below 0.8
    ],
)
def test_clipped_objective_by_hand(ratio, gain, expected):
    """Two actions of probability 1/2 now; the old one was 1 / (2 ratio)."""
    one = torch.ones(1, 1, dtype=torch.float64)
    batch = Rollout(
        observations=one,
        actions=one.long(),
        log_probabilities=one * math.log(0.5 / ratio),
        values=one,
        advantages=gain * one,
        returns=one,
    )
    settings = PPOSettings("ppo", clip=0.2, entropy_weight=0.0, value_weight=0.0)
    loss = clipped_loss(Categorical, torch.zeros(1, 1, 2).double(), one, batch, settings)
    assert loss.tolist() == pytest.approx([expected])


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (1.0, 4.0),  # old value 1, return 3: where it was
        (1.1, 3.61),  # a small step counts in full
        (2.9, 3.24),  # a large one only as far as 1.2
        (9.0, 36.0),  # unless it makes things worse
    ],
)
def test_clipped_error_of_the_value_by_hand(value, expected):
    one = torch.ones(1, 1, dtype=torch.float64)
    zero = torch.zeros(1, 1, dtype=torch.float64)
    batch = Rollout(one, one.long(), zero, one, zero, 3 * one)
    settings = PPOSettings("ppo", clip=0.2, entropy_weight=0.0, value_weight=1.0)
    loss = clipped_loss(Categorical, torch.zeros(1, 1, 2).double(), value * one, batch, settings)
    assert loss.tolist() == pytest.approx([expected])


def test_gradient_is_zero_where_the_ratio_is_clipped():
    batch = random_frames(num_copies=1, num_steps=5).frames()
    logits = torch.zeros(2, 5, 7, dtype=torch.float64)
    batch = batch._replace(
        log_probabilities=torch.full((2, 5), math.log(1 / 7 / 1.5)).double(),
        advantages=batch.advantages.abs(),
    )
    settings = PPOSettings("ppo", entropy_weight=0.0, value_weight=0.0)
    slopes = loss_gradient(Categorical, logits, batch.values, batch, settings)
    assert not any(slope.any() for slope in slopes)


@pytest.mark.parametrize("distribution", [Categorical, Gaussian])
@pytest.mark.parametrize("dtype, rtol", [(torch.float64, 1e-12), (torch.float32, 1e-5)])
@pytest.mark.parametrize("clip_values", [True, False])
@pytest.mark.parametrize("normalize", ["none", "minibatch"])
def test_gradient_of_the_loss_is_that_of_torch(distribution, dtype, rtol, clip_values, normalize):
    """On frames of which many are clipped, in the ratio, in the value, in both and in neither."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(2, 400, *shape, generator=generator, dtype=dtype)

    parameters, values = normal(6), normal()
    actions = normal(3)
    if distribution is Categorical:
        actions = actions.abs().argmax(-1)
    else:
        parameters[..., 3:].exp_()
    old = distribution.log_probability(parameters, actions) + 0.3 * normal()
    batch = Rollout(values, actions, old, values + 0.3 * normal(), normal(), normal())
    settings = PPOSettings("ppo", clip_values=clip_values, normalize_advantages=normalize)
    leaves = [x.clone().requires_grad_() for x in (parameters, values)]
    loss = clipped_loss(distribution, *leaves, batch, settings)
    expected = torch.autograd.grad(loss.sum(), leaves)
    found = loss_gradient(distribution, parameters, values, batch, settings)
    for ours, theirs in zip(found, expected, strict=True):
        constant = ours == 0  # where the entropy has no say: in the values
        assert_close(ours, theirs, rtol)
    assert 0.1 < constant.double().mean() < 0.9 if clip_values else not constant.any()


@pytest.mark.parametrize("max_norm", [0.1, 0.5, 1000.0])
def test_gradients_are_clipped_run_by_run(max_norm):
    rng = np.random.default_rng(0)
    gradients = [torch.tensor(rng.normal(size=(3, *shape))) for shape in ((4, 5), (5,), (2, 1, 2))]
    in_rows = clip_gradient(torch.cat([g.flatten(1) for g in gradients], 1), max_norm)
    clipped = [
        part.reshape(own.shape)
        for part, own in zip(in_rows.split([20, 5, 4], 1), gradients, strict=True)
    ]
    for run in range(3):
        leaves = [torch.zeros(g.shape[1:], dtype=g.dtype, requires_grad=True) for g in gradients]
        for leaf, gradient in zip(leaves, gradients, strict=True):
            leaf.grad = gradient[run].clone()
        torch.nn.utils.clip_grad_norm_(leaves, max_norm)
        for leaf, ours in zip(leaves, clipped, strict=True):
            assert_close(ours[run], leaf.grad, rtol=1e-5)  # torch adds 1e-6 to the norm


def test_no_gradient_stays_no_gradient():
    assert clip_gradient(torch.zeros(2, 3), 0.5).tolist() == [[0, 0, 0]] * 2


# -------------------------------------------------------------------------- minibatches


@given(
    seed=st.integers(0, 1000),
    num_copies=st.integers(1, 5),
    num_steps=st.integers(1, 9),
    skip=st.booleans(),
    data=st.data(),
)
def test_minibatches_are_a_partition(seed, num_copies, num_steps, skip, data):
    num_frames = num_copies * num_steps
    size = data.draw(st.integers(1, num_frames))
    settings = PPOSettings("ppo", num_steps=num_steps, minibatch_size=size)
    frames = random_frames(num_runs=3, num_copies=num_copies, num_steps=num_steps).frames()
    generators = [np.random.default_rng([seed, run]) for run in range(3)]
    numbers = torch.arange(num_frames).expand(3, -1)
    batches = [x for _, (x,) in minibatches(frames, [numbers], settings, generators, skip)]
    expected = {n * num_steps + t for n in range(num_copies) for t in range(num_steps - skip)}
    assert all(batch.shape == (3, size) for batch in batches[:-1])
    for run in range(3):
        seen = [int(i) for batch in batches for i in batch[run]]
        assert len(seen) == len(expected) and set(seen) == expected


def test_runs_have_orders_of_their_own():
    settings = PPOSettings("ppo", num_steps=10, minibatch_size=40)
    frames = random_frames(num_steps=10).frames()
    numbers = torch.arange(40).expand(2, -1)

    def order(*seeds: int) -> Tensor:
        generators = [np.random.default_rng(seed) for seed in seeds]
        ((_, (chosen,)),) = minibatches(frames, [numbers], settings, generators, False)
        return chosen

    together = order(0, 1)
    assert not torch.equal(together[0], together[1])
    assert torch.equal(together[1], order(1, 1)[0])


@pytest.mark.parametrize("num_epochs", [1, 2, 3, 4])
def test_every_second_epoch_leaves_out_the_last_frames(num_epochs):
    """The last frame of each copy is the only one with something to learn from.

    One epoch that leaves it out moves nothing but by the entropy, which is switched off.
    """
    rollout = random_frames()
    rollout.advantages[..., :-1] = 0
    rollout = rollout._replace(returns=rollout.values + rollout.advantages)
    settings = PPOSettings(
        "ppo",
        num_steps=6,
        minibatch_size=24,
        entropy_weight=0.0,
        value_weight=0.0,
        skip_last_frames=True,
        num_epochs=num_epochs,
    )

    class Watched(torch.optim.Adam):
        def step(self) -> None:
            norms.append(max(float(w.grad.abs().max()) for w in self.param_groups[0]["params"]))
            super().step()

    norms: list[float] = []
    training = in_training(settings)
    training.learners.optimizers[0] = Watched([training.learners.rows[0]], 1e-9)
    training.improve(0, rollout.frames())
    assert [norm > 0 for norm in norms] == [True, False, True, False][:num_epochs]


# ----------------------------------------------------------------------------- settings


def test_published_settings_are_the_papers():
    paper = {
        "num_updates": 20,
        "num_inner_rounds": 1,
        "variable_phi": False,
        "num_envs": 48,
        "num_steps": 128,
        "num_epochs": 4,
        "minibatch_size": 256,
        "num_minibatches": None,
        "clip": 0.2,
        "clip_values": True,
        "value_weight": 0.5,
        "entropy_weight": 0.01,
        "max_gradient_norm": 0.5,
        "adam_epsilon": 1e-8,
        "discount": 0.99,
        "gae_lambda": 0.95,
        "normalize_rewards": False,
        "reward_scale": "player",
        "normalize_advantages": "none",
        "time_outs": "terminal",
        "skip_last_frames": True,
    }
    for method, learning_rate in (("ppo", 1e-3), ("ipo", 5e-4), ("ensemble", 1e-3)):
        expected = paper | {"method": method, "learning_rate": learning_rate, "reward_clip": 10.0}
        assert asdict(published(method)) == expected
    settings = published("ppo")
    assert settings.num_updates * settings.num_envs * settings.num_steps == 122_880


def test_published_settings_with_changes():
    assert published("ipo", learning_rate=1e-3) == replace(published("ipo"), learning_rate=1e-3)


def test_time_outs_are_no_ends_by_default():
    assert PPOSettings("ppo").time_outs == "bootstrap"
    assert not PPOSettings("ppo").skip_last_frames


# ----------------------------------------------------------------------------- learning


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_a_known_small_task_is_learned_to_its_optimum(method):
    """Empty-5x5, twice as two domains, with the paper's numbers: the goal is five steps away.

    In each of ten runs the most likely actions are optimal; those that are drawn cost a little,
    since the entropy in the objective keeps some of them random.
    """
    task = tabulate(EmptyEnv(size=5))
    best = optimal_policy(task)[1]
    assert best == pytest.approx(1 - 0.9 * 5 / 100)
    domains = TabularDomains([task, task])
    network = OnTable(GridNetwork(), torch.tensor(domains.images).float())
    settings, seeds = PPOSettings(method, num_updates=10), list(range(10))
    *_, (_, players) = Training(network, domains, 2, settings, seeds).reports()
    logits = network.average(players)[0][:, domains.observation_of[0]]
    greedy = np.eye(7)[Categorical.mode(logits).numpy()]
    drawn, success = expected_return(task, logits.softmax(-1).numpy())
    assert expected_return(task, greedy)[0] == pytest.approx(best)
    assert (drawn > 0.95 * best).all()
    assert (success > 0.999).all()


@pytest.mark.slow
def test_a_known_small_task_is_learned_over_gymnasium():
    """The same task and loop without a table, one run."""
    task, network = tabulate(EmptyEnv(size=5)), GridNetwork()
    makers = [lambda: ImgObsWrapper(EmptyEnv(size=5))] * 16

    def make(domains: list[int], num_copies: list[int], generators: Sequence) -> FromGymnasium:
        return FromGymnasium(SyncVectorEnv(makers, autoreset_mode=AutoresetMode.SAME_STEP), 1, 0)

    settings = PPOSettings("ppo", num_envs=16, num_updates=20)
    *_, (_, players) = Training(network, make, 1, settings, [0]).reports()
    logits, _ = network.frozen(players)(torch.tensor(task.images).float()[None])
    returns, _ = expected_return(task, logits.softmax(-1).numpy())
    assert returns[0] > 0.95 * optimal_policy(task)[1]
