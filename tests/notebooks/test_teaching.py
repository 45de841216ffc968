"""What a learner and a lecturer find in every chapter, and in the slides made of it."""

import importlib
import re
from dataclasses import fields, is_dataclass
from pathlib import Path

import nbformat
import pytest

import decks
import reading_time
from messages import BuildError

ROOT = Path(__file__).resolve().parents[2]
CHAPTERS = sorted((ROOT / "notebooks").glob("*.ipynb"))
# Headings with nothing behind them to ask about: what ends a chapter, and what only repeats rows.
UNASKED = {
    *("In five sentences", "What would change our mind", "Further reading"),
    *("Run time and provenance", "Exercises"),
    *("The same, live", "The same runs, live", "Every configuration, by hand"),
}


@pytest.fixture(params=CHAPTERS, ids=lambda path: path.stem)
def chapter(request):
    return nbformat.read(request.param, as_version=4)


def cells(chapter, start: str) -> list[str]:
    return [cell.source for cell in chapter.cells if cell.id.startswith(start)]


# ------------------------------------------------------------------------------ chapters


def test_says_what_it_teaches_needs_and_takes(chapter):
    [frame] = cells(chapter, "frame")
    for words in ("**Afterwards you can**\n\n- ", "**You need** ", "{include} _generated/times/"):
        assert words in frame


def test_ends_with_five_sentences_and_doubts(chapter):
    [summary] = cells(chapter, "summary")
    sentences = re.findall(r"^\d\. (.*)$", summary, re.MULTILINE)
    assert len(sentences) == 5
    # One sentence each: full stops within would be followed by a capital.
    assert [text for text in sentences if re.search(r"[.!?] [A-Z]", text) or text[-1] != "."] == []
    assert "### What would change our mind\n\n- " in summary
    assert "### Further reading\n\n- " in summary


def test_questions_have_one_right_answer_and_a_reason_for_each(chapter):
    questions = cells(chapter, "check-")
    assert len(questions) >= 2
    for question in questions:
        found = decks.QUESTION.search(question)
        answers = list(decks.ANSWER.finditer(found["answers"]))
        assert len(answers) == question.count("{dropdown}") >= 3
        assert [answer["kind"] for answer in answers].count("right") == 1
        assert all(answer["why"] for answer in answers)


def test_every_section_ends_with_a_question(chapter):
    assert set(unasked(chapter)) <= UNASKED


def test_parts_after_the_last_question_of_a_section_are_unasked():
    texts = ["# Title", "## A\n\n### B", "?", "### C", "## D\n\n### E", "## F", "?"]
    cells = [
        nbformat.v4.new_markdown_cell(text, id=f"check-{place}" if text == "?" else str(place))
        for place, text in enumerate(texts)
    ]
    assert unasked(nbformat.v4.new_notebook(cells=cells)) == ["C", "D", "E"]


def unasked(chapter) -> list[str]:
    """Headings of sections, and of parts, that no question follows in the same section."""
    found, waiting = [], []
    for cell in chapter.cells:
        if cell.id.startswith("check-"):
            waiting = []
        elif cell.cell_type == "markdown":
            for level, heading in re.findall(r"^(##+) (.*)$", cell.source, re.MULTILINE):
                if level == "##":
                    found += waiting
                    waiting = []
                waiting.append(heading)
    return found + waiting


def test_right_answers_have_no_favourite_place():
    places = set()
    for path in CHAPTERS:
        for question in cells(nbformat.read(path, as_version=4), "check-"):
            places.add([a["kind"] for a in decks.ANSWER.finditer(question)].index("right"))
    assert places == {0, 1, 2}


# ------------------------------------------------------------------------------ pages


def test_names_of_code_in_the_prose_exist():
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "book").glob("*.md")]
    prose = "\n".join(page.read_text(encoding="utf-8") for page in pages)
    for path in (ROOT / "notebooks").glob("*.ipynb"):
        prose += "\n".join(cells(nbformat.read(path, as_version=4), ""))
    names = set(re.findall(r"`((?:ipo|experiments)(?:\.\w+)+)`", prose))
    assert len(names) > 30
    assert [name for name in sorted(names) if not exists(name)] == []


