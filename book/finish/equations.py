"""Equations are set when the book is built: pages need no script for them."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path

from bs4 import BeautifulSoup, NavigableString, Tag
from playwright._impl._driver import compute_driver_executable

from messages import BuildError

SCRIPT = Path(__file__).with_name("equations.js")
TEX = re.compile(r"\\\((.*?)\\\)|\\\[(.*?)\\\]", re.DOTALL)
PUNCTUATION = re.compile(r"[.,;:!?)\]]+")


def set_equations(pages: dict[str, BeautifulSoup]) -> None:
    """Put SVG, with MathML for screen readers, in the place of all TeX, and take MathJax away.

    Raises:
        BuildError: TeX with a mistake.
    """
    found = {name: [math for element in page.select(".math") for math in tex_in(element)]
             for name, page in pages.items()}  # fmt: skip
    answers = mathjax({
        name: [[tex, display] for _, tex, display in equations]
        for name, equations in found.items() if equations
    })  # fmt: skip
    for name, answer in answers.items():
        for (text, _, _), html in zip(found[name], answer["equations"], strict=True):
            element = text.parent
            text.replace_with(parsed(html))
            keep_punctuation(element)
        body = pages[name].body
        assert body is not None
        body.append(parsed(f'<svg style="display: none">{answer["glyphs"]}</svg>'))
    for page in pages.values():
        for script in page.find_all("script"):
            if "MathJax" in script.get_text() or "mathjax" in str(script.get("src", "")).lower():
                script.decompose()


def keep_punctuation(math: Tag) -> None:
    """No line begins with the punctuation that follows an equation."""
    following = math.next_sibling
    if isinstance(following, NavigableString) and (marks := PUNCTUATION.match(following)):
        math.wrap(parsed('<span class="together"></span>')).append(marks[0])
        following.replace_with(following[marks.end() :])


def tex_in(element: Tag) -> list[tuple[NavigableString, str, bool]]:
    """The text that is TeX, without its delimiters, and whether it is displayed."""
    found = []
    for text in element.find_all(string=True, recursive=False):
        if match := TEX.search(text):
            inline, displayed = match.groups()
            found.append((text, displayed if inline is None else inline, inline is None))
    return found


def mathjax(equations: dict[str, list]) -> dict[str, dict]:
    """Ask ``equations.js``, by the Node.js that Playwright brings along."""
    node = str(compute_driver_executable()[0])
    done = subprocess.run(
        [node, str(SCRIPT)], input=json.dumps(equations), capture_output=True, text=True
    )
    if done.returncode:
        raise BuildError(f"An equation could not be set: {done.stderr.strip()}")
    return json.loads(done.stdout)


def parsed(html: str) -> Tag:
    """The one element that a piece of HTML has."""
    [element] = BeautifulSoup(html, "html.parser").children
    assert isinstance(element, Tag)
    return element
