"""Executes the notebooks that changed: papermill, in parallel, each in a process of its own.

An executed copy is the committed notebook with outputs and nothing else that a run leaves
behind, so two runs differ only where results do. Times, date and versions go to a JSON record
beside it, together with the fingerprint of all that the outputs depend on.
"""

from __future__ import annotations

import copy
import hashlib
import json
import os
import platform
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path

import joblib
import nbformat
import papermill
import yaml
from IPython.core.inputtransformer2 import TransformerManager
from nbformat import NotebookNode
from tqdm import tqdm

import sources

WORKER = "import json, sys, papermill; papermill.execute_notebook(**json.loads(sys.argv[1]))"
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
DATA = ("paper", "results", "policies", "witness", "bench")  # what notebooks read
ANSI = re.compile(r"\x1b\[[0-9;]*m")


class BuildError(Exception):
    """Something that the reader of the message can repair; shown without a traceback."""


@dataclass(frozen=True)
class Notebook:
    """A chapter's notebook, the parameters of a profile, and where its executed copy goes."""

    name: str
    root: Path
    parameters: dict
    folder: Path

    @property
    def source(self) -> Path:
        return self.root / "notebooks" / f"{self.name}.ipynb"

    @property
    def executed(self) -> Path:
        return self.folder / f"{self.name}.ipynb"

    @property
    def record(self) -> Path:
        return self.folder / f"{self.name}.json"

    @property
    def failed(self) -> Path:
        return self.folder / f"{self.name}.failed.ipynb"

    def read(self) -> NotebookNode:
        return nbformat.read(self.source, as_version=4)

    def read_executed(self) -> NotebookNode:
        """The executed copy with today's text: prose may change without an execution."""
        return with_outputs(self.read(), nbformat.read(self.executed, as_version=4), self.root)

    def read_record(self) -> dict:
        return json.loads(self.record.read_text(encoding="utf-8"))

    def is_current(self) -> bool:
        """Whether the executed copy was made from what is there now."""
        return (
            self.executed.exists()
            and self.record.exists()
            and self.read_record()["fingerprint"] == fingerprint(self)
        )


# ------------------------------------------------------------------ which notebooks, with what


def load_notebooks(root: Path, profile: str, folder: Path) -> list[Notebook]:
    """The notebooks of the table of contents with the parameters of a profile, all checked."""
    toc = yaml.safe_load((root / "_toc.yml").read_text(encoding="utf-8"))
    names = [name for name in toc_entries(toc) if (root / f"notebooks/{name}.ipynb").exists()]
    parameters = load_profile(root, profile)
    if unknown := parameters.keys() - set(names):
        raise BuildError(
            f"notebooks/profiles/{profile}.yml names {listed(unknown)}, "
            f"but the notebooks in _toc.yml are {listed(names)}"
        )
    notebooks = [Notebook(name, root, parameters.get(name, {}), folder) for name in names]
    for notebook in notebooks:
        check_parameters(notebook, profile)
    return notebooks


def toc_entries(toc: object) -> Iterator[str]:
    """The pages that a table of contents names, at any depth."""
    if isinstance(toc, dict):
        for key, value in toc.items():
            if key in ("root", "file"):
                yield value
            else:
                yield from toc_entries(value)
    elif isinstance(toc, list):
        for item in toc:
            yield from toc_entries(item)


def load_profile(root: Path, profile: str) -> dict:
    """Notebook name -> parameters, from notebooks/profiles/<profile>.yml."""
    path = root / "notebooks" / "profiles" / f"{profile}.yml"
    if not path.exists():
        known = sorted(other.stem for other in path.parent.glob("*.yml"))
        raise BuildError(f"There is no profile {profile!r}; the profiles are {listed(known)}")
    parameters = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
    mappings = [parameters, *parameters.values()] if isinstance(parameters, dict) else [parameters]
    if not all(isinstance(mapping, dict) for mapping in mappings):
        raise BuildError(f"notebooks/profiles/{profile}.yml must map notebooks to parameters")
    return parameters


