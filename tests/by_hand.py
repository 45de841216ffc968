"""Notebooks as a reader runs them: by papermill, or only their first cells."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import nbformat
import yaml

from chapters import DATA, tree_hash

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = ROOT / "notebooks"
NAMES = [path.stem for path in sorted(NOTEBOOKS.glob("*.ipynb"))]
SMOKE = yaml.safe_load((NOTEBOOKS / "profiles" / "smoke.yml").read_text())
FIRST = 3  # code cells: the defaults, the checks, imports and the chapter


def papermill(name: str, output: Path, *options: str) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "papermill", f"notebooks/{name}.ipynb", str(output), *options]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True)


def run_elsewhere(name: str, folder: Path, given: dict[str, Any]) -> subprocess.CompletedProcess:
    """In the smoke profile but for what is given, into ``folder``; rows are in its ``rows``."""
    parameters = SMOKE[name] | given
    if "results_dir" in parameters:
        parameters["results_dir"] = "rows"
    options = ("--cwd", str(folder), "-y", yaml.safe_dump(parameters))
    return papermill(name, folder / "out.ipynb", *options)


def shipped() -> dict[str, str]:
    """Digests of the folders of data/."""
    return {name: tree_hash(ROOT / "data" / name) for name in DATA}


def code_cells(path: Path) -> list[nbformat.NotebookNode]:
    notebook = nbformat.read(path, as_version=4)
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def first_cells(name: str) -> list[str]:
    return [cell.source for cell in code_cells(NOTEBOOKS / f"{name}.ipynb")[:FIRST]]


def defaults(name: str) -> dict[str, Any]:
    namespace: dict[str, Any] = {}
    exec(first_cells(name)[0], {}, namespace)
    return namespace


def begin(name: str, **given: Any) -> None:
    """The first cells as papermill runs them, with its own cell of parameters after the first."""
    given_cell = "\n".join(
        ["# Parameters", *(f"{key} = {value!r}" for key, value in given.items())]
    )
    cells = first_cells(name)
    cells.insert(1, given_cell)
    namespace = {"In": ["", *cells[:2]]}
    for source in cells:
        exec(source, namespace)
