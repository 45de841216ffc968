"""Everything from nothing, on a toy whose second experiment reads what the first one saves."""

import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import pandas as pd
import pytest
import toy_experiment
from toy_chapter import play, policy
from toy_experiment import CELLS, Cell

from experiments import confirm, registry, reproduce
from experiments.experiment import Experiment, Places
from experiments.sealed import write_sealed
from experiments.store import Store, select

STATE = {"shift": 0.0, "until": sys.maxsize}


def train(cell: Cell, seeds: list[int], policies: Path) -> pd.DataFrame:
    """The toy, or the toy after a change; it is interrupted after so many calls."""
    if STATE["until"] == 0:
        raise KeyboardInterrupt
    STATE["until"] -= 1
    rows = toy_experiment.run(cell, seeds)
    write_sealed(policy(cell, 0, policies)[0], str(STATE["shift"]).encode())
    return rows.assign(value=rows["value"] + STATE["shift"])


@pytest.fixture
def toy(tmp_path, monkeypatch):
    """A chapter with a shipped record of ten runs, in batches of five."""
    experiments = {
        "played": Experiment(play, Cell, reads=policy, runs_at_once=5),
        "trained": Experiment(train, Cell, runs_at_once=5),
    }
    for module in (confirm, reproduce):
        monkeypatch.setattr(module, "DATA", tmp_path)
    for module in (registry, reproduce):
        monkeypatch.setattr(module, "CHAPTERS", {"lqr": experiments})
    monkeypatch.setitem(STATE, "shift", 0.0)
    places = Places(*[tmp_path / name for name in ("tables", "policies", "checkpoints")])
    for name in ("trained", "played"):
        store = Store(tmp_path / "results" / "lqr", name)
        store.fill(experiments[name].at(places), CELLS[:2], range(10), 1)
    return tmp_path


def outcomes(table: pd.DataFrame) -> dict[str, dict[str, int]]:
    """How the two cells of each experiment came out."""
    assert set(table["cells"]) == {2}
    counts = table.set_index("experiment")[list(reproduce.OUTCOMES)]
    return {name: {k: n for k, n in own.items() if n} for name, own in counts.T.items()}


def test_everything_comes_from_nothing(toy, capsys):
    found = reproduce.reproduce(num_workers=1)
    assert outcomes(found) == {"lqr/played": {"exact": 2}, "lqr/trained": {"exact": 2}}
    assert capsys.readouterr().out.startswith("8 batches, 0.0 core-hours by their records")
    policies = (toy / "reproduced" / "lqr" / "policies").iterdir()
    assert {path.name for path in policies} == {"slow_2", "fast_10"}
    for name in ("trained", "played"):
        csv = [toy / folder / "lqr" / f"{name}.csv" for folder in ("results", "reproduced")]
        assert csv[0].read_text() == csv[1].read_text()


def test_an_interrupted_command_goes_on_where_it_was(toy, monkeypatch, capsys):
    monkeypatch.setitem(STATE, "until", 2)
    monkeypatch.setattr(sys, "argv", ["reproduce", "lqr"])
    monkeypatch.setattr(reproduce, "reproduce", partial(reproduce.reproduce, num_workers=1))
    with pytest.raises(SystemExit, match="Interrupted; the same command goes on"):
        reproduce.main()
    monkeypatch.setitem(STATE, "until", 2)  # and not one more
    reproduce.main()
    assert [line.split(",")[0] for line in capsys.readouterr().out.splitlines()[:2]] == [
        "8 batches",
        "6 batches",
    ]


@pytest.mark.parametrize(("shift", "played"), [(1e-4, {"close": 2}), (1.0, {"differs": 2})])
def test_another_training_shows_in_its_rows_and_in_what_reads_them(toy, monkeypatch, shift, played):
    monkeypatch.setitem(STATE, "shift", shift)
    found = reproduce.reproduce(num_workers=1)
    assert outcomes(found) == {"lqr/played": played, "lqr/trained": played}


