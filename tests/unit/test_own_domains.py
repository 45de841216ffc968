"""Training and comparing in one's own domains: actions, images, files, controls, clear errors."""

import sys
import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from threadpoolctl import threadpool_info

from ipo.distributions import Categorical, Gaussian
from ipo.networks import DenseNetwork
from ipo.own_domains import (
    Policy,
    check_domains,
    compare,
    default_settings,
    evaluate_policy,
    train_policy,
)
from ipo.own_domains.copies import Copies
from ipo.own_domains.networks import ImageNetwork, VectorNetwork
from ipo.ppo import METHODS

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


def pole(name, value):
    """A domain whose parameter lies where it is set: on the environment, or on its wrapper."""

    def make():
        env = gymnasium.make("CartPole-v1", disable_env_checker=True)
        setattr(env.unwrapped if name == "length" else env, name.removeprefix("wrapped "), value)
        return env

    return make


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
    domains = {f"pole {d}": pole("length", 0.4 + 0.2 * d) for d in range(2)}
    both = train_policy(domains, "ipo", seeds=[1, 4], **TINY)
    alone = train_policy(domains, "ipo", seeds=[4], **TINY)
    for one, other in zip(both.players, alone.players, strict=True):
        for name in one:
            assert torch.allclose(one[name][1], other[name][0], atol=1e-6), name


def test_controls_have_equal_frames_and_the_rates_they_are_named_after():
    for n in (2, 3, 4, 5):
        sizes = set()
        for method in METHODS:
            copies = default_settings(method, n).copies(n)
            sizes.add(sum(map(sum, copies)))
        assert len(sizes) == 1
    rows = compare(lines(0, 1), lines(2), seeds=[0], controls=True, num_episodes=1, **TINY)
    assert set(rows["method"]) == {
        "ppo",
        "ipo",
        "ppo_lr0.0005",
        "ipo_lr0.001",
        "ensemble",
        "in_turn",
    }
    assert set(rows["domain"]) == {"line 0", "line 1", "line 2"}
    without = compare(lines(0, 1), lines(2), seeds=[0], num_episodes=1, **TINY)
    assert set(without["method"]) == {"ppo", "ipo"}


BYTES = spaces.Box(0, 255, (9, 7, 3), np.uint8)
VECTORS = spaces.Box(-1, 1, (3,), np.float32)
FORCE = spaces.Box(-1, 1, (2,), np.float32)


@pytest.mark.parametrize("actions", [spaces.Discrete(2), FORCE])
@pytest.mark.parametrize("observations", [VECTORS, BYTES])
def test_a_policy_acts_within_its_spaces_and_survives_its_file(tmp_path, observations, actions):
    spaces_ = {"observation_space": observations, "action_space": actions}
    policy = train_policy(lines(0, 1, **spaces_), "ipo", seeds=[0, 3], **TINY)
    assert repr(policy) == "Policy(label='ipo', seeds=(0, 3))"
    policy.save(tmp_path / "policy")
    again = Policy.load(tmp_path / "policy")
    assert [file.name for file in tmp_path.iterdir()] == ["policy"]
    assert repr(again) == repr(policy)
    assert (again.observations, again.actions) == (observations, actions)
    seen = observations.sample()
    action = policy.act(seen, run=1)
    assert actions.contains(np.int64(action) if actions.shape == () else action)
    assert np.array_equal(again.act(seen, run=1), action)
    evaluate_policy(again, lines(2, **spaces_), num_episodes=1)
    with pytest.raises(ValueError, match=r"observation: has shape \(4,\), must have"):
        policy.act(np.zeros(4))
    with pytest.raises(ValueError, match="run = 2: must be at most 1"):
        policy.act(seen, run=2)


def test_actions_are_clipped_to_the_space():
    policy = train_policy(lines(0, 1, action_space=FORCE), "ipo", **TINY)
    for player in policy.players:
        player["actor3.bias"] += 9.0
    assert policy.act(np.zeros(3)).tolist() == [1.0, 1.0]


