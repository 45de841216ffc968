"""Whatever ends a sweep or a build, its workers and kernels end with it."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import nbformat
import psutil
import pytest
from nbformat.v4 import new_code_cell, new_notebook

SWEEP = """import sys, time, toy_experiment
def run(cell, seeds): time.sleep(100)
toy_experiment.fill(sys.argv[1], run=run, num_workers=2)"""
BUILD = "import sys; from pathlib import Path; from build import main; main([], Path(sys.argv[1]))"
CELL = """import time, joblib
from experiments.work import parallel
parallel(2)(joblib.delayed(time.sleep)(100) for _ in range(2))"""
FILES = {
    "_toc.yml": "format: jb-book\nroot: sleepy\n",
    "environment.txt": "",
    "notebooks/profiles/class.yml": "",
}


def prepare_build(folder: Path) -> None:
    """A project with one notebook, whose workers sleep."""
    for path, text in FILES.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(text)
    cells = [new_code_cell("", metadata={"tags": ["parameters"]}), new_code_cell(CELL)]
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    notebook = new_notebook(cells=cells, metadata={"kernelspec": kernel})
    nbformat.write(notebook, folder / "notebooks" / "sleepy.ipynb")


def workers(descendants: list[psutil.Process]) -> list[psutil.Process]:
    found = []
    for process in descendants:
        try:
            if any("LokyProcess" in word for word in process.cmdline()):
                found.append(process)
        except psutil.NoSuchProcess:  # one of the short ones
            pass
    return found


@pytest.mark.parametrize(
    ("program", "how"),
    [
        pytest.param(SWEEP, signal.SIGKILL, id="sweep killed"),
        pytest.param(BUILD, signal.SIGKILL, id="build killed"),
        pytest.param(BUILD, signal.SIGTERM, id="build terminated", marks=pytest.mark.slow),
    ],
)
def test_nothing_outlives_what_started_it(tmp_path, program, how):
    if program == BUILD:
        prepare_build(tmp_path)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    parent = subprocess.Popen(
        [sys.executable, "-c", program, str(tmp_path)], env=environment, stderr=subprocess.DEVNULL
    )
    descendants, deadline = [], time.time() + 100
    while len(workers(descendants)) < 2 and time.time() < deadline:
        assert parent.poll() is None
        time.sleep(0.1)
        descendants = psutil.Process(parent.pid).children(recursive=True)
    assert len(workers(descendants)) == 2
    parent.send_signal(how)
    parent.wait(20)
    _, alive = psutil.wait_procs(descendants, timeout=20)
    for process in alive:
        process.kill()
    assert alive == []
