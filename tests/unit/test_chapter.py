"""Where a chapter's rows and policies are: what ships stays as it is."""

from dataclasses import replace
from pathlib import Path

import pytest

from chapters import DATA, tree_hash
from experiments import keys
from experiments.chapter import Chapter

ROOT = Path(__file__).resolve().parents[2]
SHIPPED = ROOT / "data" / "results" / "keys"


def chapter(results_dir: str | None) -> Chapter:
    return Chapter("keys", keys.EXPERIMENTS, results_dir, num_workers=1)


@pytest.mark.parametrize("results_dir", ["data/results/keys", "data/results/keys/", str(SHIPPED)])
def test_what_ships_is_found_from_every_folder(tmp_path, monkeypatch, results_dir):
    monkeypatch.chdir(tmp_path)
    shipped = chapter(results_dir)
    assert shipped.folder == SHIPPED
    assert shipped.places.policies == ROOT / "data" / "policies" / "keys"


@pytest.mark.parametrize("results_dir", ["rows", "./rows", "data/results/lqr"])
def test_another_folder_is_in_the_working_directory_with_its_policies(
    tmp_path, monkeypatch, results_dir
):
    monkeypatch.chdir(tmp_path)
    own = chapter(results_dir)
    assert own.folder == tmp_path / results_dir
    assert own.places.policies == own.folder / "policies"
    assert own.places.checkpoints == own.folder / "checkpoints"


def test_nowhere_is_a_folder_that_goes():
    nowhere = chapter(None)
    folder = nowhere.folder
    assert folder.is_dir() and nowhere.places.policies.parent == folder
    del nowhere
    assert not folder.exists()


@pytest.mark.parametrize("results_dir", [5, "", True, ["rows"]])
def test_a_folder_must_be_a_path(results_dir):
    with pytest.raises((TypeError, ValueError), match=r"results_dir = .*: must be"):
        chapter(results_dir)


def test_rows_and_policies_of_ones_own_leave_alone_what_ships(
    tmp_path, monkeypatch, tables, capsys
):
    """The cell of the shipped policies, but for the number of its updates and runs."""
    monkeypatch.chdir(tmp_path)
    before = {name: tree_hash(ROOT / "data" / name) for name in DATA}
    own = chapter("rows")
    own.places = replace(own.places, tables=tables)
    cell = keys.arm("ppo", "ppo", num_updates=1, num_steps=16, num_epochs=1)
    own.rows("main", [cell], range(2))
    assert "main: 2 runs are missing. At the mean cost" in capsys.readouterr().err
    assert {name: tree_hash(ROOT / "data" / name) for name in DATA} == before
    policy = keys.policy_path(tmp_path / "rows" / "policies", cell)
    assert policy.exists() and (tmp_path / "rows" / "main.csv").exists()
    shipped = keys.policy_path(ROOT / "data" / "policies" / "keys", cell)
    with pytest.raises(ValueError, match=r"num_updates = 20, asked for 1"):
        keys.Keys(tables).saved(cell, shipped.parent)
