"""Results with provenance: loaded, computed where missing, never lost, never wrong unnoticed."""

import errno
import functools
import json
import os
import pickle
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import pandas as pd
import pytest
import toy_experiment
from toy_experiment import CELLS, SEEDS, Cell, fill

from experiments import store
from experiments.experiment import Experiment
from experiments.sealed import DamagedError, read_record, write_record, write_sealed
from experiments.store import OriginError, ResultsError, Store


@pytest.fixture(scope="module")
def complete(tmp_path_factory) -> Path:
    """A folder with all results; not to be changed."""
    folder = tmp_path_factory.mktemp("complete")
    fill(folder)
    return folder


@pytest.fixture
def folder(complete, tmp_path) -> Path:
    """A copy of it."""
    for path in (complete / "toy.csv", complete / "toy.json"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    return tmp_path


class Calls:
    """A ``run`` that remembers what it was asked to compute, under the toy's name."""

    def __init__(self) -> None:
        functools.update_wrapper(self, toy_experiment.run)
        self.asked: list[tuple[Cell, list[int]]] = []

    def __call__(self, cell: Cell, seeds: list[int]) -> pd.DataFrame:
        self.asked.append((cell, seeds))
        return toy_experiment.run(cell, seeds)


def contents(folder: Path) -> dict[str, bytes]:
    """What the files of a folder hold; the empty lock file aside."""
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.suffix != ".lock"}


def start_program(folder: Path, *death: str) -> subprocess.Popen:
    call = "import sys, toy_experiment; toy_experiment.main(*sys.argv[1:])"
    command = [sys.executable, "-c", call, str(folder), *death]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    return subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL)


def in_order(rows: pd.DataFrame) -> pd.DataFrame:
    return rows.sort_values(list(rows.columns), ignore_index=True)


# ------------------------------------------------------------------------ run or load


def test_computed_rows_are_the_rows_of_the_run(tmp_path):
    expected = pd.concat([toy_experiment.run(cell, SEEDS) for cell in CELLS])
    rows = fill(tmp_path)
    pd.testing.assert_frame_equal(in_order(rows), in_order(expected), rtol=1e-8)


def test_second_call_loads_the_same_rows(tmp_path):
    first, calls = fill(tmp_path), Calls()
    before = contents(tmp_path)
    pd.testing.assert_frame_equal(fill(tmp_path, run=calls), first, check_exact=True)
    assert calls.asked == []
    assert contents(tmp_path) == before


def test_only_missing_cells_and_runs_are_computed(tmp_path):
    fill(tmp_path, CELLS[:2], [1])
    calls = Calls()
    fill(tmp_path, run=calls)
    assert calls.asked == [(CELLS[0], [0, 2]), (CELLS[1], [0, 2]), (CELLS[2], [0, 1, 2])]


def test_rows_of_what_was_asked_for_come_back_alone(folder):
    rows = fill(folder, CELLS[1:2], [0, 2])
    assert set(rows["method"]) == {"fast"} and set(rows["size"]) == {10}
    assert sorted(rows["run"]) == [0, 0, 2, 2]


def test_runs_at_once_splits_a_cell(tmp_path, complete):
    calls = Calls()
    fill(tmp_path, CELLS[:1], run=calls, runs_at_once=2)
    assert calls.asked == [(CELLS[0], [0, 1]), (CELLS[0], [2])]


@pytest.mark.parametrize(
    ("num_workers", "num_cells", "batches"),
    [
        (1, 1, [[0, 1], [2]]),
        (3, 1, [[0], [1], [2]]),
        (2, 2, [[0, 1], [2]]),
        (64, 2, [[0], [1], [2]]),
    ],
)
def test_divisible_batches_leave_no_worker_without_work(
    tmp_path, monkeypatch, num_workers, num_cells, batches
):
    monkeypatch.setattr(store, "num_at_once", lambda *given: num_workers)
    cells, calls = CELLS[:num_cells], Calls()
    fill(tmp_path, cells, run=calls, runs_at_once=2, divisible=True)
    assert calls.asked == [(cell, batch) for cell in cells for batch in batches]


