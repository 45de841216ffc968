"""Stages the sources of the site, builds it with warnings as errors, and swaps it in."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
from pathlib import Path

import nbformat

import archive
import benchmarks
import claims
import costs
import decks
import deviations
import fairness
import first_page
import hyperparameters
import licences
import printing
import provenance
import reading_time
import reliability
import teaching
from chapters import Notebook, tree_hash
from experiments.files import replace_text
from experiments.orphans import python
from finish import finish
from fragments import write_fragment
from messages import BuildError, for_terminal

GENERATED = {  # text from what is recorded, and from the packages that are installed
    "provenance": provenance,
    "reliability": reliability,
    "own_domains": benchmarks,
    "costs": costs,
    "licences": licences,
}
NUM_SLOWEST_CELLS = 8
NOT_STAGED = ("_build", "_executed", "__pycache__", "*.py", "finish", "locks", "rules")
FINISHING = Path(__file__).parent / "finish"
JUPYTER_BOOK = "from jupyter_book.cli.main import main; main()"


def build_site(root: Path, build: Path, notebooks: list[Notebook], profile: str) -> bool:
    """Make <build>/html of the executed notebooks and the prose; False if it is up to date."""
    source, html, built_from = build / "source", build / "html", build / "html.sources"
    stage(root, source, notebooks, profile)
    sources = f"{tree_hash(source)} {tree_hash(FINISHING)}"
    if built_from.exists() and built_from.read_text() == f"{sources} {tree_hash(html)}\n":
        return False
    pages = run_jupyter_book(source, build / "new")
    decks.build(source, build / "new" / "slides", pages, notebooks)
    finish(pages)
    printing.print_book(pages, root)
    replace_folder(html, pages)
    replace_text(built_from, f"{sources} {tree_hash(html)}\n")
    shutil.rmtree(build / "new")
    return True


def stage(root: Path, source: Path, notebooks: list[Notebook], profile: str) -> None:
    """Put all that enters the site into one folder: prose, executed notebooks, generated pages."""
    shutil.rmtree(source, ignore_errors=True)
    others = shutil.ignore_patterns(*NOT_STAGED)
    shutil.copytree(root / "book", source, ignore=others)
    for name in ("_config.yml", "_toc.yml", "environment.txt"):
        shutil.copy(root / name, source)
    # What pages show of the code is included from these files (literalinclude), not copied.
    shutil.copytree(
        root / "ipo", source / "_code" / "ipo", ignore=shutil.ignore_patterns("__pycache__")
    )
    for notebook in notebooks:
        nbformat.write(notebook.read_executed(), source / f"{notebook.name}.ipynb")
    claims.write_fragments(source)
    for name, page in GENERATED.items():
        write_fragment(source, name, page.overview())
    teaching.write_download(source, source.parent)
    archive.write_archive(root, source / "extra" / archive.NAME, source / "_downloads")
    tables = {
        "fairness": fairness.table(),
        "hyperparameters": hyperparameters.tables(),
        "deviations": deviations.tables(),
        "slides": decks.links(decks.decks_of(source, notebooks)),
        "source": downloads(root, source),
        "run_times": run_times_tables(notebooks, profile),
    }
    for name, text in tables.items():
        write_fragment(source, name, text)
    reading_time.write_fragments(source, notebooks)
    first_page.write_fragments(source)


def downloads(root: Path, source: Path) -> str:
    """What the site offers of itself: its source, and the book on paper."""
    whole = archive.where_to_find_it(root, source / "extra" / archive.NAME)
    return whole + (printing.LINK if printing.chromium() else "")


def run_jupyter_book(source: Path, output: Path) -> Path:
    """Build the staged sources; any warning is an error. Returns the folder of the pages."""
    shutil.rmtree(output, ignore_errors=True)
    strict = ["--nitpick", "--warningiserror", "--keep-going", "-q"]
    done = subprocess.run(
        python(JUPYTER_BOOK, "build", str(source), "--path-output", str(output), *strict),
        cwd=source,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    if done.returncode:
        raise BuildError(
            "The site could not be built; the last good one is untouched.\n"
            + for_terminal(done.stdout).replace(f"{source}{os.sep}", "")
        )
    return output / "_build" / "html"


def replace_folder(old: Path, new: Path) -> None:
    """Put a complete folder in the place of another, which goes."""
    if not old.exists():
        new.rename(old)
    elif not exchanged(old, new):  # between these two names neither is there, for microseconds
        aside = new.with_name(f"{new.name}.old")
        old.rename(aside)
        new.rename(old)


def exchanged(one: Path, other: Path) -> bool:
    """Swap two names in one step; only Linux can, and not on every file system."""
    swap = getattr(ctypes.CDLL(None), "renameat2", None)
    here, exchange = -100, 2  # AT_FDCWD, RENAME_EXCHANGE
    return swap is not None and swap(here, bytes(one), here, bytes(other), exchange) == 0


def run_times_tables(notebooks: list[Notebook], profile: str) -> str:
    """Tables of how long notebooks and cells took, from what papermill measured."""
    records = {notebook.name: notebook.read_record() for notebook in notebooks}
    totals = [
        [
            f"{{doc}}`{name}`",
            profile,
            f"{record['seconds']:.1f}",
            str(record["cores"]),
            f"Python {record['versions']['python']}, torch {record['versions']['torch']}",
            record["date"],
        ]
        for name, record in records.items()
    ]
    total = sum(record["seconds"] for record in records.values())
    totals.append(["**All notebooks**", "", f"**{total:.1f}**", "", "", ""])
    cells = [(cell, name) for name, record in records.items() for cell in record["cells"]]
    cells.sort(key=lambda pair: -pair[0]["seconds"])
    slowest = [
        [f"{{doc}}`{name}`", str(cell["cell"]), code(cell["first_line"]), f"{cell['seconds']:.1f}"]
        for cell, name in cells[:NUM_SLOWEST_CELLS]
    ]
    return "\n".join(
        [
            *table(["Notebook", "Profile", "Seconds", "Cores", "Versions", "Date"], totals),
            "",
            "The slowest cells:",
            "",
            *table(["Notebook", "Cell", "First line", "Seconds"], slowest),
            "",
        ]
    )


def table(header: list[str], rows: list[list[str]]) -> list[str]:
    """A Markdown table, numbers to the right."""
    numeric = ("Seconds", "Cores", "Cell")
    rule = ["--:" if name in numeric else ":--" for name in header]
    return ["| " + " | ".join(row) + " |" for row in [header, rule, *rows]]


def code(text: str) -> str:
    """A line of code that survives in a cell of a Markdown table."""
    return "`` {} ``".format(text.replace("|", "\\|"))
