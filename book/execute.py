"""Executes the notebooks that changed: papermill, in parallel, each in a process of its own."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import joblib
import nbformat
from nbformat import NotebookNode
from tqdm import tqdm

from chapters import Notebook, fingerprint
from experiments.orphans import python
from messages import for_terminal, shown
from outputs import cells_of_source, first_line, last_started, run_record, with_outputs

WORKER = "import json, papermill; papermill.execute_notebook(**json.loads(sys.argv[1]))"
LEAST_FREE = 2**20  # bytes of a disk that is not full
# Fonts of this environment, and no settings of the user's, who may draw otherwise elsewhere.
DRAWING = Path(sys.prefix) / "share" / "matplotlib"
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


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
                python(WORKER, json.dumps(arguments)),
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
        """Replace the executed copy, and remove what the run has left."""
        raw = nbformat.read(self.raw, as_version=4)
        executed = with_outputs(self.source, raw, self.notebook.root)
        self.notebook.keep(executed, {"fingerprint": self.fingerprint} | run_record(raw))
        for path in (self.raw, self.log, self.notebook.failed):
            path.unlink(missing_ok=True)

    def explain_failure(self) -> str:
        """Which cell failed and how; the broken run stays for inspection."""
        log = self.log.read_text(encoding="utf-8").strip()
        self.log.unlink()
        if not self.raw.exists():
            return f"{self.notebook.name} could not be started:\n{log}"
        self.raw.replace(self.notebook.failed)
        try:
            raw = nbformat.read(self.notebook.failed, as_version=4)
        except ValueError:  # papermill writes it anew after every cell, or could not
            free = shutil.disk_usage(self.notebook.folder).free
            cause = log or (os.strerror(errno.ENOSPC) if free < LEAST_FREE else "no message")
            return f"{self.notebook.name} ended while it was written: {cause}"
        number, cell = last_started(raw)
        errors = [output for output in cell.get("outputs", []) if output.output_type == "error"]
        # Without an error in the cell, its kernel died; papermill's last line says so.
        traceback = "\n".join(errors[-1].traceback) if errors else log.rpartition("\n")[-1]
        return (
            f"{self.notebook.name}, cell {number} failed: {first_line(cell)}\n"
            f"{for_terminal(traceback)}\n"
            f"The run so far is in {shown(self.notebook.failed)}"
        )


def execute(notebooks: list[Notebook], jobs: int) -> list[str]:
    """Execute notebooks, so many at a time; returns what to say about each that failed."""
    if not notebooks:
        return []
    list_fonts()
    threads = str(max(1, joblib.cpu_count() // jobs))
    environment = dict.fromkeys(THREAD_VARIABLES, threads) | {
        "MPLCONFIGDIR": str(DRAWING),
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
                waiting[0].start()
                running.append(waiting.pop(0))
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
            run.process.wait()
    return failures


def list_fonts() -> None:
    """Look for them now: a notebook that did would say among its outputs how long it takes."""
    command = [sys.executable, "-c", "import matplotlib.font_manager"]
    subprocess.run(command, env=os.environ | {"MPLCONFIGDIR": str(DRAWING)}, capture_output=True)


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
