"""Builds the book: executes the notebooks that changed, then the site. `make book` calls this."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import joblib

from execute import BuildError, execute, load_notebooks, shown
from website import build_site

ROOT = Path(__file__).resolve().parents[1]


def main(arguments: list[str] | None = None, root: Path = ROOT) -> int:
    """Build the book of the project in `root`; returns the exit status."""
    options = parse(arguments, root)
    try:
        return build(root, options)
    except BuildError as error:
        print(error, file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("Interrupted; the last good site is untouched", file=sys.stderr)
        return 130


def parse(arguments: list[str] | None, root: Path) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, allow_abbrev=False)
    parser.add_argument("--profile", default="class", help="parameters: notebooks/profiles/*.yml")
    parser.add_argument("--jobs", type=int, default=joblib.cpu_count(), help="notebooks at a time")
    parser.add_argument("--chapter", help="execute only this notebook, and build no site")
    parser.add_argument(
        "--output", type=Path, default=root / "book", help="where _executed and _build go"
    )
    parser.add_argument("--setup-seconds", type=float, help="how long set-up took, for the table")
    options = parser.parse_args(arguments)
    if options.jobs < 1:
        parser.error(f"--jobs is {options.jobs}; it must be at least 1")
    return options


def build(root: Path, options: argparse.Namespace) -> int:
    """All steps, and how long each took."""
    steps = []
    if options.setup_seconds is not None:
        steps.append(("set-up", f"{options.setup_seconds:.1f} s"))
    output = options.output.resolve()
    executed = output / "_executed" / options.profile
    notebooks = load_notebooks(root, options.profile, executed)
    if options.chapter:
        notebooks = only(options.chapter, notebooks)

    changed = [notebook for notebook in notebooks if not notebook.is_current()]
    failures = execute(changed, options.jobs)
    if failures:
        print("\n\n".join(failures), file=sys.stderr)
        return 1
    for notebook in notebooks:
        took = f"{notebook.read_record()['seconds']:.1f} s" if notebook in changed else "unchanged"
        steps.append((f"notebooks/{notebook.name}.ipynb", took))

    if options.chapter:
        result = f"The executed notebook is {shown(notebooks[0].executed)}"
    else:
        began = time.time()
        is_new = build_site(root, output / "_build", notebooks, options.profile)
        steps.append(("site", f"{time.time() - began:.1f} s" if is_new else "unchanged"))
        result = f"The book is {shown(output / '_build' / 'html' / 'index.html')}"

    width = max(len(name) for name, _ in steps)
    for name, took in steps:
        print(f"{name:<{width}}  {took:>9}")
    print(result)
    return 0


def only(chapter: str, notebooks: list) -> list:
    """The one notebook of that name."""
    chosen = [notebook for notebook in notebooks if notebook.name == chapter]
    if not chosen:
        names = ", ".join(notebook.name for notebook in notebooks)
        raise BuildError(f"There is no chapter {chapter!r}; the chapters are {names}")
    return chosen


if __name__ == "__main__":
    sys.exit(main())
