"""Rows and their origin: load what was computed before, compute only what is missing.

A result is ``<name>.csv``, tidy rows, and ``<name>.json``, the origin of every batch of rows: the
cell with all its options, the function that ran it, seeds, digests of the rows and of the files
that were read, versions, machine, commit, cost. An origin is written once and never changed; what
does not match it is an error before any work. Both files are replaced by renaming a finished
temporary file, so a killed run leaves whole files.

Whether today's code would still give these rows is another question, and a test answers it: see
:mod:`experiments.witness`.
"""

from __future__ import annotations

import datetime
import hashlib
import json
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import joblib
import pandas as pd
from filelock import FileLock
from tqdm import tqdm

from experiments import origin
from experiments.experiment import Cell, Experiment, rebuilt
from experiments.files import replace_text
from ipo.checks import Seeds, check_count, checked

KEYS = {"columns", "cell", "run", "options", "seeds", "reads", "num_rows", "sha256"}  # of a batch
NO_ROWS = pd.DataFrame({"run": pd.Series(dtype=int)})

Batch = dict[str, Any]


def _check_workers(name: str, value: object) -> None:
    """As joblib counts them: -1 are as many as there are cores."""
    check_count(name, value, minimum=None)
    if value == 0:
        raise ValueError(f"{name} = 0: must be a number of processes, or -1 for one per core")


class ResultsError(ValueError):
    """Rows that cannot be used; nothing was changed."""


class OriginError(ResultsError):
    """Rows that come from something else than what is asked for; nothing was changed."""


