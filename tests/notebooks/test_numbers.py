"""No result is typed by hand: a number in the prose is glued from rows, or declared a definition.

``definitions.yml`` has the numerals that no run can change, as they stand in the text: settings,
labels of domains and runs, what the paper's text says. Results are glued. A page has the words of
the table in ``data/`` that it is made from, too.
"""

import re
from collections.abc import Iterator
from pathlib import Path

import nbformat
import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
PAGES = [*sorted((ROOT / "notebooks").glob("*.ipynb")), *sorted((ROOT / "book").glob("*.md"))]
TABLES = {"claims": "claims.yml", "fairness": "fairness.yml", "settings": "deviations.yml"}
WORDS = {  # what tables say in words; all else is cells and settings, or names them
    *("title", "claim", "test", "where", "measure", "label", "aspect", "unequal"),
    *("what", "text", "programs", "here", "effect"),
}
DEFINITIONS = yaml.safe_load((Path(__file__).parent / "definitions.yml").read_text("utf-8"))

NO_PROSE = re.compile(
    r"""
    # Code, and what is included; the lines of other directives, but for the answers to questions.
    ^(?P<fence>`{3,})(?=\S)(?!\{(?:exercise|solution|prf:)).*?^(?P=fence)\s*$
    | ^(?:`{3,}|:{3,}(?!:*\{dropdown\}))[^\n]*$ | ^:[\w-]+:[^\n]*$
    # Glue and citations, which are roles; code in the line; formulas of their own lines.
    | \{[\w:+-]+\}`[^`]*` | `[^`]*` | \$\$.*?\$\$
    # Labels, and the targets of links.
    | ^\(\S+\)=$ | \]\([^)]*\)
    # The numbers of headings, of lists and of the steps of a proof.
    | ^\s*(?:\#+\ )?\*?\d+\.\*?\s
    # References to parts of the paper and of the page, names of runs.
    | (?:Sections?|Parts?|Tables?|Figures?|Figs?\.|Algorithm|Equations?|Definitions?
        |[Ll]ines?|[Rr]uns?)\s
      \d[\d.]*[a-z]?\b(?:(?:,|\ and|\ to)\s\d+[a-z]?\b)*
    """,
    re.VERBOSE | re.DOTALL | re.MULTILINE,
)
MATHS = re.compile(r"\$([^$]+)\$")
NUMERAL = re.compile(r"(?<![\w.])[-+−]?\d[\d.,/]*(?<![.,])")
SENTENCE = re.compile(r"(?<=[.:;!?])\s|\n\s*\n|\n(?=[-|*])")


def texts_of(page: Path) -> dict[str, str]:
    """Prose by place: cells of markdown, and captions and descriptions of figures."""
    if page.suffix == ".md":
        found = {"page": page.read_text("utf-8")}
        if page.stem in TABLES:
            table = yaml.safe_load((ROOT / "data" / TABLES[page.stem]).read_text("utf-8"))
            found[TABLES[page.stem]] = "\n\n".join(words_of(table))
        return found
    found = {}
    for number, cell in enumerate(nbformat.read(page, as_version=4).cells):
        shown = cell.metadata.get("mystnb", {})
        if cell.cell_type == "markdown":
            found[f"cell {number}"] = cell.source
        else:
            found[f"caption of cell {number}"] = shown.get("figure", {}).get("caption", "")
            found[f"description of cell {number}"] = shown.get("image", {}).get("alt", "")
    return found


def words_of(value: object) -> Iterator[str]:
    """Words of a table without what is filled in: {…}. Names of variants are settings."""
    if isinstance(value, list):
        for part in value:
            yield from words_of(part)
    elif isinstance(value, dict):
        for key, part in value.items():
            if key in WORDS and isinstance(part, str):
                yield re.sub(r"\{[^}]*\}", " ", part)
            else:
                yield from words_of(part)


def prose(markdown: str) -> str:
    """What is left without code, roles and references; of maths, numbers that stand alone."""
    text = NO_PROSE.sub(" ", markdown)
    return MATHS.sub(lambda maths: maths[1] if NUMERAL.fullmatch(maths[1].strip()) else " ", text)


def definitions_of(page: Path) -> list[str]:
    chosen = [DEFINITIONS["everywhere"], DEFINITIONS.get(page.stem) or {}]
    return [snippet for reasons in chosen for snippets in reasons.values() for snippet in snippets]


def without(text: str, snippets: list[str]) -> str:
    """The text without the snippets, longest first; none is cut out of a longer number."""
    for snippet in sorted(snippets, key=len, reverse=True):
        words = r"\s+".join(map(re.escape, snippet.split()))
        text = re.sub(rf"(?<![\w.]){words}(?![\d]|[.,]\d)", " ", text)
    return text


def undeclared(markdown: str, snippets: list[str]) -> list[str]:
    """Sentences with a numeral that is neither glued nor in a snippet."""
    sentences = SENTENCE.split(without(prose(markdown), snippets))
    return [" ".join(s.split()) for s in sentences if NUMERAL.search(s)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_numbers_are_glued_or_definitions(page):
    declared = definitions_of(page)
    found = {place: undeclared(text, declared) for place, text in texts_of(page).items()}
    assert {place: sentences for place, sentences in found.items() if sentences} == {}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_definition_is_in_its_page(page):
    """And needed: without it there is a number more that nobody has declared."""
    declared, texts = definitions_of(page), list(map(prose, texts_of(page).values()))
    own = [s for snippets in (DEFINITIONS.get(page.stem) or {}).values() for s in snippets]
    rest = {s: [other for other in declared if other != s] for s in own}
    assert [s for s in own if not any(undeclared(text, rest[s]) for text in texts)] == []


def test_definitions_are_of_existing_pages():
    assert DEFINITIONS.keys() - {"everywhere"} <= {page.stem for page in PAGES}


@pytest.mark.parametrize(
    ("markdown", "snippets", "found"),
    [
        ("IPO costs 52.3.", [], ["IPO costs 52.3."]),
        ("It costs\n$52.3$ in all.", [], ["It costs 52.3 in all."]),
        ("PPO opens 9 % more. IPO does not.", [], ["PPO opens 9 % more."]),
        ("| PPO | 0.8 |", [], ["| PPO | 0.8 |"]),
        ("```{exercise}\nShow 0.8.\n```", [], ["Show 0.8."]),
        ("A bound of 0.5 or 12.", ["bound of 0.5"], ["A or 12."]),
        ("A bound of 0.52.", ["bound of 0.5"], ["A bound of 0.52."]),
        ("It costs {glue:text}`lqr_cost:.1f`, $k^2 = 4$, `x = 3`.", [], []),
        ("Table 1 and Section 5.2 {cite}`sonar2021invariant`; see [it](a9.md).", [], []),
        ("```bash\nmake 3\n```\n1. Runs 0 to 2, five of them.", [], []),
    ],
)
def test_what_counts_as_typed_by_hand(markdown, snippets, found):
    assert undeclared(markdown, snippets) == found
