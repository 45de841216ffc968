"""The exercises with code: their cells, and what becomes of an answer, without a kernel."""

from __future__ import annotations

import html
import json
import re
import zipfile
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
SHORTEST = 20  # characters of a line that gives something away
READABLE = {".html", ".ipynb", ".js", ".json", ".md", ".py", ".txt"}
TAGS = re.compile(r"<[^>]*>")


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


def secrets() -> set[str]:
    """Lines of reference solutions and answers that stand nowhere where a student may look."""
    hidden, shown = [], []
    for path in SOURCES:
        for cell in nbformat.read(path, as_version=4).cells:
            if role(cell) == "essay":
                hidden.append(cell.source)
                continue
            _, *parts = f"### END SOLUTION{cell.source}".split("### END SOLUTION")
            for part in parts:
                open_part, _, solution = part.partition("### BEGIN SOLUTION")
                shown.append(open_part)
                hidden.append(solution)
    shown += [path.read_text(encoding="utf-8") for path in (ROOT / "ipo").rglob("*.py")]
    known = "\n".join(shown)
    lines = {line.strip() for text in hidden for line in text.splitlines()}
    return {line for line in lines if len(line) >= SHORTEST and line not in known}


def leaks(folder: Path) -> list[tuple[str, str]]:
    """Files of a folder, and in archives of it, that have one of the secrets."""
    lines = secrets()
    contents = {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.suffix in READABLE
    }
    for path in folder.rglob("*.zip"):
        with zipfile.ZipFile(path) as archive:
            contents |= {
                f"{path.name}/{name}": archive.read(name)
                for name in archive.namelist()
                if Path(name).suffix in READABLE
            }
    return [
        (name, line)
        for name, content in contents.items()
        for line in find(lines, content.decode(errors="replace"))
    ]


def find(lines: set[str], text: str) -> list[str]:
    """Which of the lines are in a text, as it is, in JSON or in HTML."""
    plain = html.unescape(TAGS.sub("", text))
    in_json = {line: json.dumps(line, ensure_ascii=False)[1:-1] for line in lines}
    return [line for line in lines if line in plain or in_json[line] in text]