@dataclass(frozen=True)
class Store:
    """The rows in ``folder/name.csv`` and their origin in ``folder/name.json``."""

    folder: Path
    name: str

    @property
    def csv(self) -> Path:
        return self.folder / f"{self.name}.csv"

    @property
    def json(self) -> Path:
        return self.folder / f"{self.name}.json"

    def rows(self) -> pd.DataFrame:
        """All rows, each batch checked against its digest.

        Raises:
            ResultsError: files that are damaged.
        """
        return self._read()[0]

    def batches(self) -> list[Batch]:
        """The origin of every batch, as recorded when it was computed; rows are not looked at.

        Raises:
            ResultsError: a record that cannot be read, or rows without one.
        """
        return self._record()[1]

    def rows_of(self, batch: Batch) -> pd.DataFrame:
        """The rows of one batch."""
        rows = self.rows()
        return select(rows[rows["run"].isin(batch["seeds"])], batch["columns"])

    @checked
    def fill(
        self,
        experiment: Experiment,
        cells: Annotated[Sequence[Cell], "cells"],
        seeds: Seeds,
        num_workers: Annotated[int, _check_workers] | None = None,
    ) -> pd.DataFrame:
        """The rows of ``cells`` x ``seeds``: loaded where they exist, computed where they do not.

        Args:
            experiment: how rows are made.
            cells: the configurations; their ``columns`` are the first columns of their rows.
            seeds: the runs of every cell.
            num_workers: processes that compute; ``None`` leaves it to ``joblib.parallel_config``.

        Every finished batch is saved at once: after an interruption the next call goes on with
        what is missing and ends with the same rows.

        Raises:
            ResultsError: files that are damaged, or a folder that cannot be written.
            OriginError: rows of another cell, option, run function or input than asked for.
        """
        rows, batches = self._read()
        for cell in cells:
            for batch in batches:
                if batch["columns"] == cell.columns:
                    self._check_origin(experiment, cell, seeds, batch)
        size = experiment.runs_at_once or len(seeds)
        lacking = [(cell, _lacking(cell, seeds, batches)) for cell in cells]
        missing = [
            (cell, runs[i : i + size]) for cell, runs in lacking for i in range(0, len(runs), size)
        ]
        if missing:
            self._check_writable()
            jobs = (joblib.delayed(timed)(experiment.run, cell, runs) for cell, runs in missing)
            work = joblib.Parallel(n_jobs=num_workers, return_as="generator_unordered")(jobs)
            for cell, new_rows, cost in tqdm(
                work, desc=self.name, total=len(missing), unit="batch"
            ):
                self._add(experiment, cell, new_rows, cost)
            rows, _ = self._read()
        wanted = rows[rows["run"].isin(seeds)]
        return pd.concat([select(wanted, cell.columns) for cell in cells], ignore_index=True)

    def _read(self) -> tuple[pd.DataFrame, list[Batch]]:
        """Rows and batches, every batch checked against its rows."""
        types, batches = self._record()
        if not batches:  # or killed before the first batch was saved whole
            return NO_ROWS, []
        try:
            columns = pd.read_csv(self.csv, nrows=0).columns
            if absent := [column for column in types if column not in columns]:
                raise ResultsError(
                    f"{self.csv}: column {absent[0]!r} is missing; needs {list(types)}"
                )
            rows = pd.read_csv(self.csv, dtype=types, keep_default_na=False)
        except ResultsError:
            raise
        except (ValueError, OSError) as error:
            raise ResultsError(f"{self.json.with_suffix('')}: cannot be read: {error}") from error
        # Rows that no batch claims: the run was killed between the two renames. They are
        # computed again.
        parts = [self._checked(rows, batch) for batch in batches]
        return pd.concat(parts, ignore_index=True), batches

    def _record(self) -> tuple[dict[str, str], list[Batch]]:
        """The types of the columns, and the batches."""
        if not self.json.exists():
            if self.csv.exists():
                raise ResultsError(
                    f"{self.csv}: has no {self.json.name} beside it that says where it comes from"
                )
            return {}, []
        try:
            record = json.loads(self.json.read_text(encoding="utf-8"))
            types, batches = dict(record["types"]), list(record["batches"])
            for batch in batches:
                if absent := KEYS - batch.keys():
                    raise KeyError(f"a batch without {min(absent)}")
        except (ValueError, KeyError, TypeError, AttributeError, OSError) as error:
            raise ResultsError(f"{self.json.with_suffix('')}: cannot be read: {error}") from error
        return types, batches

    def _checked(self, rows: pd.DataFrame, batch: Batch) -> pd.DataFrame:
        part = select(rows[rows["run"].isin(batch["seeds"])], batch["columns"])
        if len(part) != batch["num_rows"] or digest(part) != batch["sha256"]:
            raise ResultsError(
                f"{self.csv}: the rows of {batch['columns']} are cut short or changed: "
                f"{len(part)} rows, {batch['num_rows']} were written; restore the file"
            )
        return part

    def _check_origin(
        self, experiment: Experiment, cell: Cell, seeds: Sequence[int], batch: Batch
    ) -> None:
        """Whether the rows of a batch are what is asked for, in the runs that are asked for."""
        chosen = [seed for seed in batch["seeds"] if seed in seeds]
        if not chosen:
            return
        wanted = asked(experiment, cell, chosen)
        recorded = {key: batch[key] for key in wanted} | {"cell": filled(experiment, batch["cell"])}
        recorded["reads"] = {
            name: read for name, read in batch["reads"].items() if name in wanted["reads"]
        }
        if recorded != wanted:
            raise OriginError(
                f"{self.csv}: the rows of {cell.columns}, runs {batch['seeds']}, are not what is "
                f"asked for: {difference(recorded, wanted)}. To compute them anew, move "
                f"{self.csv.name} and {self.json.name} away, or name another folder for the results"
            )

    def _add(
        self, experiment: Experiment, cell: Cell, rows: pd.DataFrame, cost: dict[str, float]
    ) -> None:
        """Add the rows of one cell. Two programs may fill the same files at the same time.

        Runs that the other one has added in the meantime are kept as they are.
        """
        with FileLock(self.csv.with_suffix(".lock")):
            present, batches = self._read()
            rows = rows[rows["run"].isin(_lacking(cell, rows["run"], batches))]
            if rows.empty:
                return
            seeds = sorted(int(seed) for seed in rows["run"].unique())
            batch = {
                "columns": cell.columns,
                **asked(experiment, cell, seeds),
                "seeds": seeds,
                "num_rows": len(rows),
                "sha256": digest(rows),
                "versions": origin.versions(),
                "machine": origin.machine(),
                "commit": origin.commit(),
                "finished": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
                **cost,
            }
            batches = sorted(
                [*batches, batch], key=lambda b: json.dumps([b["columns"], b["seeds"]])
            )
            order = [column for column in rows.columns if column != "value"]
            together = pd.concat([present, rows]) if len(present) else rows
            together = together.sort_values(order, kind="stable")[list(rows.columns)]
            if not self.json.exists():  # a CSV without a JSON would be somebody else's
                self.write_record(rows, [])
            replace_text(self.csv, together.to_csv(index=False))
            self.write_record(together, batches)

    def write_record(self, rows: pd.DataFrame, batches: list[Batch]) -> None:
        """Replace the record of these rows."""
        types = {column: _type(rows[column]) for column in rows.columns}
        record = {"types": types, "batches": batches}
        replace_text(self.json, json.dumps(record, indent=1) + "\n")

    def _check_writable(self) -> None:
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=self.folder).close()
        except OSError as error:
            raise ResultsError(f"folder = {self.folder}: must be writable: {error}") from error


