"""Check-points: what comes back, what damage does, and training that goes on."""

import errno
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
import torch

import experiments.store
from experiments.checkpoints import (
    CheckpointError,
    CheckpointWarning,
    load_checkpoint,
    previous,
    save_checkpoint,
)
from experiments.doors import training as door_training
from experiments.doors.training import NETWORK, Cell, Runs, published_door, train_run
from experiments.experiment import Places
from experiments.policies import load_policy
from experiments.store import Store

TREE = {
    "number": 3,
    "big": 2**100,
    "nothing": None,
    "list": [1.5, {"deep": torch.arange(6).reshape(2, 3)}],
    "array": np.array([[0.1, 0.2]]),
    "transposed": torch.arange(6.0).reshape(2, 3).T,
}


def test_a_tree_comes_back(tmp_path):
    save_checkpoint(tmp_path / "c", TREE)
    found = load_checkpoint(tmp_path / "c")
    assert {name: found[name] for name in ("number", "big", "nothing")} == {
        "number": 3,
        "big": 2**100,
        "nothing": None,
    }
    assert found["list"][0] == 1.5
    assert torch.equal(found["list"][1]["deep"], TREE["list"][1]["deep"])
    assert torch.equal(found["array"], torch.tensor([[0.1, 0.2]], dtype=torch.float64))
    assert torch.equal(found["transposed"], TREE["transposed"])


def test_nothing_saved_is_nothing(tmp_path):
    assert load_checkpoint(tmp_path / "c") is None


def test_a_damaged_file_is_passed_over_with_a_message(tmp_path):
    """Cut, empty, something else, and one bit of every byte changed."""
    path = tmp_path / "c"
    save_checkpoint(path, {"number": 1})
    save_checkpoint(path, {"number": 2})
    content = path.read_bytes()
    flipped = [
        content[:i] + bytes([byte ^ 1 << i % 8]) + content[i + 1 :]
        for i, byte in enumerate(content)
    ]
    for changed in (content[:-5], b"", b"not a check-point", *flipped):
        path.write_bytes(changed)
        with pytest.warns(
            CheckpointWarning, match="is cut short or changed.*; looking for the one"
        ):
            assert load_checkpoint(path) == {"number": 1}


def test_two_damaged_files_are_an_error(tmp_path):
    path = tmp_path / "c"
    for _ in range(2):
        save_checkpoint(path, {"number": 1})
    for file in (path, previous(path)):
        file.write_bytes(b"")
    with (
        pytest.warns(CheckpointWarning),
        pytest.raises(CheckpointError, match="no check-point is whole; delete them"),
    ):
        load_checkpoint(path)