def test_batches_are_the_same_when_a_part_of_them_is_there(tmp_path):
    """A check-point is that of its batch."""
    calls = Calls()
    fill(tmp_path, CELLS[:1], [0, 1])
    fill(tmp_path, CELLS[:1], range(5), run=calls, runs_at_once=3)
    assert calls.asked == [(CELLS[0], [2]), (CELLS[0], [3, 4])]


@pytest.mark.parametrize(
    "steps",
    [
        [(CELLS[::-1], (2, 1, 0))],
        [(CELLS[2:], SEEDS), (CELLS[:1], (2,)), (CELLS, SEEDS)],
        [(CELLS, (1,)), (CELLS, (2,)), (CELLS, SEEDS)],
    ],
    ids=["backwards", "cell by cell", "run by run"],
)
def test_order_of_computation_does_not_matter(tmp_path, complete, steps):
    for cells, seeds in steps:
        rows = fill(tmp_path, cells, seeds)
    assert contents(tmp_path)["toy.csv"] == contents(complete)["toy.csv"]
    expected = fill(complete)
    pd.testing.assert_frame_equal(in_order(rows), in_order(expected), check_exact=True)


def test_processes_compute_what_one_computes(tmp_path, complete):
    fill(tmp_path, num_workers=2)
    assert contents(tmp_path)["toy.csv"] == contents(complete)["toy.csv"]


@pytest.mark.parametrize("value", [float("inf"), 1e-300, 0.1 + 0.2])
def test_values_survive_the_file(tmp_path, value):
    @functools.wraps(toy_experiment.run)
    def run(cell, seeds):
        return toy_experiment.run(cell, seeds).assign(value=value)

    first = fill(tmp_path, run=run)
    assert fill(tmp_path)["value"].tolist() == first["value"].tolist()
    assert first["value"][0] == pytest.approx(value, rel=1e-8)


def test_origin_says_where_each_batch_comes_from(folder):
    batches = Store(folder, "toy").batches()
    assert [batch["cell"]["size"] for batch in batches] == [10, 2, 2]
    for batch in batches:
        assert batch["seeds"] == [0, 1, 2]
        assert batch["num_rows"] == 6
        assert batch["run"].endswith("toy_experiment.run") and batch["options"] == {}
        assert batch["versions"]["pandas"] == pd.__version__
        assert {"numpy", "torch", "mujoco", "minigrid", "gymnasium"} <= batch["versions"].keys()
        assert {"cpu_seconds", "wall_seconds", "machine", "commit", "finished"} <= batch.keys()


# ------------------------------------------------------------------------ interruption


@pytest.mark.parametrize(
    ("moment", "num_saved"),
    [
        ("computing 1", 0),
        ("computing 3", 2),
        ("renaming 1", 0),
        ("renaming 2", 0),
        ("renaming 3", 0),
        ("renaming 4", 1),
        ("renaming 5", 1),
    ],
)
def test_killed_program_goes_on_where_it_was(tmp_path, complete, moment, num_saved):
    assert start_program(tmp_path, *moment.split()).wait() == -signal.SIGKILL
    calls = Calls()
    rows = fill(tmp_path, run=calls)
    assert [cell for cell, _ in calls.asked] == list(CELLS[num_saved:])
    pd.testing.assert_frame_equal(rows, fill(complete), check_exact=True)
    assert contents(tmp_path)["toy.csv"] == contents(complete)["toy.csv"]


def test_two_programs_can_fill_the_same_results(tmp_path, complete):
    fill(tmp_path, CELLS[1:2], [1])
    programs = [start_program(tmp_path) for _ in range(2)]
    assert [program.wait() for program in programs] == [0, 0]
    assert contents(tmp_path)["toy.csv"] == contents(complete)["toy.csv"]


