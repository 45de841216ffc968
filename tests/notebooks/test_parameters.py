"""Bad parameters of a notebook are refused by name in its first cells, before any work."""

from pathlib import Path
from typing import Any

import nbformat
import pytest

NOTEBOOKS = Path(__file__).resolve().parents[2] / "notebooks"
FIRST = 3  # code cells: the defaults, the checks, imports and the chapter

# By the type of the default; None stands for what may be left out.
BAD = {
    int: (0, -1, 2.5, "three", [3], True),
    list: (3, "x", [], [None], [-1.0]),
    str: (5, "", [3]),
    type(None): (0, 2.5, "three"),
}
ANYTHING = {"authors_repository"}  # a folder, which is looked at where it is used


def first_cells(name: str) -> list[str]:
    notebook = nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)
    return [cell.source for cell in notebook.cells if cell.cell_type == "code"][:FIRST]


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


CASES = [
    (path.stem, parameter, value)
    for path in sorted(NOTEBOOKS.glob("*.ipynb"))
    for parameter, default in defaults(path.stem).items()
    if parameter not in ANYTHING
    for value in BAD[type(default)]
]


@pytest.mark.parametrize(("name", "parameter", "value"), CASES)
def test_bad_parameter_is_refused_by_name(name, parameter, value):
    with pytest.raises((TypeError, ValueError), match=rf"^{parameter}(\[.*\])? = "):
        begin(name, **{parameter: value})


@pytest.mark.parametrize("name", sorted({name for name, *_ in CASES}))
def test_defaults_are_taken(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    begin(name)