def timed(run: Callable, cell: Cell, seeds: list[int]) -> tuple[Cell, pd.DataFrame, dict]:
    """The rows of a run, values to nine digits, and what they cost."""
    wall, cpu = time.perf_counter(), time.process_time()
    rows = run(cell, seeds)
    cost = {
        "cpu_seconds": round(time.process_time() - cpu, 2),
        "wall_seconds": round(time.perf_counter() - wall, 2),
    }
    rows["value"] = [float(f"{value:.9g}") for value in rows["value"]]
    return cell, rows, cost


def asked(experiment: Experiment, cell: Cell, seeds: Sequence[int]) -> dict[str, Any]:
    """What rows are made of: the part of their origin that can be compared, as JSON has it."""
    name, options = origin.function(experiment.run)
    reads = experiment.reads or (lambda cell, seed: [])
    paths = [path for seed in seeds for path in reads(cell, seed)]
    digests = {path.name: origin.file_digest(path) for path in paths}
    made_of = {"cell": asdict(cell), "run": name, "options": options, "reads": digests}
    return json.loads(json.dumps(made_of))


def filled(experiment: Experiment, recorded: dict[str, Any]) -> dict[str, Any]:
    """A recorded cell with options that it did not have yet: their defaults are what was done."""
    try:
        return json.loads(json.dumps(asdict(rebuilt(experiment.cell, recorded))))
    except (TypeError, ValueError, KeyError):  # it has options that are no more
        return recorded


def select(rows: pd.DataFrame, columns: dict[str, Any]) -> pd.DataFrame:
    """The rows with these values in these columns."""
    keep = pd.Series(True, index=rows.index)
    for column, value in columns.items():
        keep &= rows[column] == value
    return rows[keep]


def digest(rows: pd.DataFrame) -> str:
    """A hash of rows that does not depend on their order."""
    columns = [*sorted(set(rows.columns) - {"value"}), "value"]
    lines = rows[columns].to_csv(index=False, header=False).splitlines()
    return hashlib.sha256("\n".join(sorted(lines)).encode()).hexdigest()[:16]


def difference(recorded: dict[str, Any], wanted: dict[str, Any], prefix: str = "") -> str:
    """What differs between two trees of plain values, in words."""
    parts = []
    for key in sorted({*recorded, *wanted}):
        old, new = recorded.get(key), wanted.get(key)
        if isinstance(old, dict) and isinstance(new, dict):
            parts.append(difference(old, new, f"{prefix}{key}."))
        elif old != new:
            parts.append(f"{prefix}{key} = {old!r}, asked for {new!r}")
    return "; ".join(part for part in parts if part)


def _lacking(cell: Cell, seeds: Iterable[int], batches: list[Batch]) -> list[int]:
    have = {
        seed for batch in batches if batch["columns"] == cell.columns for seed in batch["seeds"]
    }
    return [seed for seed in seeds if seed not in have]


def _type(column: pd.Series) -> str:
    kinds = {"i": "int64", "u": "int64", "f": "float64", "b": "bool"}
    return kinds.get(column.dtype.kind, "str")
