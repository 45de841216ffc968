"""Results with provenance: load rows that were computed before, compute only what is missing.

A result is ``<name>.csv``, tidy rows, and ``<name>.json``, which says for every batch of rows
from which parameters, seeds, source code, versions and machine it came, and what it cost.
Both are replaced by renaming a finished temporary file, so a killed run leaves whole files.
"""

from __future__ import annotations

import datetime
import hashlib
import json
import os
import platform
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol

import joblib
import pandas as pd
from filelock import FileLock
from tqdm import tqdm

from ipo.checks import check_counts
from ipo.provenance import source_hash

VERSIONS = ("torch", "numpy", "scipy", "pandas")
BATCH_KEYS = {"columns", "cell", "seeds", "num_rows", "sha256", "source_hash"}
NO_ROWS = pd.DataFrame({"run": pd.Series(dtype=int)})


class ResultsError(ValueError):
    """A results file that cannot be used; nothing was changed."""


class StaleResultsError(ResultsError):
    """Rows that today's code or parameters would not produce; nothing was changed."""


class StaleResultsWarning(UserWarning):
    """Stale rows are shown because the caller asked for them."""


class Cell(Protocol):
    """What identifies a batch of runs: a frozen dataclass whose ``columns`` name its rows."""

    @property
    def columns(self) -> dict[str, Any]: ...


def run_or_load(
    folder: str | Path,
    name: str,
    cells: Sequence[Cell],
    seeds: Sequence[int],
    run: Callable[[Cell, list[int]], pd.DataFrame],
    modules: Sequence[str],
    num_workers: int | None = None,
    runs_at_once: int | None = None,
    allow_stale: bool = False,
    confirm: bool = False,
) -> pd.DataFrame:
    """The rows of ``cells`` x ``seeds``: loaded where they exist, computed where they do not.

    Args:
        folder, name: the rows live in ``folder/name.csv`` and ``folder/name.json``.
        cells: the configurations; their ``columns`` are the first columns of their rows.
        seeds: the runs of every cell.
        run: ``run(cell, seeds)`` returns the rows, with the cell's columns and ``run``.
        modules: the ``ipo`` modules whose source decides the rows.
        num_workers: processes that compute; ``None`` leaves it to ``joblib.parallel_config``.
        runs_at_once: how many runs of a cell are computed, and saved, together; ``None``: all.
        allow_stale: use stale rows with a :class:`StaleResultsWarning` instead of an error.
        confirm: prove stale rows instead. One batch of every stale cell is computed again; where
            it is the same to the last digit, the batches of that cell that came from the same code
            and parameters count as today's, and their record keeps what it said before.

    Every finished batch is saved at once: after an interruption the next call goes on with
    what is missing and ends with the same rows.

    Raises:
        ResultsError: a file that is damaged, or a folder that cannot be written.
        StaleResultsError: rows from other source code or parameters than today's, or rows that
            ``confirm`` finds to be different.
    """
    check_counts("seeds", seeds, minimum=0)
    store = _Store(Path(folder), name)
    today = source_hash(modules)
    if confirm:
        _confirm(store, cells, run, today, num_workers)
    rows, batches = store.read()
    _report_stale(
        store, [s for cell in cells for s in _staleness(cell, batches, today)], allow_stale
    )

    size = runs_at_once or len(seeds)
    lacking = [(cell, _lacking(cell, seeds, batches)) for cell in cells]
    missing = [
        (cell, runs[i : i + size]) for cell, runs in lacking for i in range(0, len(runs), size)
    ]
    if missing:
        store.check_writable()
        jobs = (joblib.delayed(_timed)(run, cell, runs) for cell, runs in missing)
        work = joblib.Parallel(n_jobs=num_workers, return_as="generator_unordered")(jobs)
        for cell, new_rows, cost in tqdm(work, desc=name, total=len(missing), unit="batch"):
            store.add(cell, new_rows, today, cost)
        rows, batches = store.read()
    wanted = rows[rows["run"].isin(seeds)]
    parts = [_select(wanted, cell.columns) for cell in cells]
    return pd.concat(parts, ignore_index=True)


def provenance(folder: str | Path, name: str) -> list[dict[str, Any]]:
    """The batches behind ``folder/name.csv``, as recorded when they were computed."""
    return _Store(Path(folder), name).read()[1]


def stale_batches(folder: str | Path, name: str, modules: Sequence[str]) -> list[dict[str, Any]]:
    """The recorded batches that come from other source code than today's."""
    today = source_hash(modules)
    return [batch for batch in provenance(folder, name) if batch["source_hash"] != today]