@pytest.mark.parametrize(("moves", "how"), [(0.0, "differs"), (2.0, "unsettled")])
def test_what_never_comes_to_rest_may_end_elsewhere(toy, monkeypatch, moves, how):
    def elsewhere(cell: Cell, seeds: list[int]) -> pd.DataFrame:
        """Runs one up and one down, and up and down again before the end."""
        rows = toy_experiment.run(cell, seeds)
        side = 1.0 - 2.0 * (rows["run"] % 2)
        return rows.assign(value=rows["value"] + side * (1 + moves * (cell.power == 0.25)))

    def before(cell: Cell) -> list[Cell]:
        return [replace(cell, power=0.25)]

    experiments = {"trained": Experiment(elsewhere, Cell, near_the_end=before)}
    for module in (registry, reproduce):
        monkeypatch.setattr(module, "CHAPTERS", {"lqr": experiments})
    assert outcomes(reproduce.reproduce(num_workers=1)) == {"lqr/trained": {how: 2}}


def test_cells_that_differ_are_an_error(toy, monkeypatch):
    monkeypatch.setitem(STATE, "shift", 1.0)
    monkeypatch.setattr(sys, "argv", ["reproduce"])
    monkeypatch.setattr(reproduce, "reproduce", partial(reproduce.reproduce, num_workers=1))
    with pytest.raises(SystemExit, match="4 cells differ from the shipped rows"):
        reproduce.main()


@pytest.mark.parametrize(
    ("num_runs", "longest", "seeds", "seconds"),
    [
        (0, 9, [[0], [1], [2], [0]], [1, 2, 3, 4]),
        (2, 9, [[0, 1], [2], [0]], [3, 3, 4]),
        (5, 9, [[0, 1, 2], [0]], [6, 4]),
        (5, 5, [[0, 1], [2], [0]], [3, 3, 4]),
        (5, 0, [[0], [1], [2], [0]], [1, 2, 3, 4]),
    ],
)
def test_runs_of_a_cell_are_joined(num_runs, longest, seeds, seconds):
    batches = [
        {"cell": {"label": label}, "seeds": [seed], "cpu_seconds": number}
        for number, (label, seed) in enumerate([*zip("aaa", range(3), strict=True), ("b", 0)], 1)
    ]
    found = reproduce.joined(batches, num_runs, longest)
    assert [batch["seeds"] for batch in found] == seeds
    assert [batch["cpu_seconds"] for batch in found] == seconds
    assert reproduce.joined([], num_runs, longest) == []


def test_an_unknown_chapter_is_named():
    with pytest.raises(ValueError, match=r"chapter = 'dor': .*mean 'door'"):
        reproduce.reproduce(["dor"])


@pytest.mark.parametrize(
    ("waves", "num_workers", "expected"),
    [
        ([[3, 1, 2]], 1, 6),
        ([[3, 1, 2]], 2, 3),
        ([[3, 1, 2], [5]], 2, 8),  # what reads policies waits for them
        ([[1] * 10, []], 4, 3),
    ],
)
def test_time_that_batches_take_side_by_side(waves, num_workers, expected):
    assert reproduce.wall_seconds(waves, num_workers) == expected


def runs(seeds: range, shift: float = 0.0) -> pd.DataFrame:
    """Runs with two doors; what is measured depends on the run."""
    return pd.DataFrame(
        {"run": r, "domain": "d", "door": door, "metric": "m", "value": r % 7 + door + shift}
        for r in seeds
        for door in range(2)
    )


@pytest.mark.parametrize(("shift", "expected"), [(0.3, True), (30.0, False)])
def test_runs_of_a_chaotic_cell_are_alike_or_not(shift, expected):
    assert reproduce.alike(runs(range(10)), runs(range(5, 15), shift)) == expected
    assert not reproduce.alike(runs(range(10)), runs(range(10)).assign(domain="another"))


@pytest.mark.parametrize("experiment", [*confirm.CHAOTIC, "door/success", "door/strategies"])
def test_shipped_cells_have_runs_enough_to_be_told_apart(experiment):
    chapter, name = experiment.split("/")
    shipped = Store(registry.DATA / "results" / chapter, name)
    columns = min(shipped.batches(), key=lambda batch: len(batch["seeds"]))["columns"]
    rows = select(shipped.rows(), columns)
    assert reproduce.alike(rows, rows)
    assert not reproduce.alike(rows, rows.assign(value=rows["value"] + 1e6))