def check_parameters(notebook: Notebook, profile: str) -> None:
    """Papermill only warns of a parameter that a notebook does not have; this is an error."""
    known = papermill.inspect_notebook(str(notebook.source))
    if unknown := notebook.parameters.keys() - known.keys():
        raise BuildError(
            f"notebooks/profiles/{profile}.yml gives {notebook.name} the parameter "
            f"{listed(unknown)}, but its `parameters` cell has {listed(known)}"
        )


def listed(names) -> str:
    return ", ".join(sorted(names)) or "none"


def fingerprint(notebook: Notebook) -> str:
    """Hash of all that the outputs depend on: code, parameters, data, ipo modules, packages."""
    cells = [cell for cell in notebook.read().cells if cell.cell_type == "code"]
    code = [[cell.source, cell.metadata.get("tags", [])] for cell in cells]
    python = TransformerManager().transform_cell("\n".join(cell.source for cell in cells))
    # All of it, not only the chapter's own: one chapter may show what another one has computed.
    folders = [notebook.root / "data" / name for name in DATA]
    everything = {
        "code": code,
        "parameters": notebook.parameters,
        "modules": sources.source_hash(sources.imported_modules(python)),
        "data": {str(folder.relative_to(notebook.root)): tree_hash(folder) for folder in folders},
        "packages": (notebook.root / "environment.txt").read_text(encoding="utf-8"),
    }
    return hashlib.sha256(json.dumps(everything, sort_keys=True).encode()).hexdigest()


def tree_hash(folder: Path) -> str:
    """Hash of the names and contents of all files in a folder."""
    digest = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        content = hashlib.sha256(path.read_bytes()).hexdigest()
        digest.update(f"{path.relative_to(folder).as_posix()} {content}\n".encode())
    return digest.hexdigest()


# ------------------------------------------------------------------------------- executing


@dataclass
class Run:
    """One notebook on its way through papermill."""

    notebook: Notebook
    environment: dict
    source: NotebookNode = field(init=False)  # as it was at the start; it may be edited meanwhile
    fingerprint: str = field(init=False)
    process: subprocess.Popen = field(init=False)

    @property
    def raw(self) -> Path:
        """What papermill writes after every cell."""
        return self.notebook.folder / f"{self.notebook.name}.running.ipynb"

    @property
    def log(self) -> Path:
        return self.raw.with_suffix(".log")

    def start(self) -> None:
        self.source = self.notebook.read()
        self.fingerprint = fingerprint(self.notebook)
        self.notebook.folder.mkdir(parents=True, exist_ok=True)
        self.raw.unlink(missing_ok=True)
        arguments = {
            "input_path": str(self.notebook.source),
            "output_path": str(self.raw),
            "parameters": self.notebook.parameters,
            "kernel_name": "python3",
            "cwd": str(self.notebook.root),
            "progress_bar": False,
            "coalesce_streams": True,  # where a stream is cut depends on timing
        }
        with self.log.open("w") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-c", WORKER, json.dumps(arguments)],
                env=os.environ | self.environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )

    def num_cells_done(self) -> int:
        try:
            raw = nbformat.from_dict(json.loads(self.raw.read_text(encoding="utf-8")))
        except (FileNotFoundError, json.JSONDecodeError):  # not there yet, or being written
            return 0
        cells = cells_of_source(raw)
        return [cell.metadata.papermill.status for cell in cells].count("completed")

    def keep(self) -> None:
        """Replace the executed copy; the record comes last, since it carries the fingerprint."""
        raw = nbformat.read(self.raw, as_version=4)
        executed = with_outputs(self.source, raw, self.notebook.root)
        record = {"fingerprint": self.fingerprint} | run_record(raw)
        replace_text(self.notebook.executed, nbformat.writes(executed))
        replace_text(self.notebook.record, json.dumps(record, indent=1) + "\n")
        for path in (self.raw, self.log, self.notebook.failed):
            path.unlink(missing_ok=True)

    def explain_failure(self) -> str:
        """Which cell failed and how; the broken run stays for inspection."""
        log = self.log.read_text(encoding="utf-8").strip()
        self.log.unlink()
        if not self.raw.exists():
            return f"{self.notebook.name} could not be started:\n{log}"
        self.raw.replace(self.notebook.failed)
        raw = nbformat.read(self.notebook.failed, as_version=4)
        number, cell = last_started(raw)
        errors = [output for output in cell.get("outputs", []) if output.output_type == "error"]
        # Without an error in the cell, its kernel died; papermill's last line says so.
        traceback = "\n".join(errors[-1].traceback) if errors else log.splitlines()[-1]
        return (
            f"{self.notebook.name}, cell {number} failed: {first_line(cell)}\n"
            f"{for_terminal(traceback)}\n"
            f"The run so far is in {shown(self.notebook.failed)}"
        )


