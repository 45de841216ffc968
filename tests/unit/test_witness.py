"""What verify and confirm say: on a toy with slices of its own, and of the shipped record."""

import runpy
import shutil
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import toy_experiment
from toy_experiment import CELLS, Cell

from experiments import confirm, origin, registry, witness
from experiments.experiment import Experiment, rebuilt
from experiments.games import played
from experiments.store import Store

SHIFT = {"cost": 0.0}


def run(cell: Cell, seeds: list[int]) -> pd.DataFrame:
    """The toy, or the toy after a change of its code."""
    rows = toy_experiment.run(cell, seeds)
    return rows.assign(value=rows["value"] + SHIFT["cost"])


def short(cell: Cell) -> Cell | None:
    return replace(cell, power=0.25) if cell.method == "fast" else None


@pytest.fixture
def toy(tmp_path, monkeypatch):
    """A chapter with results and recorded slices."""
    experiments = {"toy": Experiment(run, Cell, short)}
    for module in (registry, witness, confirm):
        monkeypatch.setattr(module, "DATA", tmp_path)
    for module in (registry, witness):
        monkeypatch.setattr(module, "CHAPTERS", {"lqr": experiments})
    monkeypatch.setattr(witness, "WITNESS", tmp_path / "witness")
    monkeypatch.setattr(confirm, "CONFIRMED", tmp_path / "confirmed.json")
    monkeypatch.setitem(SHIFT, "cost", 0.0)
    Store(tmp_path / "results" / "lqr", "toy").fill(experiments["toy"], CELLS, [0, 1, 2], 1)
    witness.record(num_workers=1)
    return tmp_path


def test_slices_are_recorded_for_what_has_one(toy):
    batches = Store(toy / "witness" / "lqr", "toy").batches()
    assert [batch["cell"] for batch in batches] == [
        {"method": "fast", "size": size, "power": 0.25} for size in (10, 2)
    ]


def test_the_same_code_gives_what_was_recorded(toy):
    assert witness.verify(num_workers=1) == []


@pytest.mark.parametrize(("shift", "count"), [(1e-6, 0), (1e-3, 8)])
def test_a_change_is_named_with_cell_metric_and_values(toy, monkeypatch, shift, count):
    monkeypatch.setitem(SHIFT, "cost", shift)
    problems = witness.verify(num_workers=1)
    assert len(problems) == count
    if count:
        line = "lqr/toy, {'method': 'fast', 'size': 10}: method fast, run 0, domain train, metric"
        assert any(problem.startswith(line) for problem in problems)
        assert all("recorded" in problem and "now" in problem for problem in problems)


def test_code_that_fails_is_named_and_the_others_go_on(toy, monkeypatch):
    monkeypatch.setitem(SHIFT, "cost", "a word")
    problems = witness.verify(num_workers=1)
    assert len(problems) == 2 and all("Error: " in problem for problem in problems)


def test_a_cell_without_its_slice_is_named(toy):
    for path in (toy / "witness" / "lqr").glob("toy.*"):
        path.unlink()
    assert len([p for p in witness.verify(num_workers=1) if "no slice is recorded" in p]) == 2


def test_other_rows_are_a_difference(toy, monkeypatch):
    whole = toy_experiment.run
    monkeypatch.setattr(toy_experiment, "run", lambda cell, seeds: whole(cell, seeds).iloc[1:])
    assert [" has other rows" in problem for problem in witness.verify(num_workers=1)] == [True] * 2


@pytest.mark.parametrize(("shift", "how"), [(0.0, "exact"), (1e-4, "close"), (1.0, "differs")])
def test_full_batches_are_confirmed_once(toy, monkeypatch, shift, how):
    monkeypatch.setattr(confirm.origin, "commit", lambda: "0123456789")
    monkeypatch.setattr(confirm.origin, "is_since", lambda first, later: first == later)
    monkeypatch.setitem(SHIFT, "cost", shift)
    outcomes = [confirm._outcome(part, toy) for part in confirm.full_batches(["lqr"])]
    assert [outcome["how"] for _, outcome in outcomes] == [how] * 3
    apart = {outcome.get("apart", "").split(" of ")[0] for _, outcome in outcomes}
    assert apart == ({"cost in test by 1"} if how == "differs" else {""})
    for cell, outcome in outcomes:
        confirm._save(cell, outcome)
    titles = map(confirm.title, confirm.full_batches(["lqr"]))
    left = [cell for cell in titles if not confirm._is_done(confirm.confirmed(), cell, None)]
    assert len(left) == (3 if how == "differs" else 0)


def curves(runs: range, shift: float = 0.0) -> pd.DataFrame:
    """Learning curves of some runs, which differ by their number."""
    return pd.DataFrame(
        {"method": "a", "frames": f, "run": r, "domain": "d", "metric": "m", "value": f + r + shift}
        for r in runs
        for f in range(10)
    )


@pytest.mark.parametrize(
    ("shift", "num_runs", "expected"),
    [(0.3, 1, True), (30.0, 1, False), (0.3, 15, True), (30.0, 15, False)],
)
def test_chaotic_runs_are_alike_or_not(shift, num_runs, expected):
    shipped = curves(range(20))
    again = curves(range(5, 5 + num_runs), shift)
    both = witness.side_by_side(shipped[shipped["run"].isin(again["run"])], again)
    assert confirm.alike(shipped, {"method": "a"}, both) == expected