def test_no_flipped_bit_changes_a_policy_in_silence(tmp_path):
    policy = train_policy(lines(0, 1), "ipo", network=DenseNetwork(3, 2, Categorical, (4,)), **TINY)
    path = tmp_path / "policy"
    policy.save(path)
    whole, refused = path.read_bytes(), 0
    for place in np.random.default_rng(0).integers(8 * len(whole), size=200).tolist():
        flipped = bytearray(whole)
        flipped[place // 8] ^= 1 << place % 8
        path.write_bytes(flipped)
        try:
            again = Policy.load(path, policy.network)
        except Exception:
            refused += 1
            continue
        for own, same in zip(policy.players, again.players, strict=True):  # a date, or the like
            assert all(torch.equal(own[name], same[name]) for name in own)
    assert refused > 100


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        (None, "path = .*: is no file that Policy.save wrote"),
        ({"a": 1}, "path = .*: is no file that Policy.save wrote"),
        (
            {"format": np.array([print], dtype=object)},
            "path = .*: is no file that .* Object arrays",
        ),
    ],
)
def test_a_foreign_file_is_refused_and_not_executed(tmp_path, arrays, message):
    path = tmp_path / "policy.npz"
    np.savez(path, **arrays) if arrays else path.write_text("no policy")
    with pytest.raises(ValueError, match=message):
        Policy.load(path)


def test_images_of_each_run_are_seen_with_its_own_weights_and_in_either_order():
    last, first = ImageNetwork((9, 7, 3), 2, Categorical), ImageNetwork((3, 9, 7), 2, Categorical)
    weights = last.start([np.random.default_rng(seed) for seed in range(2)])
    images = torch.randint(0, 256, (2, 5, 9, 7, 3), dtype=torch.uint8)
    logits, values = last(weights, images)
    assert (logits.shape, values.shape) == ((2, 5, 2), (2, 5))
    for run in range(2):
        own = {name: weight[run : run + 1] for name, weight in weights.items()}
        alone, _ = last(own, images[run : run + 1].float() / 255)
        assert torch.allclose(alone[0], logits[run], atol=1e-6)
    assert torch.allclose(first(weights, images.movedim(-1, 2))[0], logits, atol=1e-6)
    # One convolution by hand, at the corner of the first image.
    padded = torch.nn.functional.pad(images[0, 0].movedim(-1, 0) / 255, (1, 1, 1, 1))
    corner = padded[:, :3, :3].flatten() @ weights["conv1.weight"][0, :, 0]
    kernel = weights["conv1.weight"][0].T.reshape(-1, 3, 3, 3)
    assert torch.isclose((padded[:, :3, :3] * kernel[0]).sum(), corner)


def test_a_policy_starts_without_preferences():
    weights = VectorNetwork(3, 4, Categorical).start([np.random.default_rng(0)])
    logits, values = VectorNetwork(3, 4, Categorical)(weights, torch.randn(1, 50, 3))
    assert (logits.softmax(-1) - 0.25).abs().max() < 0.01 < values.std()


class Counting(gymnasium.Env):
    """Counts its steps in one array, which it returns each time; ends where it is told to."""

    observation_space, action_space = VECTORS, spaces.Discrete(2)

    def __init__(self, end=3, nan_in=None, value=np.nan):
        self.end, self.nan_in, self.value = end, nan_in, value
        self.seen = np.zeros(3, np.float32)

    def reset(self, *, seed=None, options=None):
        self.seen[:] = 0
        return self.seen, {}

    def step(self, action):
        self.seen += 1
        if self.nan_in == "observation":
            self.seen[2] = self.value
        reward = self.value if self.nan_in == "reward" else 1.0
        return self.seen, reward, False, self.seen[0] == self.end, {}


def test_what_is_kept_is_not_what_the_environment_writes_to():
    copies = Copies(["a"], {"a": Counting}, [np.random.default_rng(0)])
    start = copies.reset()
    steps = [copies.step(torch.zeros(1, 1, dtype=torch.int64)) for _ in range(3)]
    assert start[0, 0, 0] == 0
    assert [step.observation[0, 0, 0].item() for step in steps] == [1, 2, 0]
    assert [step.last_observation[0, 0, 0].item() for step in steps] == [1, 2, 3]
    assert [step.truncated.item() for step in steps] == [False, False, True]


