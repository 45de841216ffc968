"""The table of licences: of every pinned package, and of what pages bring along."""

from __future__ import annotations

import re
from importlib.metadata import files, metadata
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PIN = re.compile(r"([\w.-]+)==([\w.+]+)")
NEEDED = "# What the packages above need"
ADDRESS = re.compile(r"https?://[^\s)]+")
# Of what pages bring along that neither we nor those packages wrote: where it says so.
NOTICES = (
    ("pydata-sphinx-theme", "bootstrap.js.LICENSE.txt"),
    ("pydata-sphinx-theme", "fontawesome.js.LICENSE.txt"),
    ("sphinx-copybutton", "clipboard.min.js"),
    ("sphinx-revealjs", "reveal.js"),
)


def overview() -> str:
    lines = ["| In the pages | Comes with | Licence |", "|:--|:--|:--|", mathjax()]
    lines += [notice(package, name) for package, name in NOTICES]
    chosen, needed = pinned()
    lines += ["", *table(chosen), "", f":::{{dropdown}} What they need: {len(needed)} more"]
    lines += ["", *table(needed), "", ":::"]
    return ADDRESS.sub(r"<\g<0>>", "\n".join(lines)) + "\n"  # a link may wrap anywhere


def mathjax() -> str:
    folder = ROOT / "book" / "finish" / "mathjax"
    title = (folder / "VERSION.md").read_text(encoding="utf-8").splitlines()[0]
    terms = (folder / "LICENSE").read_text(encoding="utf-8").split("\n\n")[0]
    return f"| {title.lstrip('# ')} | `book/finish/mathjax` | {' '.join(terms.split())} |"


def notice(package: str, name: str) -> str:
    """The first and the decisive line of the comment that a file begins with."""
    [path] = [path for path in files(package) or [] if path.name == name]
    comment = path.read_text(encoding="utf-8").split("*/")[0]
    lines = [line.strip(" */!") for line in comment.splitlines()]
    title = next(line for line in lines if line)
    terms = next(line for line in lines if "licen" in line.lower())
    return f"| {title} | {package} | {terms} |"


def table(pins: dict[str, str]) -> list[str]:
    rows = [f"| {name} | {version} | {licence(name)} |" for name, version in pins.items()]
    return ["| Package | Version | Licence |", "|:--|:--|:--|", *rows]


def pinned() -> tuple[dict[str, str], dict[str, str]]:
    """The packages of ``environment.txt`` and their versions: our own choice, what they need."""
    text = (ROOT / "environment.txt").read_text(encoding="utf-8")
    chosen, needed = text.split(NEEDED)
    return pins(chosen), pins(needed)


def pins(text: str) -> dict[str, str]:
    """By name, in the order of the alphabet."""
    found = [match.groups() for line in text.splitlines() if (match := PIN.match(line))]
    return dict(sorted(found, key=lambda pin: pin[0].lower()))


def licence(name: str) -> str:
    """What an installed package says of itself, in the newest of three ways that it may use.

    Raises:
        ValueError: a package that names none.
    """
    about = metadata(name)
    classifiers = [text.split(" :: ") for text in about.get_all("Classifier") or []]
    free_text = (about["License"] or "").strip().splitlines()
    said = [
        about["License-Expression"],
        ", ".join(parts[-1] for parts in classifiers if parts[0] == "License"),
        free_text[0] if free_text else None,
    ]
    named = [text for text in said if text and text != "UNKNOWN"]
    if not named:
        raise ValueError(f"package = {name!r}: must name its licence in its metadata")
    return named[0]
