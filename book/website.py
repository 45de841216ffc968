"""Stages the sources of the site, builds it with warnings as errors, and swaps it in."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import nbformat

import benchmarks
import claims
import provenance
from execute import BuildError, Notebook, for_terminal, replace_text, tree_hash

NUM_SLOWEST_CELLS = 8
JUPYTER_BOOK = "from jupyter_book.cli.main import main; main()"


def build_site(root: Path, build: Path, notebooks: list[Notebook], profile: str) -> bool:
    """Make <build>/html of the executed notebooks and the prose; False if it is up to date."""
    source, html, built_from = build / "source", build / "html", build / "html.sources"
    stage(root, source, notebooks, profile)
    sources = tree_hash(source)
    if html.exists() and built_from.exists() and built_from.read_text() == sources:
        return False
    fresh = run_jupyter_book(source, build / "new")
    built_from.unlink(missing_ok=True)
    replace_folder(html, fresh)
    replace_text(built_from, sources)
    shutil.rmtree(build / "new")
    return True


def stage(root: Path, source: Path, notebooks: list[Notebook], profile: str) -> None:
    """Put all that enters the site into one folder: prose, executed notebooks, generated pages."""
    shutil.rmtree(source, ignore_errors=True)
    ignored = shutil.ignore_patterns("_build", "_executed", "__pycache__")
    shutil.copytree(root / "book", source, ignore=ignored)
    for script in source.glob("*.py"):
        script.unlink()
    for name in ("_config.yml", "_toc.yml", "environment.txt"):
        shutil.copy(root / name, source)
    # What pages show of the code is included from these files (literalinclude), not copied.
    shutil.copytree(root / "ipo", source / "_code" / "ipo", ignore=ignored)
    for notebook in notebooks:
        nbformat.write(notebook.read_executed(), source / f"{notebook.name}.ipynb")
    (source / "run_times.md").write_text(run_times_page(notebooks, profile), encoding="utf-8")
    claims.write_fragments(source)
    provenance.write_fragment(source)
    benchmarks.write_fragment(source)


def run_jupyter_book(source: Path, output: Path) -> Path:
    """Build the staged sources; any warning is an error. Returns the folder of the pages."""
    shutil.rmtree(output, ignore_errors=True)
    command = [sys.executable, "-c", JUPYTER_BOOK, "build", source, "--path-output", output]
    strict = ["--nitpick", "--warningiserror", "--keep-going", "-q"]
    done = subprocess.run(
        [*command, *strict],
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
    """Put a complete folder in the place of another; both exist until the names are swapped."""
    aside = old.with_name(f"{old.name}.old")
    shutil.rmtree(aside, ignore_errors=True)
    if old.exists():
        old.rename(aside)
    new.rename(old)
    shutil.rmtree(aside, ignore_errors=True)


def run_times_page(notebooks: list[Notebook], profile: str) -> str:
    """The page of run times, from what papermill measured when it executed each notebook."""
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
            "# Run times",
            "",
            "How long each notebook of this site took, from papermill's own record. A notebook is",
            "executed again only when its code, parameters, data, packages or the modules of `ipo`",
            "that it imports change, so the dates may differ.",
            "",
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