@pytest.mark.parametrize(
    ("what", "value", "message"),
    [
        ("observation", np.nan, r"^domain 'b': observation\[2\] = nan, must be finite"),
        ("reward", np.nan, "^domain 'b': reward = nan, must be finite"),
        ("reward", -np.inf, "^domain 'b': reward = -inf, must be finite"),
    ],
)
def test_what_is_not_a_number_is_an_error_that_names_its_domain(what, value, message):
    domains = {"a": Counting, "b": lambda: Counting(nan_in=what, value=value)}
    with pytest.raises(ValueError, match=message):
        train_policy(domains, "ipo", **TINY)


def test_evaluation_refuses_other_spaces_and_episodes_without_an_end():
    policy = train_policy(lines(0, 1), "ppo", **TINY)
    with pytest.raises(ValueError, match="must have that of the training"):
        evaluate_policy(policy, lines(2, action_space=spaces.Discrete(3)))
    message = "^domain 'endless': 4 of 4 episodes went on after max_steps = 5;"
    with pytest.raises(ValueError, match=message):
        evaluate_policy(policy, {"endless": lambda: Counting(end=-1)}, 4, max_steps=5)


def test_a_parameter_that_was_set_on_a_wrapper_is_a_warning():
    wrong = {"short": pole("wrapped length", 0.4), "long": pole("wrapped length", 0.6)}
    with pytest.warns(UserWarning, match=r"\['short', 'long'\].* answered alike .*env.unwrapped"):
        check_domains("domains", wrong | {"other": pole("length", 0.4)})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_domains("domains", {"short": pole("length", 0.4), "long": pole("length", 0.6)})


def test_one_thread_is_a_setting_of_the_training_alone():
    def threads():
        blas = [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]
        return torch.get_num_threads(), blas

    class Watching(Counting):
        def step(self, action):
            seen.append(threads())
            raise KeyError

    own, seen = torch.get_num_threads(), []
    torch.set_num_threads(2)
    before = threads()
    with pytest.raises(KeyError):
        train_policy({"a": Watching}, "ppo", **TINY)
    assert threads() == before
    assert seen == [(1, [1] * len(before[1]))]
    torch.set_num_threads(own)


@pytest.mark.parametrize(
    ("name", "package", "extra"),
    [("ColoredKeys", "minigrid", "keys"), ("Door", "mujoco", "door")],
)
def test_a_world_without_its_packages_says_what_to_install(monkeypatch, name, package, extra):
    for module in [m for m in sys.modules if m.split(".")[0] == package or "ipo.worlds." in m]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ModuleNotFoundError, match=rf"{package}.*pip install 'ipo\[{extra}\]'"):
        gymnasium.make(f"ipo/{name}-v0")


BOX = spaces.Box(-1, 1, (2,), np.float32)


@pytest.mark.parametrize(
    ("domains", "error", "message"),
    [
        ([Line], TypeError, "must be of type Mapping"),
        ({"a": Line(), "b": Line}, TypeError, r"domains\['a'\] = .*must be a function"),
        ({"a": Line, "b": list}, TypeError, r"domains\['b'\]\(\) = \[\]: must be a gymnasium.Env"),
        (dict.fromkeys("ab", lambda e=Line(): e), ValueError, "must make a new one at each call"),  # noqa: B008
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
            "must be vectors or images",
        ),
        (
            lines(0, 1, observation_space=spaces.Box(0, 1, (2, 2), np.float32)),
            ValueError,
            "must be vectors or images",
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
    ("error", "network", "message"),
    [
        (TypeError, "dense", "network = 'dense': must be of type Network"),
        (ValueError, DenseNetwork(4, 2, Categorical), "must take observations"),
        (ValueError, DenseNetwork(3, 5, Categorical), "must give actions"),
        (ValueError, DenseNetwork(3, 2, Gaussian), "must give actions"),
    ],
)
def test_a_network_that_does_not_fit_is_an_error_before_any_training(error, network, message):
    with pytest.raises(error, match=message):
        train_policy(lines(0, 1), "ipo", network=network, **TINY)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: train_policy(lines(0), "ipoo"), "did you mean 'ipo'"),
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