def execute(notebooks: list[Notebook], jobs: int) -> list[str]:
    """Execute notebooks, so many at a time; returns what to say about each that failed."""
    threads = str(max(1, joblib.cpu_count() // jobs))
    environment = dict.fromkeys(THREAD_VARIABLES, threads) | {
        # This environment's kernel, whatever kernels the user has installed elsewhere.
        "JUPYTER_PREFER_ENV_PATH": "1",
        # Bars are plain text here, and need no widgets.
        "PYTHONWARNINGS": "ignore:IProgress not found",
    }
    waiting = [Run(notebook, environment) for notebook in notebooks]
    running: list[Run] = []
    failures = []
    progress = Progress(notebooks)
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                running.append(waiting.pop(0))
                running[-1].start()
            time.sleep(0.2)
            for run in list(running):
                status = run.process.poll()
                if status is None:
                    progress.update(run.notebook, run.num_cells_done())
                    continue
                running.remove(run)
                if status == 0:
                    progress.finish(run.notebook)
                    run.keep()
                else:
                    failures.append(run.explain_failure())
    finally:
        progress.close()
        for run in running:  # interrupted: the kernels end with the processes that started them
            run.process.terminate()
    return failures


class Progress:
    """One bar over the cells of all notebooks; plain lines where there is no terminal."""

    def __init__(self, notebooks: list[Notebook]):
        self.total = {notebook.name: len(notebook.read().cells) for notebook in notebooks}
        self.done = dict.fromkeys(self.total, 0)
        self.terminal = sys.stderr.isatty()
        self.bar = tqdm(
            total=sum(self.total.values()), unit="cell", leave=False, disable=not self.terminal
        )

    def update(self, notebook: Notebook, num_done: int) -> None:
        name = notebook.name
        if num_done <= self.done[name]:
            return
        self.done[name] = num_done
        self.bar.set_description(name)
        self.bar.update(sum(self.done.values()) - self.bar.n)
        if not self.terminal:
            print(f"{name}: {num_done} of {self.total[name]} cells", file=sys.stderr, flush=True)

    def finish(self, notebook: Notebook) -> None:
        self.update(notebook, self.total[notebook.name])

    def close(self) -> None:
        self.bar.close()


# -------------------------------------------------------------- what is kept of an execution


def with_outputs(source: NotebookNode, executed: NotebookNode, root: Path) -> NotebookNode:
    """The source notebook with the outputs of an execution of the same code cells.

    The cell with the injected parameters stays, for whoever downloads the notebook, but is
    hidden from the page.
    """
    code = [cell for cell in executed.cells if cell.cell_type == "code"]
    injected = [copy.deepcopy(cell) for cell in code if is_tagged(cell, "injected-parameters")]
    ran = iter(cell for cell in code if not is_tagged(cell, "injected-parameters"))
    for cell in injected:
        cell.update(id="injected-parameters", metadata=NotebookNode())
        cell.metadata.tags = ["injected-parameters", "remove-cell"]
    result = copy.deepcopy(source)
    result.cells = []
    for cell in copy.deepcopy(source.cells):
        result.cells.append(cell)
        if cell.cell_type == "code":
            twin = next(ran)
            cell.execution_count = twin.execution_count
            cell.outputs = [
                reproducible(output, cell, root)
                for output in twin.outputs
                if is_shown(output, cell)
            ]
        if is_tagged(cell, "parameters"):
            result.cells.extend(injected)
    if "language_info" in executed.metadata:
        result.metadata.language_info = executed.metadata.language_info
    return result


def is_tagged(cell: NotebookNode, tag: str) -> bool:
    return tag in cell.metadata.get("tags", [])


def is_shown(output: NotebookNode, cell: NotebookNode) -> bool:
    """Everything, except the progress bars of cells that are tagged `progress`."""
    return not (is_tagged(cell, "progress") and output.get("name") == "stderr")


def reproducible(output: NotebookNode, cell: NotebookNode, root: Path) -> NotebookNode:
    """An output without what differs in every run: where it ran, addresses, random names."""
    if output.get("name") == "stderr":  # warnings name the file that gave them
        output.text = output.text.replace(f"{root}{os.sep}", "")
        output.text = re.sub(r"\S*ipykernel_\d+[/\\]\d+\.py", "<cell>", output.text)
    data = output.get("data", {})
    if "text/plain" in data:
        data["text/plain"] = re.sub(r" at 0x[0-9a-f]+", "", data["text/plain"])
    if "text/html" in data:  # pandas gives each styled table a random name
        random_names = re.findall(r'<table id="(T_[0-9a-f]{5})"', data["text/html"])
        for number, name in enumerate(random_names):
            data["text/html"] = data["text/html"].replace(name, f"T_{cell.id}_{number}")
    return output


def run_record(raw: NotebookNode) -> dict:
    """What papermill measured, and on what."""
    numbered = enumerate(cells_of_source(raw), start=1)
    return {
        "date": raw.metadata.papermill.start_time[:10],
        "seconds": raw.metadata.papermill.duration,
        "cores": joblib.cpu_count(),
        "versions": {"python": platform.python_version(), "torch": version("torch")},
        "cells": [
            {
                "cell": number,
                "first_line": first_line(cell),
                "seconds": cell.metadata.papermill.duration,
            }
            for number, cell in numbered
            if cell.cell_type == "code"
        ],
    }


def cells_of_source(raw: NotebookNode) -> list[NotebookNode]:
    """The cells of an execution that are in the source, so that their numbers agree."""
    added = ("injected-parameters", "papermill-error-cell-tag")
    return [cell for cell in raw.cells if not any(is_tagged(cell, tag) for tag in added)]


def last_started(raw: NotebookNode) -> tuple[int, NotebookNode]:
    """The cell that an execution came to, with its number in the source."""
    started = [
        (number, cell)
        for number, cell in enumerate(cells_of_source(raw), start=1)
        if cell.metadata.papermill.start_time
    ]
    return started[-1]


def first_line(cell: NotebookNode) -> str:
    """The first line of a cell that does something, or else its first line."""
    lines = [line.strip() for line in cell.source.splitlines() if line.strip()]
    return next((line for line in lines if not line.startswith("#")), "".join(lines[:1]))


def for_terminal(text: str) -> str:
    return text if sys.stderr.isatty() else ANSI.sub("", text)


def shown(path: Path) -> str:
    """A path as the user would type it from here."""
    return os.path.relpath(path)


def replace_text(path: Path, text: str) -> None:
    """Write a file so that a reader sees the old one or the new one, never half of it."""
    partial = path.with_name(path.name + ".partial")
    partial.write_text(text, encoding="utf-8")
    partial.replace(path)