def full(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_a_full_disk_leaves_what_was_there(tmp_path, monkeypatch, call):
    path = tmp_path / "c"
    save_checkpoint(path, {"number": 1})
    monkeypatch.setattr(os, call, full)
    with pytest.raises(CheckpointError, match=r"cannot be written \(No space left on device\)"):
        save_checkpoint(path, {"number": 2})
    assert load_checkpoint(path) == {"number": 1}
    assert [file.name for file in tmp_path.iterdir()] == ["c"]


# ------------------------------------------------------------------------- training on doors


@pytest.fixture(autouse=True)
def few_doors(monkeypatch):
    monkeypatch.setattr(door_training, "NUM_CURVE_DOORS", 2)


def small(method: str = "ipo", num_updates: int = 3) -> Cell:
    """Rollouts that end in the middle of an episode."""
    settings = published_door(
        method, num_updates=num_updates, num_envs=(2, 2), num_steps=530, num_minibatches=4
    )
    return Cell(method, settings, saved_after=(2, num_updates), curve_every=2)


def without_time(rows):
    return rows[rows["metric"] != "cpu_seconds"].reset_index(drop=True)


def assert_same_policies(folder, other):
    assert {path.name for path in folder.iterdir()} == {path.name for path in other.iterdir()}
    for path in folder.iterdir():
        players, same = (load_policy(p, NETWORK)[0] for p in (path, other / path.name))
        for own, wanted in zip(players, same, strict=True):
            assert all(torch.equal(weights, wanted[name]) for name, weights in own.items())


def test_an_interrupted_run_ends_as_if_nothing_had_happened(tmp_path):
    cell = small("ipo")
    whole = train_run(cell, [5], tmp_path / "a", tmp_path / "whole", progress=False)
    for _ in range(2):
        Runs(cell, [5], tmp_path / "b", tmp_path / "parts").update()  # each goes on where one ended
    parts = train_run(cell, [5], tmp_path / "b", tmp_path / "parts", progress=False)
    assert without_time(parts).equals(without_time(whole))
    names = {f"ipo_5_{n}_{choice}.safetensors" for n in (2, 3) for choice in ("best", "last")}
    assert {file.name for file in (tmp_path / "whole").iterdir()} == names
    assert_same_policies(tmp_path / "whole", tmp_path / "parts")


def test_a_training_is_kept_until_its_rows_are_saved(tmp_path, monkeypatch):
    """The disk is full in the end: the next call trains no more, and has the same rows."""
    places = Places(tmp_path, tmp_path / "policies", tmp_path / "checkpoints")
    experiment = door_training.EXPERIMENT.at(places)
    store, cells = Store(tmp_path / "rows", "curves"), [small("ppo", 2)]
    with monkeypatch.context() as patched:
        patched.setattr(experiments.store, "replace_text", full)
        with pytest.raises(OSError, match="No space left"):
            store.fill(experiment, cells, [0], num_workers=1)
    expected = Runs(cells[0], [0], places.checkpoints, places.policies).rows()
    monkeypatch.setattr(Runs, "update", full)
    rows = store.fill(experiment, cells, [0], num_workers=1)
    assert len(rows) == len(expected)
    assert sorted(rows["value"]) == pytest.approx(sorted(expected["value"]), rel=1e-8)
    assert list(places.checkpoints.iterdir()) == []
    (batch,) = store.batches()
    of_training = expected.loc[expected["metric"] == "cpu_seconds", "value"].max()
    assert batch["cpu_seconds"] >= of_training - 0.01, "what it had cost before is left out"


def test_a_shorter_training_is_the_beginning_of_a_longer_one(tmp_path):
    short, long = (
        train_run(small(num_updates=n), [0], tmp_path / str(n), tmp_path / str(n), progress=False)
        for n in (2, 3)
    )
    assert without_time(short).equals(without_time(long)[: len(without_time(short))])


def test_a_checkpoint_of_other_settings_is_refused(tmp_path):
    cell = small("ppo")
    Runs(cell, [0], tmp_path, tmp_path).update()
    other = replace(cell, settings=replace(cell.settings, learning_rate=0.1))
    refused = r"was made for others: .*learning_rate = 0\.001, asked for 0\.1; delete it"
    with pytest.raises(CheckpointError, match=refused):
        Runs(other, [0], tmp_path, tmp_path)


def test_a_checkpoint_of_other_runs_is_refused(tmp_path):
    """Whoever asks for one of them, or for others besides, would begin it anew without a word."""
    Runs(small("ppo"), [0, 1], tmp_path, tmp_path).update()
    for asked in ([0], [1, 2]):
        with pytest.raises(CheckpointError, match=r"ppo_0-1\.checkpoint: carries runs \[0, 1\]"):
            Runs(small("ppo"), asked, tmp_path, tmp_path)


def test_runs_that_two_workers_began_go_on_with_one(tmp_path, monkeypatch):
    cell, updated = small("ppo", 2), []
    places = Places(tmp_path, tmp_path / "policies", tmp_path / "checkpoints")
    for together in ([0, 1], [2]):
        Runs(cell, together, places.checkpoints, places.policies).update()
    update = Runs.update
    monkeypatch.setattr(Runs, "update", lambda runs: (updated.append(runs.seeds), update(runs)))
    rows = Store(tmp_path / "rows", "curves").fill(
        door_training.EXPERIMENT.at(places), [cell], [0, 1, 2], num_workers=1
    )
    assert updated == [[0, 1], [2]]
    assert set(rows["run"]) == {0, 1, 2}
    assert list(places.checkpoints.iterdir()) == []


@pytest.mark.parametrize("method", ["ppo", "ipo"])
def test_a_run_does_not_depend_on_those_beside_it(tmp_path, method):
    """To the digit: its learning curve, and both of its policies."""
    cell = small(method, 2)
    together = train_run(cell, [3, 4], tmp_path / "c", tmp_path / "together", progress=False)
    alone = [
        train_run(cell, [seed], tmp_path / "d", tmp_path / "alone", progress=False)
        for seed in (3, 4)
    ]
    for own in alone:
        of_run = together[together["run"] == own["run"].iloc[0]]
        assert without_time(of_run).equals(without_time(own))
    assert_same_policies(tmp_path / "together", tmp_path / "alone")


def test_the_best_policy_is_that_of_the_best_last_ten_episodes(tmp_path, monkeypatch):
    run = Runs(small("ppo", 3), [0], tmp_path / "c", tmp_path / "p")
    run.update()
    first = [w.clone() for w in run.best[0].values()]
    run.best_returns[:] = np.inf  # nothing can be better any more
    run.update()
    assert all(torch.equal(a, b) for a, b in zip(first, run.best[0].values(), strict=True))
    best, _ = load_policy(door_training.policy_path(tmp_path / "p", "ppo", 0, 2), NETWORK)
    last, _ = load_policy(door_training.policy_path(tmp_path / "p", "ppo", 0, 2, "last"), NETWORK)
    assert torch.equal(best[0]["actor1.weight"], first[0])
    assert not torch.equal(last[0]["actor1.weight"], first[0])


def test_policies_are_saved_within_the_training_only():
    with pytest.raises(ValueError, match=r"saved_after = \(95, 190\): must be between 1 and"):
        Cell("ppo", published_door("ppo", num_updates=100))


def test_kill_loses_one_update_at_most(tmp_path):
    script = tmp_path / "train.py"
    script.write_text(
        "import torch\n"
        "from experiments.doors.training import Cell, published_door, train_run\n"
        "torch.set_num_threads(1)\n"
        "settings = published_door('ppo', num_updates=50, num_envs=(1, 1), num_steps=512,\n"
        "                          num_minibatches=2, num_epochs=1)\n"
        "cell = Cell('ppo', settings, saved_after=(50,), curve_every=50)\n"
        f"train_run(cell, [0], {str(tmp_path / 'c')!r}, {str(tmp_path / 'p')!r})\n"
    )
    process = subprocess.Popen([sys.executable, script], stderr=subprocess.DEVNULL)
    path = tmp_path / "c" / "ppo_0.checkpoint"
    for _ in range(2400):
        if previous(path).exists():
            break
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    found = load_checkpoint(path)
    assert found["num_updates"] >= 2
    assert found["training"]["num_frames"] == found["num_updates"] * 1024
