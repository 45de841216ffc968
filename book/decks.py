"""Slides of a lecture for each chapter, from ``slides/`` and the executed chapter: its figures, its
numbers, its questions and its summary. They work offline, and are printed where Chromium is."""

from __future__ import annotations

import re
import shutil
import subprocess
from ast import literal_eval
from base64 import b64decode
from pathlib import Path

from bs4 import BeautifulSoup
from nbformat import NotebookNode
from playwright.sync_api import sync_playwright

from chapters import Notebook
from experiments.orphans import python
from finish.equations import set_equations
from finish.minus import set_minus
from finish.pictures import NARROW
from messages import BuildError, for_terminal
from printing import chromium

SPHINX = "import sys; from sphinx.cmd.build import main; sys.exit(main(sys.argv[1:]))"
CONFIGURATION = """
extensions = ["myst_parser", "sphinx.ext.mathjax", "sphinx_revealjs"]
myst_enable_extensions = ["dollarmath"]
revealjs_static_path = ["slides.css", "equations.css"]
revealjs_css_files = ["slides.css", "equations.css"]
revealjs_style_theme = "white"
revealjs_script_conf = {
    "width": 1280, "height": 720, "hash": True, "slideNumber": True, "transition": "none",
    "pdfSeparateFragments": False,
}
"""
KINDS = {"html": "to show", "pdf": "to print"}
PART = re.compile(r"^\{(figure|question|summary)\}`([\w-]+)`$", re.MULTILINE)
GLUED = re.compile(r"\{glue:text\}`(\w+)(?::([^`]+))?`")
QUESTION = re.compile(
    r":class: check\n\n(?P<asked>.*?)\n\n(?P<answers>::::\{dropdown\}.*)\n:::::", re.DOTALL
)
ANSWER = re.compile(
    r"^::::\{dropdown\} (?P<text>.*)\n:class-container: (?P<kind>right|wrong)\n"
    r"\*\*\w+\.\*\* (?P<why>.*)\n::::$",
    re.MULTILINE,
)


def links(decks: list[str]) -> str:
    """A table of the slides of each chapter."""
    kinds = ["html", "pdf"] if chromium() else ["html"]
    lines = ["| chapter | slides |", "|:--|:--|"]
    for deck in decks:
        addresses = ", ".join(f'<a href="slides/{deck}.{kind}">{KINDS[kind]}</a>' for kind in kinds)
        lines.append(f"| {{doc}}`{deck}` | {addresses} |")
    return "\n".join(lines) + "\n"


def decks_of(source: Path, notebooks: list[Notebook]) -> list[str]:
    """The chapters that have slides."""
    names = [notebook.name for notebook in notebooks]
    return [name for name in names if (source / "slides" / f"{name}.md").exists()]


def build(source: Path, new: Path, html: Path, notebooks: list[Notebook]) -> None:
    """Make ``<html>/slides`` of the decks in ``<source>/slides``, by way of the folder ``new``."""
    decks = decks_of(source, notebooks)
    if not decks:
        return
    new.mkdir(parents=True)
    (new / "conf.py").write_text(CONFIGURATION, encoding="utf-8")
    for style in (source / "slides" / "slides.css", source / "_static" / "equations.css"):
        shutil.copy(style, new)
    contents = ["# Slides", "", "```{toctree}", *decks, "```"]
    (new / "index.md").write_text("\n".join(contents), encoding="utf-8")
    for notebook in notebooks:
        if notebook.name in decks:
            deck = (source / "slides" / f"{notebook.name}.md").read_text(encoding="utf-8")
            filled = Filler(notebook.read_executed(), new).fill(deck)
            (new / f"{notebook.name}.md").write_text(filled, encoding="utf-8")
    run_sphinx(new, html / "slides")
    finish_slides(html / "slides")
    print_all(html / "slides", decks)


