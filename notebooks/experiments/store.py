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

import csv
import datetime
import hashlib
import io
import json
import math
import os
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
from filelock import FileLock
from tqdm import tqdm

from experiments import origin
from experiments.experiment import Cell, Experiment, difference, filled, plain
from experiments.files import check_file_name, replace_text
from experiments.rows import ResultsError, check_rows, types_of
from experiments.sealed import DamagedError, digest_of, read_record, read_whole, write_record
from experiments.work import finished, num_at_once
from ipo.checks import Seeds, check_count, checked

TYPES = {"str": str, "bool": bool, "int64": int, "float64": float}  # a bool is an int, too
NO_ROWS = pd.DataFrame({"run": pd.Series(dtype=int)})
NOWHERE = np.array([], dtype=int)

Batch = dict[str, Any]


def _check_workers(name: str, value: object) -> None:
    """As joblib counts them: -1 are as many as there are cores."""
    check_count(name, value, minimum=None)
    if value == 0:
        raise ValueError(f"{name} = 0: must be a number of processes, or -1 for one per core")


class OriginError(ResultsError):
    """Rows that come from something else than what is asked for; nothing was changed."""


@dataclass(frozen=True)
class Store:
    """The rows in ``folder/name.csv`` and their origin in ``folder/name.json``."""

    folder: Path
    name: str

    def __post_init__(self) -> None:
        check_file_name("name", self.name)

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
        scheduler: str | None = None,
    ) -> pd.DataFrame:
        """The rows of ``cells`` x ``seeds``: loaded where they exist, computed where they do not.

        Args:
            experiment: how rows are made.
            cells: the configurations; their ``columns`` are the first columns of their rows.
            seeds: the runs of every cell.
            num_workers, scheduler: who computes; see :func:`experiments.work.finished`.

        Every finished batch is saved at once: after an interruption the next call goes on with
        what is missing and ends with the same rows. Check-points are removed last, when the rows
        of all runs have been read from the files.

        Raises:
            ResultsError: files that are damaged, a folder that cannot be written, or rows that
                are not those of their cell and runs, each once, or that would not come back as
                they are.
            OriginError: rows of another cell, option, run function or input than asked for.
            WorkError: a scheduler that cannot be reached or is lost.
        """
        rows, batches = self._read()
        lacking = [(cell, self._missing(experiment, cell, seeds, batches)) for cell in cells]
        if any(runs for _, runs in lacking):
            self._check_storable([cell for cell, runs in lacking if runs])
            self.check_writable()
            size = experiment.runs_at_once or len(seeds)
            if experiment.divisible:
                at_once = num_at_once(num_workers, scheduler)
                size = min(size, math.ceil(len(cells) * len(seeds) / at_once))
            missing = [
                (cell, own)
                for cell, runs in lacking
                for own in together(experiment, cell, seeds, runs, size)
            ]
            jobs = [partial(timed, experiment.run, cell, runs) for cell, runs in missing]
            work = finished(jobs, num_workers, scheduler)
            for cell, new_rows, made in tqdm(
                work, desc=self.name, total=len(missing), unit="batch"
            ):
                self.add(experiment, cell, new_rows, made)
            rows, _ = self._read()
        self.remove_checkpoints(experiment, cells, seeds)
        wanted = rows[rows["run"].isin(seeds)]
        return pd.concat([select(wanted, cell.columns) for cell in cells], ignore_index=True)

    def remove_checkpoints(
        self, experiment: Experiment, cells: Sequence[Cell], seeds: Sequence[int]
    ) -> None:
        """Remove what carried work, now that its rows can be read from the files."""
        if experiment.checkpoints is None:
            return
        paths = [
            path
            for cell in cells
            for runs, files in experiment.checkpoints(cell).items()
            if set(runs) <= set(seeds)
            for path in files
        ]
        if paths:
            self._read()
            for path in paths:
                path.unlink(missing_ok=True)  # two programs may fill the same files

    def lacking(self, experiment: Experiment, cell: Cell, seeds: Sequence[int]) -> list[int]:
        """The runs of a cell that are not there yet.

        Raises:
            ResultsError, OriginError: as in :meth:`fill`; rows are not looked at.
        """
        return self._missing(experiment, cell, seeds, self.batches())

    def _missing(
        self, experiment: Experiment, cell: Cell, seeds: Sequence[int], batches: list[Batch]
    ) -> list[int]:
        for batch in batches:
            if batch["columns"] == cell.columns:
                self._check_origin(experiment, cell, seeds, batch)
        return _lacking(cell, seeds, batches)

    def _read(self) -> tuple[pd.DataFrame, list[Batch]]:
        """Rows and batches, every batch checked against its rows."""
        types, batches = self._record()
        if not batches:  # or killed before the first batch was saved whole
            return NO_ROWS, []
        try:
            return self._parsed(read_whole(self.csv), types, batches), batches
        except (OSError, DamagedError) as error:
            raise ResultsError(f"{self.json.with_suffix('')}: cannot be read: {error}") from error

    def _parsed(self, text: bytes, types: dict[str, str], batches: list[Batch]) -> pd.DataFrame:
        """The rows of a CSV, every batch checked; types are those of the record, never guessed."""
        try:
            columns = pd.read_csv(io.BytesIO(text), nrows=0).columns
            if absent := [column for column in types if column not in columns]:
                raise ResultsError(
                    f"{self.csv}: column {absent[0]!r} is missing; needs {list(types)}"
                )
            rows = pd.read_csv(io.BytesIO(text), dtype=types, keep_default_na=False)
        except ResultsError:
            raise
        except ValueError as error:
            raise ResultsError(f"{self.json.with_suffix('')}: cannot be read: {error}") from error
        # Rows that no batch claims: the run was killed between the two renames. They are
        # computed again.
        kinds, lines = {tuple(batch["columns"]) for batch in batches}, _lines(rows)
        places = {names: _places(rows, names) for names in kinds}
        own = [_where(batch, places[tuple(batch["columns"])]) for batch in batches]
        for batch, chosen in zip(batches, own, strict=True):
            self._check_batch(batch, lines[chosen])
        return rows.iloc[np.concatenate(own)].reset_index(drop=True)

    def _record(self) -> tuple[dict[str, str], list[Batch]]:
        """The types of the columns of the rows that there are, and the batches."""
        if not os.path.lexists(self.json):  # a link that leads nowhere is not nothing
            if os.path.lexists(self.csv):
                raise ResultsError(
                    f"{self.csv}: has no {self.json.name} beside it that says where it comes from"
                )
            return {}, []
        try:
            record = read_record(self.json)
            types, batches = record["types"], record["batches"]
        except (DamagedError, KeyError, OSError) as error:
            raise ResultsError(f"{self.json.with_suffix('')}: cannot be read: {error}") from error
        return types if batches else {}, batches

    def _check_batch(self, batch: Batch, lines: np.ndarray) -> None:
        if len(lines) != batch["num_rows"] or _hash(lines) != batch["sha256"]:
            raise ResultsError(
                f"{self.csv}: the rows of {batch['columns']} are cut short or changed: "
                f"{len(lines)} rows, {batch['num_rows']} were written; restore the file"
            )

    def _check_origin(
        self, experiment: Experiment, cell: Cell, seeds: Sequence[int], batch: Batch
    ) -> None:
        """Whether the rows of a batch are what is asked for, in the runs that are asked for."""
        chosen = [seed for seed in batch["seeds"] if seed in seeds]
        if not chosen:
            return
        wanted = asked(experiment, cell, chosen)
        recorded = {key: batch[key] for key in wanted} | {
            "cell": filled(experiment.cell, batch["cell"])
        }
        recorded["reads"] = {
            name: read for name, read in batch["reads"].items() if name in wanted["reads"]
        }
        if recorded != wanted:
            raise OriginError(
                f"{self.csv}: the rows of {cell.columns}, runs {batch['seeds']}, are not what is "
                f"asked for: {difference(recorded, wanted)}. To compute them anew, move "
                f"{self.csv.name} and {self.json.name} away, or name another folder for the results"
            )

    def add(
        self, experiment: Experiment, cell: Cell, rows: pd.DataFrame, made: dict[str, Any]
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
                "finished": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
                **made,
            }
            batches = sorted(
                [*batches, batch], key=lambda b: json.dumps([b["columns"], b["seeds"]])
            )
            order = [column for column in rows.columns if column != "value"]
            together = pd.concat([present, rows]) if len(present) else rows
            together = together.sort_values(order, kind="stable")[list(rows.columns)]
            text = together.to_csv(index=False)
            self._check_comes_back(cell, text.encode(), types_of(rows), batches)
            if not self.json.exists():  # a CSV without a JSON would be somebody else's
                self.write_record(rows, [])
            replace_text(self.csv, text)
            self.write_record(together, batches)

    def _check_comes_back(
        self, cell: Cell, text: bytes, types: dict[str, str], batches: list[Batch]
    ) -> None:
        """Whether what is about to be written gives the same rows when it is read."""
        not_saved = f"{self.csv}: rows of {cell.columns} were not saved"
        recorded, _ = self._record()
        if recorded not in ({}, types):
            raise ResultsError(f"{not_saved}: they have {types}, those of the file {recorded}")
        try:
            self._parsed(text, types, batches)
        except ResultsError as error:
            raise ResultsError(f"{not_saved}: they would not come back as they are") from error

    def write_record(self, rows: pd.DataFrame, batches: list[Batch]) -> None:
        """Replace the record of these rows."""
        write_record(self.json, {"types": types_of(rows), "batches": batches})

    def _check_storable(self, cells: Sequence[Cell]) -> None:
        """Whether what cells have in their columns is of types that come back, and of the file's.

        A new file has the types of the first cell.
        """
        types, _ = self._record()
        types = types or {column: type_of(value) for column, value in cells[0].columns.items()}
        for cell in cells:
            for column, value in cell.columns.items():
                kind, wanted = type_of(value), types.get(column, "left out, as in the file")
                if kind not in TYPES or kind != wanted:
                    rule = wanted if kind in TYPES else f"one of {', '.join(TYPES)}"
                    raise ResultsError(
                        f"{self.csv}: {column} = {value!r} of {cell.columns}: must be {rule}"
                    )

    def check_writable(self) -> None:
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=self.folder).close()
        except OSError as error:
            raise ResultsError(
                f"folder = {self.folder}: must be writable, since rows of {self.name} are missing: "
                f"{error}. Name another folder for the results"
            ) from error