class _Store:
    """The CSV and the JSON of one result."""

    def __init__(self, folder: Path, name: str) -> None:
        self.csv, self.json = folder / f"{name}.csv", folder / f"{name}.json"

    def read(self) -> tuple[pd.DataFrame, list[dict[str, Any]]]:
        """Rows and batches, every batch checked against its rows."""
        if not self.json.exists():
            if self.csv.exists():
                raise ResultsError(
                    f"{self.csv}: has no {self.json.name} beside it that says where it comes from"
                )
            return NO_ROWS, []
        try:
            batches = json.loads(self.json.read_text())["batches"]
            for batch in batches:
                if absent := BATCH_KEYS - batch.keys():
                    raise KeyError(f"a batch without {min(absent)}")
            rows = pd.read_csv(self.csv, dtype={"domain": str}) if batches else NO_ROWS
        except (ValueError, KeyError, TypeError, AttributeError, OSError) as error:
            raise ResultsError(f"{self.json.with_suffix('')}: cannot be read: {error}") from error
        if not batches:  # killed before the first batch was saved whole
            return NO_ROWS, []
        for batch in batches:
            needed = [*batch["columns"], "run", "domain", "metric", "value"]
            absent = [column for column in needed if column not in rows.columns]
            if absent:
                raise ResultsError(f"{self.csv}: column {absent[0]!r} is missing; needs {needed}")
        # Rows that no batch claims: the run was killed between the two renames. They are
        # computed again.
        parts = [self._checked(rows, batch) for batch in batches]
        return pd.concat(parts, ignore_index=True), batches

    def _checked(self, rows: pd.DataFrame, batch: dict[str, Any]) -> pd.DataFrame:
        part = _select(rows[rows["run"].isin(batch["seeds"])], batch["columns"])
        if len(part) != batch["num_rows"] or _digest(part) != batch["sha256"]:
            raise ResultsError(
                f"{self.csv}: the rows of {batch['columns']} are cut short or changed: "
                f"{len(part)} rows, {batch['num_rows']} were written; restore the file"
            )
        return part

    def add(self, cell: Cell, new_rows: pd.DataFrame, today: str, cost: dict[str, float]) -> None:
        """Add the rows of one cell. Two programs may fill the same files at the same time.

        Runs that the other one has added in the meantime are kept as they are.
        """
        with FileLock(self.csv.with_suffix(".lock")):
            rows, batches = self.read()
            new_rows = new_rows[new_rows["run"].isin(_lacking(cell, new_rows["run"], batches))]
            if new_rows.empty:
                return
            batches = [*batches, _batch(cell, new_rows, today, cost)]
            order = [column for column in new_rows.columns if column != "value"]
            rows = pd.concat([rows, new_rows]) if len(rows) else new_rows
            rows = rows.sort_values(order, kind="stable")[list(new_rows.columns)]
            batches.sort(key=lambda batch: json.dumps([batch["columns"], batch["seeds"]]))
            if not self.json.exists():  # a CSV without a JSON would be somebody else's
                self._write_batches([])
            _replace(self.csv, rows.to_csv(index=False))
            self._write_batches(batches)

    def _write_batches(self, batches: list[dict[str, Any]]) -> None:
        _replace(self.json, json.dumps({"batches": batches}, indent=1) + "\n")

    def renew(self, proved: dict[str, Any], cell: Cell, today: str) -> None:
        """Record that today's code and parameters give the rows of a batch."""
        with FileLock(self.csv.with_suffix(".lock")):
            _, batches = self.read()
            origin = {key: proved[key] for key in ("columns", "cell", "source_hash")}
            for batch in batches:
                if {key: batch[key] for key in origin} == origin:
                    earlier = batch.setdefault("earlier", [])
                    earlier.append({key: origin[key] for key in ("cell", "source_hash")})
                    earlier[-1]["proved_by_seeds"] = proved["seeds"]
                    batch |= {"cell": asdict(cell), "source_hash": today}
            self._write_batches(batches)

    def check_writable(self) -> None:
        try:
            self.csv.parent.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=self.csv.parent).close()
        except OSError as error:
            raise ResultsError(f"folder = {self.csv.parent}: must be writable: {error}") from error


def _select(rows: pd.DataFrame, columns: dict[str, Any]) -> pd.DataFrame:
    """The rows with these values in these columns."""
    keep = pd.Series(True, index=rows.index)
    for column, value in columns.items():
        keep &= rows[column] == value
    return rows[keep]


