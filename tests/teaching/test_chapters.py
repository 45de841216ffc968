"""The exercises on the pages: how many, of which kinds, in which order, and which are solved."""

import re
from pathlib import Path

import nbformat
import pytest
from graded import SOURCES, exercises_of

ROOT = Path(__file__).resolve().parents[2]
KINDS = {"derive", "predict", "implement", "experiment", "criticise"}
WITH_CODE = {"implement", "experiment"}
LEVELS = ("easy", "medium", "hard")
HEAD = re.compile(
    r"```\{exercise\} (?P<title>.+): (?P<kind>\w+), (?P<level>\w+), (?P<minutes>\d+) minutes.*\n"
    r":label: (?P<label>\S+)\n"
)
SOLVED = re.compile(r"```\{solution\} (\S+)\n:label: \S+\n:class: dropdown\n")
CHAPTERS = [path for path in SOURCES if path.parent.name == "exercises"]


def text_of(chapter: str) -> str:
    cells = nbformat.read(ROOT / "notebooks" / f"{chapter}.ipynb", as_version=4).cells
    return "\n".join(cell.source for cell in cells if cell.cell_type == "markdown")


@pytest.fixture(params=[path.stem for path in CHAPTERS])
def chapter(request):
    return request.param


def test_every_chapter_has_exercises_of_all_kinds_from_easy_to_hard(chapter):
    text = text_of(chapter)
    found = list(HEAD.finditer(text))
    assert len(found) == text.count("```{exercise}") >= 5
    assert {match["kind"] for match in found} == KINDS
    levels = [LEVELS.index(match["level"]) for match in found]
    assert levels == sorted(levels)


def test_what_needs_no_code_has_a_folded_solution(chapter):
    text = text_of(chapter)
    written = [match["label"] for match in HEAD.finditer(text) if match["kind"] not in WITH_CODE]
    assert SOLVED.findall(text) == written


def test_what_needs_code_has_a_check_in_the_package(chapter):
    on_the_page = [match for match in HEAD.finditer(text_of(chapter)) if match["kind"] in WITH_CODE]
    (path,) = [path for path in CHAPTERS if path.stem == chapter]
    assert len(exercises_of(path)) == len(on_the_page)
    titles = [match["title"] for match in on_the_page]
    notebook = nbformat.read(path, as_version=4)
    headings = [
        line.removeprefix("## ")
        for cell in notebook.cells
        for line in cell.source.splitlines()
        if cell.cell_type == "markdown" and line.startswith("## ")
    ]
    assert headings == titles