def type_of(value: Any) -> str:
    """The type of a value in a cell's columns, as the record names it; or its own name."""
    known = (name for name, kind in TYPES.items() if isinstance(value, kind))
    return next(known, type(value).__name__)


def timed(run: Callable, cell: Cell, seeds: list[int]) -> tuple[Cell, pd.DataFrame, dict]:
    """The rows of a run, checked, values to nine digits; where they were made; what they cost."""
    wall, cpu = time.perf_counter(), time.process_time()
    rows = run(cell, seeds)
    earlier = rows.attrs.pop("earlier_cpu_seconds", 0.0)
    made = {
        "cpu_seconds": round(time.process_time() - cpu + earlier, 2),
        "wall_seconds": round(time.perf_counter() - wall, 2),
        "versions": origin.versions(),
        "machine": origin.machine(),
        "commit": origin.commit(),
    }
    check_rows(cell, seeds, rows)
    rows["value"] = [float(f"{value:.9g}") for value in rows["value"]]
    return cell, rows, made


def asked(experiment: Experiment, cell: Cell, seeds: Sequence[int]) -> dict[str, Any]:
    """What rows are made of: the part of their origin that can be compared, as JSON has it."""
    name, options = origin.function(experiment.run)
    reads = experiment.reads or (lambda cell, seed: [])
    paths = [path for seed in seeds for path in reads(cell, seed)]
    digests = {path.name: digest_of(path) for path in paths}
    return plain({"cell": cell, "run": name, "options": options, "reads": digests})


