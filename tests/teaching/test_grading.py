"""nbgrader itself, as lecturers use it: references get all points, blanks and mistakes none."""

import os
import shutil
import sys
from pathlib import Path

import nbformat
import pytest
from graded import exercises_of, role
from nbgrader.apps import NbGraderAPI
from traitlets.config.loader import PyFileConfigLoader

import teaching

STUDENTS = ("reference", "blank", "mistaken")


@pytest.fixture(scope="module")
def course(tmp_path_factory) -> Path:
    """The instructor's package, unpacked."""
    folder = tmp_path_factory.mktemp("teaching")
    archive = teaching.write_archive(folder, teaching.write_instructor)
    shutil.unpack_archive(archive, folder)
    return folder / archive.stem


@pytest.fixture
def grader(course, monkeypatch) -> NbGraderAPI:
    programs = str(Path(sys.executable).parent)  # nbgrader calls alembic
    monkeypatch.setenv("PATH", f"{programs}{os.pathsep}{os.environ['PATH']}")
    config = PyFileConfigLoader("nbgrader_config.py", str(course)).load_config()
    config.CourseDirectory.root = str(course)
    return NbGraderAPI(config=config)


def hand_in(course: Path, assignment: str) -> None:
    """What three students make of it."""
    for student in STUDENTS:
        version = "release" if student == "blank" else "source"
        folder = course / "submitted" / student / assignment
        shutil.copytree(course / version / assignment, folder)
        if student == "mistaken":
            for path in folder.glob("*.ipynb"):
                make_mistakes(path)


def make_mistakes(path: Path) -> None:
    """The first typical mistake of each exercise in place of its solution."""
    exercises = {exercise.name: exercise for exercise in exercises_of(path)}
    notebook = nbformat.read(path, as_version=4)
    for cell in notebook.cells:
        if role(cell) == "solution":
            exercise = exercises[cell.metadata["nbgrader"]["grade_id"]]
            cell.source = exercise.with_mistake(exercise.mistakes[0])
        elif role(cell) == "essay":
            cell.source = "YOUR ANSWER HERE"
    nbformat.write(notebook, path)


@pytest.mark.slow
@pytest.mark.parametrize("assignment", teaching.ASSIGNMENTS)
def test_scores(assignment, course, grader):
    assert grader.generate_assignment(assignment)["success"]
    hand_in(course, assignment)
    for student in STUDENTS:
        assert grader.autograde(assignment, student)["success"]
    with grader.gradebook as gradebook:
        for path in sorted((course / "source" / assignment).glob("*.ipynb")):
            for student in STUDENTS:
                found = gradebook.find_submission_notebook(path.stem, assignment, student)
                for grade in found.grades:
                    about = f"{path.stem}, {student}, {grade.name}"
                    if student != "reference":
                        assert grade.auto_score == 0, about
                    elif grade.cell_type == "markdown":
                        assert grade.needs_manual_grade, about
                    else:
                        assert grade.auto_score == grade.max_score, about
