"""The archives: whole, the same for the same sources, and without a solution for students."""

import shutil
import zipfile

import nbformat
import pytest
from graded import SOURCES, find, leaks, secrets

import teaching


@pytest.fixture(scope="module")
def student(tmp_path_factory):
    folder = tmp_path_factory.mktemp("student")
    teaching.write_archive(folder, teaching.write_student)
    return folder


def names_in(folder):
    (archive,) = folder.glob("*.zip")
    with zipfile.ZipFile(archive) as file:
        return {name.partition("/")[2] for name in file.namelist()}


def test_students_find_no_solution(student):
    assert len(secrets()) > 50
    assert leaks(student) == []


def test_a_solution_would_be_found(student, tmp_path):
    """In a notebook, in an archive and on a page."""
    shutil.copy(SOURCES[0], tmp_path)
    assert leaks(tmp_path) != []
    page = "<pre><span>others</span> <span>=</span> sum(players) - players[d]</pre>"
    assert find({"others = sum(players) - players[d]"}, page)


def test_students_get_all_that_notebooks_need(student):
    names = names_in(student)
    assert {"README.md", "pyproject.toml", "ipo/lqr.py"} <= names
    for path in SOURCES:
        assignment = path.parent.name
        assert f"{assignment}/{path.name}" in names
        assert {f"{assignment}/{rows}" for rows in teaching.ROWS.get(assignment, {})} <= names


def test_checks_and_questions_reach_the_student(student, tmp_path):
    (archive,) = student.glob("*.zip")
    shutil.unpack_archive(archive, tmp_path)
    released = tmp_path / archive.stem
    for path in SOURCES:
        own, given = (
            nbformat.read(p, as_version=4).cells
            for p in (path, released / path.parent.name / path.name)
        )
        locked = [cell.source for cell in own if cell.metadata.get("nbgrader", {}).get("locked")]
        assert locked and set(locked) <= {cell.source for cell in given}
        assert len(own) == len(given)


def test_instructors_get_sources_and_settings(tmp_path):
    teaching.write_archive(tmp_path, teaching.write_instructor)
    names = names_in(tmp_path)
    assert {"README.md", "nbgrader_config.py"} <= names
    assert {f"source/{path.parent.name}/{path.name}" for path in SOURCES} <= names


def test_the_download_is_made_once(tmp_path, monkeypatch):
    """And again where anything that it is made of has changed; the same files, the same bytes."""
    made = []

    def write(folder):
        made.append(folder)
        (folder / "notebook.ipynb").write_text("{}")

    monkeypatch.setattr(teaching, "write_student", write)
    monkeypatch.setitem(teaching.NAMES, write, "ipo-exercises")
    sites = [tmp_path / name for name in ("first", "second", "third")]
    for number, site in enumerate(sites):
        site.mkdir()
        if number == 2:
            (tmp_path / "teaching" / "made_of").write_text("something else")
        teaching.write_download(site, tmp_path)
    assert len(made) == 2
    assert len({(site / "_downloads" / "ipo-exercises.zip").read_bytes() for site in sites}) == 1


def test_a_copy_without_solutions_brings_the_package_and_says_so(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(teaching, "SOURCES", tmp_path / "left out")
    assert teaching.main() == 1
    assert "notebooks/exercises is missing" in capsys.readouterr().err
    teaching.write_download(tmp_path / "site", tmp_path)
    assert not list(tmp_path.iterdir())