def together(
    experiment: Experiment, cell: Cell, seeds: Sequence[int], missing: Sequence[int], size: int
) -> list[list[int]]:
    """The missing runs of a cell: those that were begun together, and so many of ``seeds`` each."""
    carried = experiment.checkpoints(cell) if experiment.checkpoints else ()
    begun = [list(runs) for runs in carried if set(runs) <= set(missing)]
    others = set(missing).difference(*begun)
    slices = [seeds[i : i + size] for i in range(0, len(seeds), size)]
    divided = [[seed for seed in part if seed in others] for part in slices]
    return begun + [runs for runs in divided if runs]


def select(rows: pd.DataFrame, columns: dict[str, Any]) -> pd.DataFrame:
    """The rows with these values in these columns."""
    keep = pd.Series(True, index=rows.index)
    for column, value in columns.items():
        keep &= rows[column] == value
    return rows[keep]


def digest(rows: pd.DataFrame) -> str:
    """A hash of rows that does not depend on their order."""
    return _hash(_lines(rows))


class _Lines(list):
    """What the csv module takes for a file; it writes a row at a time."""

    write = list.append


def _lines(rows: pd.DataFrame) -> np.ndarray:
    """Each row as a line of a CSV, its value last."""
    columns = [*sorted(set(rows.columns) - {"value"}), "value"]
    lines = _Lines()
    in_order = rows[columns].itertuples(index=False, name=None)
    csv.writer(lines, lineterminator="").writerows(in_order)
    return np.array(lines, dtype=object)


def _hash(lines: np.ndarray) -> str:
    return hashlib.sha256("\n".join(sorted(lines)).encode()).hexdigest()[:16]


def _places(rows: pd.DataFrame, names: Sequence[str]) -> dict[tuple, np.ndarray]:
    """By the values of these columns and the run, which rows have them."""
    found = rows.groupby([*names, "run"]).indices
    return found if names else {(run,): where for run, where in found.items()}


def _where(batch: Batch, places: dict[tuple, np.ndarray]) -> np.ndarray:
    """Which rows are those of a batch, by the places of its columns' values and each run."""
    values = batch["columns"].values()
    return np.sort(np.concatenate([places.get((*values, s), NOWHERE) for s in batch["seeds"]]))


def _lacking(cell: Cell, seeds: Iterable[int], batches: list[Batch]) -> list[int]:
    have = {
        seed for batch in batches if batch["columns"] == cell.columns for seed in batch["seeds"]
    }
    return [seed for seed in seeds if seed not in have]