def _lacking(cell: Cell, seeds: Sequence[int], batches: list[dict[str, Any]]) -> list[int]:
    have = {
        seed for batch in batches if batch["columns"] == cell.columns for seed in batch["seeds"]
    }
    return [seed for seed in seeds if seed not in have]


def _staleness(cell: Cell, batches: list[dict[str, Any]], today: str) -> list[str]:
    """What is stale in the batches of a cell, in words."""
    wanted = json.loads(json.dumps(asdict(cell)))
    reasons = []
    for batch in batches:
        if batch["columns"] != cell.columns:
            continue
        if batch["cell"] != wanted:
            reasons.append(f"{cell.columns}: {_difference(batch['cell'], wanted)}")
        if batch["source_hash"] != today:
            reasons.append(f"{cell.columns}: source {batch['source_hash']}, today's is {today}")
    return reasons


def _difference(recorded: dict, wanted: dict, prefix: str = "") -> str:
    parts = []
    for key in sorted({*recorded, *wanted}):
        old, new = recorded.get(key), wanted.get(key)
        if isinstance(old, dict) and isinstance(new, dict):
            parts.append(_difference(old, new, f"{key}."))
        elif old != new:
            parts.append(f"{prefix}{key} = {old!r}, asked for {new!r}")
    return "; ".join(part for part in parts if part)


def _report_stale(store: _Store, reasons: list[str], allow_stale: bool) -> None:
    if not reasons:
        return
    message = (
        f"{store.csv}: {len(reasons)} stale batches. {reasons[0]}. To compute them again, move "
        f"{store.csv.name} and {store.json.name} away, or name another folder for the results."
    )
    if not allow_stale:
        raise StaleResultsError(message)
    warnings.warn(message, StaleResultsWarning, stacklevel=3)


def _confirm(
    store: _Store, cells: Sequence[Cell], run: Callable, today: str, num_workers: int | None
) -> None:
    """Compute one batch of every stale cell again, and renew the cell where nothing differs."""
    _, batches = store.read()
    stale = [
        (
            cell,
            [b for b in batches if b["columns"] == cell.columns and _staleness(cell, [b], today)],
        )
        for cell in cells
    ]
    first = [(cell, own[0]) for cell, own in stale if own]
    jobs = (joblib.delayed(_proof)(run, cell, batch) for cell, batch in first)
    work = joblib.Parallel(n_jobs=num_workers, return_as="generator")(jobs)
    bar = tqdm(zip(first, work, strict=True), desc=f"{store.csv.stem}, proof", total=len(first))
    for (cell, batch), digest in bar:
        if digest != batch["sha256"]:
            raise StaleResultsError(
                f"{store.csv}: {cell.columns}, runs {batch['seeds']}: today's code gives other rows"
            )
        store.renew(batch, cell, today)


def _proof(run: Callable, cell: Cell, batch: dict[str, Any]) -> str:
    return _digest(_timed(run, cell, batch["seeds"])[1])


def _timed(
    run: Callable, cell: Cell, seeds: list[int]
) -> tuple[Cell, pd.DataFrame, dict[str, float]]:
    wall, cpu = time.perf_counter(), time.process_time()
    rows = run(cell, seeds)
    cost = {
        "cpu_seconds": round(time.process_time() - cpu, 2),
        "wall_seconds": round(time.perf_counter() - wall, 2),
    }
    rows["value"] = [float(f"{value:.9g}") for value in rows["value"]]
    return cell, rows, cost


def _batch(cell: Cell, rows: pd.DataFrame, today: str, cost: dict[str, float]) -> dict[str, Any]:
    return {
        "columns": cell.columns,
        "cell": asdict(cell),
        "seeds": sorted(int(seed) for seed in rows["run"].unique()),
        "num_rows": len(rows),
        "sha256": _digest(rows),
        "source_hash": today,
        "versions": {"python": platform.python_version(), **{p: version(p) for p in VERSIONS}},
        "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
        "finished": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        **cost,
    }


def _digest(rows: pd.DataFrame) -> str:
    """A hash of rows that does not depend on their order."""
    columns = [*sorted(set(rows.columns) - {"value"}), "value"]
    lines = rows[columns].to_csv(index=False, header=False).splitlines()
    return hashlib.sha256("\n".join(sorted(lines)).encode()).hexdigest()[:16]


def _replace(path: Path, text: str) -> None:
    """Write to a temporary file, then rename: readers see the old file or the new one."""
    with tempfile.NamedTemporaryFile("w", dir=path.parent, suffix=".tmp", delete=False) as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    os.chmod(file.name, 0o644)
    os.replace(file.name, path)