def ends(phase: float, shift: float = 0.0, size: float = 1.0) -> pd.DataFrame:
    """Where runs stand that go round in a circle, each from a place of its own."""
    return pd.DataFrame(
        {"run": r, "domain": "d", "metric": m, "value": 5 + shift + size * np.sin(2.4 * r + phase)}
        for r in range(20)
        for m in ("a", "b")
    )


@pytest.mark.parametrize(
    ("now", "before", "expected"),
    [
        (ends(1.0), ends(2.0), True),
        (ends(1.0, shift=3.0), ends(2.0, shift=3.0), False),  # somewhere else
        (ends(1.0, shift=0.9), ends(2.0, shift=0.9), False),  # as near, but to one side
        (ends(1.0), ends(1.3), False),  # slower than it is far
        (ends(0.0, shift=1e-3), ends(0.0, shift=1e-3), False),  # at rest
    ],
)
def test_where_an_unsettled_training_may_end(now, before, expected):
    both = witness.side_by_side(ends(0.0), now)
    assert confirm.unsettled(both, [before]) == expected


def test_moments_before_the_end_count_by_the_furthest():
    """Whoever goes round may stand where it stood before, at one moment but not at all."""
    both = witness.side_by_side(ends(0.0), ends(1.0))
    assert not confirm.unsettled(both, [ends(1.0), ends(1.1)])
    assert confirm.unsettled(both, [ends(1.0), ends(2.0)])
    assert not confirm.unsettled(both, [])  # it is not trained

    def one_is_enough() -> Iterator[pd.DataFrame]:
        yield ends(2.0)
        raise AssertionError("looked at a moment that is not needed")

    assert confirm.unsettled(both, one_is_enough())


@pytest.mark.parametrize(("moved", "expected"), [(0.6, True), (0.4, False)])
def test_a_single_run_may_be_elsewhere_by_twice_what_it_moves(moved, expected):
    def alone(number: int, value: float) -> pd.DataFrame:
        return pd.DataFrame(
            {"round": [number], "run": 0, "domain": "d", "metric": "m", "value": value}
        )

    both = witness.side_by_side(alone(100, 5.0), alone(100, 6.0))
    assert confirm.unsettled(both, [alone(98, 6.0 - moved)]) == expected


def test_only_the_end_of_a_game_may_be_elsewhere():
    parts = confirm.full_batches(["algorithm/averages"])
    cells = [rebuilt(played.Trajectory, part.batch["cell"]) for part in parts]
    before = {cell.on_the_way: played.near_the_end(cell) for cell in cells}
    assert before[True] == []
    ends = [cell.game.settings.num_rounds for cell in before[False]]
    assert ends == [1470, 1485, 1478, 1492]


@pytest.mark.parametrize(("moves", "how"), [(0.0, "differs"), (2.0, "unsettled")])
def test_only_what_does_not_rest_may_be_elsewhere(toy, monkeypatch, moves, how):
    def elsewhere(cell: Cell, seeds: list[int]) -> pd.DataFrame:
        """Runs one up and one down, and up and down again before the end."""
        rows = run(cell, seeds)
        side = np.where(rows["run"] % 2, 1.0, -1.0)
        return rows.assign(value=rows["value"] + side * (1 + moves * (cell.power == 0.25)))

    def before(cell: Cell) -> list[Cell]:
        return [replace(cell, power=0.25)]

    experiment = Experiment(elsewhere, Cell, short, near_the_end=before)
    monkeypatch.setitem(registry.CHAPTERS["lqr"], "toy", experiment)
    parts = list(confirm.full_batches(["lqr"]))
    assert {confirm._outcome(part, toy)[1]["how"] for part in parts} == {how}


def test_an_experiment_that_is_not_there_is_named():
    with pytest.raises(ValueError, match=r"experiment = 'lqr/table': .*mean 'lqr/tables'"):
        registry.chosen(["lqr/table"])


def test_every_cell_that_has_a_slice_has_it_recorded():
    for chapter, name in registry.chosen([]):
        recorded = [b["columns"] for b in Store(witness.WITNESS / chapter, name).batches()]
        wanted = [cell.columns for cell in witness.short_cells(chapter, name)]
        assert sorted(map(str, wanted)) == sorted(map(str, recorded)), f"{chapter}/{name}"


def test_experiments_that_were_copied_to_where_no_rows_are_say_how_to_install_them(tmp_path):
    copied = tmp_path / "lib" / "experiments" / "origin.py"
    copied.parent.mkdir(parents=True)
    shutil.copy(origin.__file__, copied)
    with pytest.raises(FileNotFoundError, match=r"no shipped rows.* --editable notebooks"):
        runpy.run_path(str(copied))


@pytest.mark.parametrize(
    ("experiment", "metric", "by", "factor", "expected"),
    [
        ("door/curves", "return", 149.0, 1, True),
        ("door/curves", "return", 151.0 + 6.0, 1, False),
        ("door/curves", "return", 149.0 + 59.0, 10, True),
        ("door/curves", "return", 1500.0, 10, False),  # what flips does so once
        ("your_own_domains/compare", "return", 149.0, 1, False),
        ("door/gaps", "after", 2000.0, 1, True),
        ("door/gaps", "before", 2000.0, 1, False),
    ],
)
def test_what_may_flip_is_named_by_its_metric(experiment, metric, by, factor, expected):
    both = pd.DataFrame({"metric": [metric], "value": [-6000.0], "value_now": [-6000.0 + by]})
    assert witness.within(both, experiment, factor).all() == expected
