"""nbgrader itself, as a lecturer uses it: the reference gets all points, a blank none."""

import os
import shutil
import sys
from pathlib import Path

import pytest
from nbgrader.apps import NbGraderAPI
from traitlets.config import Config

import teaching

STUDENTS = ("reference", "blank")


@pytest.fixture(scope="module")
def course(tmp_path_factory) -> Path:
    """The instructor's package, unpacked, with what two students hand in."""
    folder = tmp_path_factory.mktemp("teaching")
    archive = teaching.write_archive(folder, teaching.write_instructor)
    shutil.unpack_archive(archive, folder)
    return folder / archive.stem


@pytest.fixture(scope="module")
def grader(course) -> NbGraderAPI:
    config = Config()
    config.CourseDirectory.root = str(course)
    return NbGraderAPI(config=config)


@pytest.mark.slow
@pytest.mark.parametrize("assignment", teaching.ASSIGNMENTS)
def test_scores(assignment, course, grader, monkeypatch):
    programs = str(Path(sys.executable).parent)  # nbgrader calls alembic
    monkeypatch.setenv("PATH", f"{programs}{os.pathsep}{os.environ['PATH']}")
    done = grader.generate_assignment(assignment)
    assert done["success"], done
    for student, version in zip(STUDENTS, ("source", "release"), strict=True):
        shutil.copytree(course / version / assignment, course / "submitted" / student / assignment)
        done = grader.autograde(assignment, student)
        assert done["success"], done
    with grader.gradebook as gradebook:
        for path in sorted((course / "source" / assignment).glob("*.ipynb")):
            scores = {
                student: gradebook.find_submission_notebook(path.stem, assignment, student)
                for student in STUDENTS
            }
            for student, found in scores.items():
                for grade in found.grades:
                    by_hand = grade.cell.cell_type == "markdown"
                    wanted = grade.max_score if student == "reference" else 0
                    if by_hand and student == "reference":
                        assert grade.needs_manual_grade, grade
                    else:
                        assert grade.auto_score == wanted, (path.stem, student, grade)
