"""Policies saved as the authors saved theirs: weights come out, code does not run."""

import itertools
import pickle
import sys
import types

import numpy as np
import pytest
import torch
from torch import nn

from experiments.doors.authors_policies import FOLDER, authors_policies, load_authors_policy
from experiments.doors.training import NETWORK


def layers(*sizes):
    parts = []
    for inputs, outputs in itertools.pairwise(sizes):
        parts += [nn.Linear(inputs, outputs), nn.Tanh()]
    return nn.Sequential(*parts)


@pytest.fixture
def foreign(monkeypatch):
    """Classes of a package that is not installed where the files are read."""
    module = types.ModuleType("a2c_ppo_acktr.model")

    class AddBias(nn.Module):
        def __init__(self):
            super().__init__()
            self._bias = nn.Parameter(torch.randn(6, 1))

    class Base(nn.Module):
        def __init__(self, players):
            super().__init__()
            for d in players:
                setattr(self, f"actor{d}", layers(15, 64, 64))
                setattr(self, f"critic{d}", layers(15, 64, 64))
                setattr(self, f"critic_linear{d}", nn.Linear(64, 1))
                if d:
                    setattr(self, f"fc_mean{d}", nn.Linear(64, 6))
                    setattr(self, f"logstd{d}", AddBias())

    class Gaussian(nn.Module):
        def __init__(self):
            super().__init__()
            self.fc_mean, self.logstd = nn.Linear(64, 6), AddBias()

    class Policy(nn.Module):
        def __init__(self, method):
            super().__init__()
            self.tt, self.visionmodel = 0, None
            self.knob_target_hist = torch.zeros(1, 3)
            self.base = Base(("1", "2") if method == "ipo" else ("",))
            if method == "ppo":
                self.dist = Gaussian()

    for cls in (AddBias, Base, Gaussian, Policy):
        cls.__module__, cls.__qualname__ = module.__name__, cls.__name__
        setattr(module, cls.__name__, cls)
    monkeypatch.setitem(sys.modules, "a2c_ppo_acktr", types.ModuleType("a2c_ppo_acktr"))
    monkeypatch.setitem(sys.modules, module.__name__, module)
    return Policy


def means(policy, rows):
    """Of the actions, by torch's own layers."""
    base = policy.base
    if hasattr(base, "actor1"):
        return (base.fc_mean1(base.actor1(rows)) + base.fc_mean2(base.actor2(rows))) / 2
    return policy.dist.fc_mean(base.actor(rows))


@pytest.mark.filterwarnings("ignore:Couldn't retrieve source code")  # when they are saved
@pytest.mark.parametrize("new_format", [False, True], ids=["as in 2020", "as of today"])
@pytest.mark.parametrize("method", ["ppo", "ipo"])
def test_the_same_actions_without_the_authors_code(
    tmp_path, foreign, monkeypatch, method, new_format
):
    policy, path = foreign(method), tmp_path / "policy.pt"
    torch.save([policy, None], path, _use_new_zipfile_serialization=new_format)
    monkeypatch.delitem(sys.modules, "a2c_ppo_acktr.model")
    monkeypatch.delitem(sys.modules, "a2c_ppo_acktr")
    players = load_authors_policy(path)
    assert len(players) == (2 if method == "ipo" else 1)
    rows = torch.tensor(np.random.default_rng(0).normal(size=(4, 15)), dtype=torch.float32)
    parameters, _ = NETWORK.frozen(players)(rows[None])
    with torch.no_grad():
        np.testing.assert_allclose(parameters[0, :, :6], means(policy, rows), atol=1e-6)
    deviations = [
        getattr(part, name)._bias.detach().exp().flatten()
        for part, name in (
            [(policy.dist, "logstd")]
            if method == "ppo"
            else [(policy.base, "logstd1"), (policy.base, "logstd2")]
        )
    ]
    np.testing.assert_allclose(parameters[0, 0, 6:], sum(deviations) / len(deviations), rtol=1e-5)


class Malicious:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (open, (str(self.path), "w"))


@pytest.mark.filterwarnings("ignore:Couldn't retrieve source code")
@pytest.mark.parametrize("new_format", [False, True])
def test_code_in_a_file_is_not_executed(tmp_path, foreign, new_format):
    policy, path, trace = foreign("ppo"), tmp_path / "policy.pt", tmp_path / "trace"
    policy.attack = Malicious(trace)
    torch.save([policy, None], path, _use_new_zipfile_serialization=new_format)
    load_authors_policy(path)
    assert not trace.exists()


def test_a_whole_repository(tmp_path, foreign):
    for method in ("ppo", "ipo"):
        folder = tmp_path / FOLDER / method
        folder.mkdir(parents=True)
        for seed in range(2):
            torch.save([foreign(method), None], folder / f"doorenv-v0_{seed}.best.pt")
    found = authors_policies(tmp_path)
    assert {method: [len(p) for p in own] for method, own in found.items()} == {
        "ppo": [1, 1],
        "ipo": [2, 2],
    }


def test_no_repository_there(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"authors_repository = .* must have \*.best.pt"):
        authors_policies(tmp_path)


@pytest.mark.parametrize(
    "damage",
    ["cut short", "not a pickle", "something else", "numbers", "too small", "a layer less"],
)
def test_a_file_that_is_no_policy_is_refused(tmp_path, foreign, damage):
    path = tmp_path / "policy.pt"
    policy = foreign("ppo")
    if damage == "too small":
        policy.base.actor = layers(15, 8, 64)
    elif damage == "a layer less":
        del policy.base.critic_linear
    torch.save([policy, None], path)
    if damage == "cut short":
        path.write_bytes(path.read_bytes()[:2000])
    elif damage == "not a pickle":
        path.write_text("not a pickle")
    elif damage == "something else":
        path.write_bytes(pickle.dumps({"weights": [1, 2, 3]}))
    elif damage == "numbers":
        torch.save([1, 2], path)
    with pytest.raises(ValueError, match=r"policy.pt: cannot be read as a policy of the authors"):
        load_authors_policy(path)
