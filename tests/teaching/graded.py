"""The exercises with code: their cells, and what becomes of an answer, without a kernel."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import nbformat
import yaml
from nbformat import NotebookNode
from nbgrader.preprocessors import ClearSolutions

import teaching

ROOT = Path(__file__).resolve().parents[2]
SOURCES = sorted((ROOT / "notebooks" / "exercises").glob("*/*.ipynb"))


def role(cell: NotebookNode) -> str:
    """``solution`` and ``check`` are code, ``essay`` is graded by hand, ``given`` all else."""
    of = cell.metadata.get("nbgrader", {})
    if of.get("solution"):
        return "solution" if cell.cell_type == "code" else "essay"
    return "check" if of.get("grade") else "given"


@dataclass(frozen=True)
class Exercise:
    """A solution, the cells before it since the last one, and its check."""

    name: str
    given: list[str]
    solution: str
    check: str
    points: float

    @cached_property
    def blank(self) -> str:
        """What a student finds, by nbgrader."""
        cell = nbformat.v4.new_code_cell(self.solution)
        cell.metadata["nbgrader"] = {"solution": True, "schema_version": 3}
        ClearSolutions().preprocess_cell(cell, {"language": "python"}, 0)
        return cell.source

    @property
    def mistakes(self) -> list[dict]:
        return MISTAKES[self.name]

    def with_mistake(self, mistake: dict) -> str:
        wrong = self.solution
        for old, new in mistake["change"].items():
            assert old in wrong, f"{self.name}: the reference solution does not have {old!r}"
            wrong = wrong.replace(old, new)
        return wrong


MISTAKES = {
    name: mistakes
    for path in sorted((Path(__file__).parent / "mistakes").glob("*.yml"))
    for name, mistakes in yaml.safe_load(path.read_text(encoding="utf-8")).items()
}


def exercises_of(path: Path) -> list[Exercise]:
    """In their order; each solution is followed by its check."""
    found, given = [], []
    cells = nbformat.read(path, as_version=4).cells
    code = [cell for cell in cells if cell.cell_type == "code"]
    for cell, following in zip(code, [*code[1:], None], strict=True):
        if role(cell) == "given":
            given.append(cell.source)
        elif role(cell) == "solution":
            assert following is not None and role(following) == "check", cell.source
            of = following.metadata["nbgrader"]
            name = cell.metadata["nbgrader"]["grade_id"]
            found.append(Exercise(name, given, cell.source, following.source, of["points"]))
            given = []
    return found


def link_rows(path: Path, folder: Path) -> None:
    """What the notebook reads, under the names that it has beside it."""
    for name, rows in teaching.ROWS.get(path.parent.name, {}).items():
        (folder / name).symlink_to(ROOT / "data" / "results" / rows)


def run(source: str, names: dict) -> None:
    exec(compile(source, "cell", "exec"), names)


def complaint(answer: str, exercise: Exercise, names: dict) -> BaseException | None:
    """What running an answer and its check raises; other answers do not see its names."""
    names = dict(names)
    try:
        run(answer, names)
        run(exercise.check, names)
    except Exception as error:
        return error
    return None