class Filler:
    """Puts parts of an executed chapter into its deck; figures go to files in ``folder``."""

    def __init__(self, chapter: NotebookNode, folder: Path):
        self.chapter, self.folder = chapter, folder
        outputs = [output for cell in chapter.cells for output in cell.get("outputs", [])]
        self.glued = {
            output.metadata.scrapbook.name: output.data
            for output in outputs
            if "scrapbook" in output.get("metadata", {})
        }

    def fill(self, deck: str) -> str:
        parts = {"figure": self.figure, "question": self.question, "summary": self.summary}
        deck = PART.sub(lambda part: parts[part[1]](part[2]), deck)
        return GLUED.sub(lambda glued: self.number(glued[1], glued[2] or "s"), deck)

    def number(self, key: str, form: str) -> str:
        if key not in self.glued:
            raise BuildError(f"Slides: no number is called {key!r} in the chapter")
        plain = next(text for kind, text in self.glued[key].items() if kind.endswith("text/plain"))
        return formatted(plain, form)

    def figure(self, name: str) -> str:
        """An image with its description."""
        for cell in self.chapter.cells:
            shown = cell.metadata.get("mystnb", {})
            if shown.get("figure", {}).get("name") == name:
                file = write_image(cell.outputs, self.folder / name)
                return f"![{shown.get('image', {}).get('alt', '')}]({file.name})"
        raise BuildError(f"Slides: no figure is called {name!r} in the chapter")

    def question(self, name: str) -> str:
        """Two slides: the question with its answers, and which is right."""
        found = QUESTION.search(self.cell(f"check-{name}"))
        answers = list(ANSWER.finditer(found["answers"]))
        right = next(answer for answer in answers if answer["kind"] == "right")
        choices = "\n".join(f"{number}. {a['text']}" for number, a in enumerate(answers, 1))
        return (
            f"### Check yourself\n\n{found['asked']}\n\n{choices}\n\n"
            f"### Answer {answers.index(right) + 1}\n\n**{right['text']}**\n\n{right['why']}"
        )

    def summary(self, name: str) -> str:
        """The chapter's five sentences."""
        return "\n".join(re.findall(r"^\d\. .*$", self.cell("summary"), re.MULTILINE))

    def cell(self, name: str) -> str:
        return next(cell.source for cell in self.chapter.cells if cell.id == name)


def formatted(plain: str, form: str) -> str:
    """A glued value as the page of the chapter shows it."""
    try:
        value = literal_eval(plain)
    except ValueError:  # nan, inf
        value = plain
    kind = {"d": int, "s": str}.get(form[-1], float)
    return format(kind(value), form)


def write_image(outputs: list[NotebookNode], path: Path) -> Path:
    """The first picture among a cell's outputs as a file, named by its kind."""
    for data in (output.get("data", {}) for output in outputs):
        if "image/svg+xml" in data:
            path = path.with_suffix(".svg")
            path.write_text(NARROW.sub("", data["image/svg+xml"]), encoding="utf-8")
            return path
        if "image/png" in data:
            path = path.with_suffix(".png")
            path.write_bytes(b64decode(data["image/png"]))
            return path
    raise BuildError(f"Slides: the cell of the figure {path.name!r} has no picture")


def run_sphinx(source: Path, target: Path) -> None:
    arguments = ("-b", "revealjs", "-W", "--keep-going", "-q", str(source), str(target))
    done = subprocess.run(
        python(SPHINX, *arguments),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    if done.returncode:
        raise BuildError("The slides could not be built.\n" + for_terminal(done.stdout))
    for name in (".doctrees", ".buildinfo", "_sources", "objects.inv"):
        path = target / name
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def finish_slides(folder: Path) -> None:
    """Equations and minus signs as on the pages of the book."""
    paths = {path.name: path for path in folder.glob("*.html")}
    pages = {
        name: BeautifulSoup(path.read_text(encoding="utf-8"), "html.parser")
        for name, path in paths.items()
    }
    set_equations(pages)
    for name, page in pages.items():
        set_minus(page)
        paths[name].write_text(str(page), encoding="utf-8")


def print_all(folder: Path, decks: list[str]) -> None:
    """A PDF of each deck, one page for each slide; without Chromium there is none."""
    if not chromium():
        return
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=chromium(), args=["--no-sandbox", "--disable-dev-shm-usage"]
        )
        page = browser.new_page()
        for deck in decks:
            page.goto(f"{(folder / deck).resolve().as_uri()}.html?print-pdf", wait_until="load")
            page.wait_for_selector(".pdf-page")
            page.pdf(path=folder / f"{deck}.pdf", prefer_css_page_size=True, print_background=True)
        browser.close()