def test_finished_batches_survive_a_failing_one(tmp_path):
    @functools.wraps(toy_experiment.run)
    def run(cell, seeds):
        return toy_experiment.run(cell, seeds) if cell == CELLS[0] else 1 / 0

    with pytest.raises(ZeroDivisionError):
        fill(tmp_path, run=run)
    calls = Calls()
    fill(tmp_path, run=calls)
    assert [cell for cell, _ in calls.asked] == list(CELLS[1:])


# ------------------------------------------------------------------------------- damage


def edit(name: str, pattern: str, replacement: str) -> Callable[[Path], None]:
    """Replace what matches a pattern in one of the files."""

    def damage(folder: Path) -> None:
        text = (folder / name).read_text()
        changed = re.sub(pattern, replacement, text, count=1)
        assert changed != text
        (folder / name).write_text(changed)

    return damage


def without_column(column: str) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        path = folder / "toy.csv"
        pd.read_csv(path).drop(columns=column).to_csv(path, index=False)

    return damage


def without(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


DAMAGE = {
    "truncated row": (edit("toy.csv", r"\d\n$", ""), r"toy\.csv.*cut short or changed"),
    "truncated number": (edit("toy.csv", r",[^,]*\n$", ",\n"), r"toy: cannot be read"),
    "missing row": (edit("toy.csv", r".*\n$", ""), r"toy\.csv.*5 rows, 6 were written; restore"),
    "half a file": (edit("toy.csv", r"(?s)fast,10,2.*", "fast,10,2,te"), r"toy: cannot be read"),
    "double row": (edit("toy.csv", r"(.*\n)$", r"\1\1"), r"toy\.csv.*7 rows, 6 were written"),
    "changed value": (edit("toy.csv", r"1\.41", "1.42"), r"toy\.csv.*cut short or changed"),
    "changed domain": (edit("toy.csv", "test", "train"), r"toy\.csv.*cut short or changed"),
    "empty CSV": (edit("toy.csv", r"(?s).+", ""), r"toy: cannot be read: No columns"),
    "no CSV": (without("toy.csv"), r"toy: cannot be read: .*toy\.csv"),
    "no JSON": (without("toy.json"), r"toy\.csv: has no toy\.json beside it"),
    "truncated JSON": (edit("toy.json", r"(?s).{40}$", ""), r"toy: cannot be read: .* line \d+"),
    "empty JSON": (edit("toy.json", r"(?s).+", ""), r"toy: cannot be read"),
    "JSON of something else": (edit("toy.json", '"batches"', '"rows"'), r"toy: cannot be read"),
    "JSON list": (edit("toy.json", r"(?s).+", "[]"), r"toy: cannot be read"),
    "other origin": (edit("toy.json", '"commit": "', '"commit": "0'), r"toy\.json: is cut short"),
    "other seal": (edit("toy.json", r'"sha256"(?=[^{}]*}\n$)', '"seal"'), r"toy\.json: is cut"),
} | {
    f"no column {column}": (without_column(column), rf"toy\.csv: column '{column}' is missing")
    for column in ("method", "size", "run", "domain", "metric", "value")
}


@pytest.mark.parametrize(("damage", "message"), DAMAGE.values(), ids=DAMAGE.keys())
def test_damaged_file_is_named_and_not_changed(folder, damage, message):
    damage(folder)
    before, calls = contents(folder), Calls()
    with pytest.raises(ResultsError, match=message):
        fill(folder, [*CELLS, Cell("new", 1)], run=calls)
    assert calls.asked == []
    assert contents(folder) == before


@pytest.mark.parametrize("target", ["nowhere", "itself", "/dev/zero"])
@pytest.mark.parametrize("name", ["toy.csv", "toy.json"])
def test_a_link_that_leads_to_no_file_is_named(folder, name, target):
    (folder / name).unlink()
    (folder / name).symlink_to(name if target == "itself" else target)
    calls = Calls()
    with pytest.raises(ResultsError, match=rf"toy: cannot be read: .*{name}"):
        fill(folder, run=calls)
    assert calls.asked == [] and (folder / name).is_symlink()


def test_a_link_to_results_is_as_good_as_they_are(folder, complete):
    (folder / "toy.csv").unlink()
    (folder / "toy.csv").symlink_to(complete / "toy.csv")
    calls = Calls()
    assert fill(folder, run=calls).equals(fill(complete)) and calls.asked == []


@pytest.mark.parametrize("inside", [".", "deeper/still"])
def test_folder_that_cannot_be_written_is_named_before_any_work(tmp_path, inside):
    (tmp_path / "file").write_text("not a folder")
    folder, calls = tmp_path / "file" / inside, Calls()
    with pytest.raises(ResultsError, match=rf"folder = {re.escape(str(folder))}: must be writable"):
        fill(folder, run=calls)
    assert calls.asked == []
    assert contents(tmp_path) == {"file": b"not a folder"}


def test_missing_folder_is_made(tmp_path):
    fill(tmp_path / "new" / "folder", CELLS[:1])
    assert contents(tmp_path / "new" / "folder").keys() == {"toy.csv", "toy.json"}


# ------------------------------------------------------------------------------ origin


NEW_POWER = (Cell("slow", 2, power=0.25), *CELLS[1:])


def with_option(cell, seeds, power=2):
    return toy_experiment.run(cell, seeds)


def another_run(cell, seeds):
    return toy_experiment.run(cell, seeds)


def input_of(path: Path):
    return lambda cell, seed: [path]


def refused(folder: Path, message: str, **asked) -> None:
    """What is asked for is not what is there: an error before any work, and nothing changes."""
    before = contents(folder)
    with pytest.raises(OriginError, match=message):
        fill(folder, **asked)
    assert contents(folder) == before


def test_rows_of_other_parameters_are_refused(folder):
    message = r"toy\.csv: the rows of .*'size': 2}.*cell\.power = 0\.5, asked for 0\.25.*move toy"
    refused(folder, message, cells=[*NEW_POWER, Cell("new", 1)])


def test_an_option_that_rows_did_not_have_yet_is_its_default(folder):
    @dataclass(frozen=True)
    class NewCell(Cell):
        """With an option that the recorded cells lack."""

        offset: float = 0.0

    new = [NewCell(cell.method, cell.size) for cell in CELLS]
    store, experiment = Store(folder, "toy"), Experiment(toy_experiment.run, NewCell)
    assert len(store.fill(experiment, new, SEEDS)) == 18
    with pytest.raises(OriginError, match=r"cell\.offset = 0\.0, asked for 1\.0"):
        store.fill(experiment, [replace(new[0], offset=1.0)], SEEDS)


def test_an_option_that_is_no_more_is_named(folder):
    record = read_record(folder / "toy.json")
    for batch in record["batches"]:
        batch["cell"]["root"] = batch["cell"].pop("power")
    write_record(folder / "toy.json", record)
    refused(folder, r"cell\.power = None, asked for 0\.5; cell\.root = 0\.5, asked for None")


def test_rows_of_another_run_function_are_refused(folder):
    refused(folder, r"run = '.*toy_experiment\.run', asked for '.*another_run'", run=another_run)


def test_rows_of_another_option_are_refused(tmp_path):
    fill(tmp_path, run=with_option)
    fill(tmp_path, run=functools.partial(with_option, power=2))  # the default, said aloud
    changed = functools.partial(with_option, power=3)
    refused(tmp_path, r"options\.power = 2, asked for 3", run=changed)


def test_rows_of_another_input_are_refused(tmp_path):
    path = tmp_path / "inputs" / "policy"
    write_sealed(path, b"weights")
    folder = tmp_path / "rows"
    fill(folder, reads=input_of(path))
    fill(folder, reads=input_of(path))
    write_sealed(path, b"other weights")
    refused(folder, r"reads\.policy = '\w{16}', asked for '\w{16}'", reads=input_of(path))
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(DamagedError, match="policy: is cut short or changed"):
        fill(folder, reads=input_of(path))
    path.unlink()
    refused(folder, r"reads\.policy = '\w{16}', asked for 'no such file'", reads=input_of(path))


def test_runs_that_nobody_asks_for_need_no_inputs(tmp_path):
    path, by_seed = tmp_path / "policy", tmp_path / "other"
    for file in (path, by_seed):
        write_sealed(file, b"weights")
    fill(tmp_path / "rows", reads=lambda cell, seed: [path if seed else by_seed])
    by_seed.unlink()
    again = fill(tmp_path / "rows", seeds=[1, 2], reads=lambda cell, seed: [path])
    assert sorted(again["run"].unique()) == [1, 2]


def test_places_are_no_options(tmp_path):
    def run(cell, seeds, tables):
        return toy_experiment.run(cell, seeds)

    fill(tmp_path / "rows", run=functools.partial(run, tables=tmp_path / "here"))
    fill(tmp_path / "rows", run=functools.partial(run, tables=tmp_path / "there"))


def test_other_cells_of_a_file_do_not_matter(tmp_path):
    fill(tmp_path, CELLS[:1])
    assert len(fill(tmp_path, [CELLS[1], CELLS[2]])) == 12


@pytest.mark.parametrize("label", ["NA", "None", "1", "nan", "a,b", "", "a\nb", "a\r\nb", '"', "é"])
@pytest.mark.parametrize("others", [(), CELLS])
def test_labels_come_back_as_they_were(tmp_path, label, others):
    cells = [*others, Cell(label, 2)]
    first = fill(tmp_path, cells)
    pd.testing.assert_frame_equal(fill(tmp_path, cells), first)
    assert set(fill(tmp_path, cells[-1:])["method"]) == {label}


# -------------------------------------------------------------- rows that would not come back


@pytest.mark.parametrize(
    ("cell", "message"),
    [
        (Cell(None, 2), r"method = None of .*: must be one of str, bool, int64, float64"),
        (Cell(1, 2), r"method = 1 of .*: must be str"),
        (Cell("new", "2"), r"size = '2' of .*: must be int64"),
        (Cell("new", 2.0), r"size = 2\.0 of .*: must be int64"),
        (Cell("new", True), r"size = True of .*: must be int64"),
    ],
)
def test_a_label_of_another_type_is_refused_before_any_work(folder, cell, message):
    before, calls = contents(folder), Calls()
    with pytest.raises(ResultsError, match=rf"toy\.csv: {message}"):
        fill(folder, [*CELLS, cell], run=calls)
    assert calls.asked == [] and contents(folder) == before


BAD_ROWS = {
    "a column is missing": (lambda rows: rows.drop(columns="size"), "column 'size' is missing"),
    "no runs": (lambda rows: rows.drop(columns="run"), "column 'run' is missing"),
    "no values": (lambda rows: rows.drop(columns="value"), "column 'value' is missing"),
    "no rows": (lambda rows: rows[:0], "there are none"),
    "NaN": (lambda rows: rows.assign(value=float("nan")), "'value' has no value, or NaN, in 6"),
    "no domain": (lambda rows: rows.assign(domain=None), "'domain' has no value, or NaN, in 6"),
    "kinds": (lambda rows: rows.assign(domain=[*"abcde", 1]), "column 'domain' has 1, must be all"),
    "other runs": (lambda rows: rows.assign(run=rows["run"] + 1), r"they are of runs \[1, 2, 3\]"),
    "a run is missing": (lambda rows: rows[rows["run"] > 0], r"they are of runs \[1, 2\]"),
    "other cell": (lambda rows: rows.assign(method="old"), "method = 'old', must be 'new'"),
    "twice": (lambda rows: pd.concat([rows, rows]), r"two of them are of \{'method': 'new'"),
    "a column more": (lambda rows: rows.assign(more=1), "were not saved: they have .*'more'"),
    "integers": (lambda rows: rows.assign(domain=range(6)), "were not saved: .*'domain': 'int64'"),
    "line feed": (lambda rows: rows.assign(metric="a\rb"), "would not come back as they are"),
}


@pytest.mark.parametrize(("change", "message"), BAD_ROWS.values(), ids=BAD_ROWS.keys())
def test_rows_that_would_not_come_back_are_not_saved(folder, change, message):
    @functools.wraps(toy_experiment.run)
    def run(cell, seeds):
        return change(toy_experiment.run(cell, seeds))

    before = contents(folder)
    with pytest.raises(ResultsError, match=rf"rows of {{'method': 'new', 'size': 3}}.*{message}"):
        fill(folder, [Cell("new", 3)], run=run)
    assert contents(folder) == before
    assert len(fill(folder, [*CELLS, Cell("new", 3)])) == 24  # nothing is blocked


@pytest.mark.parametrize("name", ["../toy", "deeper/toy", "/toy", "..", ".", "", "a\\b", "a\0"])
def test_a_name_with_a_path_in_it_is_refused(tmp_path, name):
    with pytest.raises(ValueError, match=r"name = .*: must be the name of a file, without a path"):
        Store(tmp_path, name)


# -------------------------------------------------------------------------- work on the way


def test_work_is_kept_until_its_rows_are_read_back(tmp_path, complete, monkeypatch):
    """The disk is full when rows are to be saved: the next call finishes from the check-points."""
    begun = []

    @functools.wraps(toy_experiment.run)
    def run(cell, seeds):
        path = tmp_path / f"{cell.method}_{cell.size}_{seeds[0]}.work"
        if not path.exists():
            begun.append(path.name)
            path.write_bytes(pickle.dumps(toy_experiment.run(cell, seeds)))
        return pickle.loads(path.read_bytes())

    def files(cell):
        found = tmp_path.glob(f"{cell.method}_{cell.size}_*.work")
        return {(int(path.stem.rpartition("_")[2]),): [path] for path in found}

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    rows, options = tmp_path / "rows", {"run": run, "checkpoints": files, "runs_at_once": 1}
    with monkeypatch.context() as patched:
        patched.setattr(os, "replace", full)
        with pytest.raises(OSError, match=r"No space left on device: .*toy\.json"):
            fill(rows, **options)
    assert begun == ["slow_2_0.work"] and list(tmp_path.glob("*.work"))
    assert contents(rows) == {}
    fill(rows, **options)
    assert len(begun) == len(set(begun)) == 9  # none began anew
    assert contents(rows)["toy.csv"] == contents(complete)["toy.csv"]
    assert list(tmp_path.glob("*.work")) == []


def test_work_left_by_a_program_that_died_before_removing_it_goes(folder):
    path = folder / "left.work"
    path.write_text("work")
    assert len(fill(folder, checkpoints=lambda cell: {(0, 1): [path]})) == 18
    assert not path.exists()


@pytest.mark.parametrize(
    ("begun", "expected"),
    [
        ([], [[0, 1], [2, 3], [4]]),
        ([(0, 1, 2), (3, 4)], [[0, 1, 2], [3, 4]]),  # by fewer workers
        ([(1,), (3,)], [[1], [3], [0], [2], [4]]),  # by more
        ([(4, 5), (6,)], [[0, 1], [2, 3], [4]]),  # not asked for, or not all
    ],
)
def test_runs_go_on_together_as_they_were_begun(tmp_path, begun, expected):
    computed = []

    @functools.wraps(toy_experiment.run)
    def run(cell, seeds):
        computed.append(seeds)
        return toy_experiment.run(cell, seeds)

    options = {"run": run, "checkpoints": lambda cell: {runs: [] for runs in begun}}
    fill(tmp_path, CELLS[:1], seeds=range(5), runs_at_once=2, **options)
    assert computed == expected


def test_record_is_json_that_others_can_read(folder):
    record = json.loads((folder / "toy.json").read_text())
    assert record["batches"][0]["cell"]["power"] == 0.5
    assert record["types"]["domain"] == "str"