def exists(name: str) -> bool:
    """Whether a dotted name is a module, something in one, or a field of a dataclass there."""
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:length]))
        except ModuleNotFoundError:
            continue
        for part in parts[length:]:
            declared = {field.name for field in fields(found)} if is_dataclass(found) else set()
            if not (hasattr(found, part) or part in declared):
                return False
            found = getattr(found, part, None)
        return True
    return False


def test_the_data_of_the_projects_ship_with_the_book():
    page = (ROOT / "book" / "teaching.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`(data/[\w/.]+)`", page))
    assert len(named) >= 6
    assert [path for path in named if not (ROOT / path).exists()] == []


def test_time_to_read_counts_prose_and_not_code():
    unread = "$$\nx = 1\n$$\n\n```{exercise}\nNot these.\n```"
    source = f"# Two words\n\n{unread}\n\nThree {{glue:text}}`x` $y$."
    chapter = nbformat.v4.new_notebook(cells=[nbformat.v4.new_markdown_cell(source)])
    chapter.cells.append(nbformat.v4.new_code_cell("nor = this"))
    assert reading_time.count_words(chapter) == 5
    assert reading_time.minutes(reading_time.WORDS_PER_MINUTE * 3) == 3
    assert reading_time.minutes(5) == 1


# ------------------------------------------------------------------------------ slides


@pytest.fixture
def filler(tmp_path):
    glued = nbformat.v4.new_output(
        "display_data", {"application/papermill.record/text/plain": "0.5"}
    )
    glued.metadata = {"scrapbook": {"name": "share"}}
    drawn = nbformat.v4.new_output("display_data", {"image/png": "AAAA"})
    code = nbformat.v4.new_code_cell("draw()", outputs=[glued, drawn])
    code.metadata = {"mystnb": {"figure": {"name": "fig-a"}, "image": {"alt": "A line"}}}
    asked = (
        ":::::{admonition} Check yourself\n:class: check\n\nWhy?\n\n"
        "::::{dropdown} So\n:class-container: wrong\n**No.** Not so.\n::::\n\n"
        "::::{dropdown} Thus\n:class-container: right\n**Right.** It is.\n::::\n:::::"
    )
    summary = "## In five sentences\n\n1. One {glue:text}`share:.0%`.\n\n### Further reading"
    markdown = [
        nbformat.v4.new_markdown_cell(text, id=name)
        for name, text in (("check-why", asked), ("summary", summary))
    ]
    chapter = nbformat.v4.new_notebook(cells=[code, *markdown])
    return decks.Filler(nbformat.from_dict(chapter), tmp_path)


def test_slides_get_numbers_figures_questions_and_summaries(filler, tmp_path):
    assert filler.fill("{glue:text}`share:.2f`") == "0.50"
    assert filler.fill("{figure}`fig-a`") == "![A line](fig-a.png)"
    assert (tmp_path / "fig-a.png").exists()
    assert filler.fill("{summary}`all`") == "1. One 50%."
    slides = filler.fill("{question}`why`")
    assert slides.index("Why?\n\n1. So\n2. Thus") < slides.index(
        "### Answer 2\n\n**Thus**\n\nIt is."
    )
    assert "Not so." not in slides


@pytest.mark.parametrize("part", ["{glue:text}`unknown:.2f`", "{figure}`unknown`"])
def test_slides_with_a_part_that_is_not_there_end_the_build(filler, part):
    with pytest.raises(BuildError, match="unknown"):
        filler.fill(part)


@pytest.mark.parametrize(
    ("plain", "form", "shown"),
    [("0.5", ".0%", "50%"), ("'[1, 2]'", "s", "[1, 2]"), ("7.0", "d", "7"), ("nan", ".1f", "nan")],
)
def test_slides_show_numbers_as_the_chapter_does(plain, form, shown):
    assert decks.formatted(plain, form) == shown


def test_every_chapter_has_slides():
    assert {path.stem for path in (ROOT / "book" / "slides").glob("*.md")} == {
        path.stem for path in CHAPTERS
    }
