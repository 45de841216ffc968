"""Exercises, lab and homework as packages for students and for lecturers. `make teaching`.

Their one source, ``notebooks/exercises/ASSIGNMENT/*.ipynb``, is written for nbgrader, which makes
the students' version of it and grades what comes back.
"""

from __future__ import annotations

import io
import shutil
import sys
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path

from chapters import tree_hash
from experiments.files import replace_bytes, replace_text
from messages import BuildError, shown

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ROOT / "notebooks" / "exercises"
ASSIGNMENTS = ("exercises", "lab", "homework")
# The rows that notebooks read, beside them: name there -> file in data/results.
ROWS = {
    "exercises": {"keys.csv": "keys/main.csv", "doors.csv": "door/strategies.csv"},
    "homework": {"keys.csv": "keys/main.csv"},
}
WITHOUT_SOLUTIONS = (
    "notebooks/exercises is missing, of which packages are made: the archive that the site offers "
    "has no solutions. The package for students is in its book/_downloads; the one for instructors "
    "needs a clone of the repository"
)
OLDEST = (1980, 1, 1, 0, 0, 0)  # date of every file in an archive: the same files, the same bytes


def main() -> int:
    if not SOURCES.exists():
        print(WITHOUT_SOLUTIONS, file=sys.stderr)
        return 1
    target = ROOT / "book" / "_build" / "teaching"
    target.mkdir(parents=True, exist_ok=True)
    try:
        for write in (write_student, write_instructor):
            print(f"The package is {shown(write_archive(target, write))}")
    except BuildError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


def write_download(source: Path, build: Path) -> None:
    """The students' package for the site in ``source``; kept in ``build`` while it is current.

    A copy of the book's source that has no solutions comes with the package.
    """
    if not SOURCES.exists():
        return
    target = build / "teaching"
    target.mkdir(exist_ok=True)
    archive, made_of = target / f"{NAMES[write_student]}.zip", target / "made_of"
    with tempfile.TemporaryDirectory() as scratch:
        write_instructor(Path(scratch))
        shutil.copy(SOURCES / "students.md", scratch)
        digest = tree_hash(Path(scratch))
    if not (archive.exists() and made_of.exists() and made_of.read_text() == digest):
        write_archive(target, write_student)
        replace_text(made_of, digest)
    (source / "_downloads").mkdir()
    shutil.copy(archive, source / "_downloads")


def write_archive(target: Path, write: Callable[[Path], None]) -> Path:
    """What ``write(folder)`` makes, as a zip in ``target``, named after what is in it."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / NAMES[write]
        folder.mkdir()
        write(folder)
        path = target / f"{folder.name}.zip"
        replace_bytes(path, zipped(folder))
    return path


def write_student(folder: Path) -> None:
    """Assignments without solutions, the package that they import, and how to begin."""
    with tempfile.TemporaryDirectory() as scratch:
        write_course(Path(scratch))
        shutil.copytree(release(Path(scratch)), folder, dirs_exist_ok=True)
    add_package(folder)
    shutil.copy(SOURCES / "students.md", folder / "README.md")


def write_instructor(folder: Path) -> None:
    """nbgrader's course directory with the sources, the same package, and how to grade."""
    write_course(folder)
    add_package(folder)
    shutil.copy(SOURCES / "instructors.md", folder / "README.md")


NAMES = {write_student: "ipo-exercises", write_instructor: "ipo-exercises-instructor"}


def write_course(folder: Path) -> None:
    """``source/ASSIGNMENT`` with all that its notebooks read, and nbgrader's settings."""
    for assignment in ASSIGNMENTS:
        source = folder / "source" / assignment
        source.mkdir(parents=True)
        for notebook in sorted((SOURCES / assignment).glob("*.ipynb")):
            shutil.copy(notebook, source)
        for name, rows in ROWS.get(assignment, {}).items():
            shutil.copy(ROOT / "data" / "results" / rows, source / name)
    shutil.copy(SOURCES / "nbgrader_config.py", folder)


def release(course: Path) -> Path:
    """Make the students' version of every assignment; returns the folder that holds them.

    Raises:
        BuildError: what nbgrader says of a source.
    """
    from nbgrader.converters import GenerateAssignment  # takes seconds; most builds need none
    from nbgrader.converters.base import NbGraderException
    from nbgrader.coursedir import CourseDirectory
    from traitlets.config import Config

    config = Config()
    config.CourseDirectory.root = str(course)
    config.GenerateAssignment.no_database = True
    for assignment in ASSIGNMENTS:
        directory = CourseDirectory(config=config, assignment_id=assignment)
        converter = GenerateAssignment(coursedir=directory, config=config)
        # Without the one step that writes to a gradebook: a lecturer's nbgrader makes one.
        converter.preprocessors = [p for p in converter.preprocessors if p.__name__ != "SaveCells"]
        try:
            converter.start()
        except NbGraderException as error:
            raise BuildError(f"{assignment}: no students' version: {error}") from error
    return course / "release"


def add_package(folder: Path) -> None:
    """The algorithms: `pip install .` in the folder is all that the notebooks need of the book."""
    shutil.copytree(ROOT / "ipo", folder / "ipo", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "LICENSE"):
        shutil.copy(ROOT / name, folder)


def zipped(folder: Path) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as file:
        for path in sorted(path for path in folder.rglob("*") if path.is_file()):
            info = zipfile.ZipInfo(path.relative_to(folder.parent).as_posix(), OLDEST)
            info.compress_type, info.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            file.writestr(info, path.read_bytes())
    return content.getvalue()


if __name__ == "__main__":
    sys.exit(main())
