"""Builds the book: executes the notebooks that changed, then the site. `make book` calls this."""

from __future__ import annotations

import argparse
import errno
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import chain
from pathlib import Path

import joblib
from filelock import FileLock, Timeout

from execute import execute
from experiments.orphans import interrupt_on_sigterm
from messages import BuildError, shown
from profiles import load_notebooks
from website import build_site

ROOT = Path(__file__).resolve().parents[1]
NO_SPACE = os.strerror(errno.ENOSPC)
UNFINISHED = ("_executed/*/*.running.*", "_executed/*/*.tmp", "_build/*.tmp")


def main(arguments: list[str] | None = None, root: Path = ROOT) -> int:
    """Build the book of the project in `root`; returns the exit status."""
    options = parse(arguments, root)
    interrupt_on_sigterm()
    try:
        build(root, options)
        return 0
    except (BuildError, OSError) as error:
        is_full = NO_SPACE in str(error)
        if isinstance(error, OSError) and not is_full:
            raise
        print(error, file=sys.stderr)
        if is_full:
            where = shown(options.output)
            print(f"{where}: {NO_SPACE}; the last good site is untouched", file=sys.stderr)
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


def build(root: Path, options: argparse.Namespace) -> None:
    """All steps, and how long each took."""
    output = options.output.resolve()
    executed = output / "_executed" / options.profile
    notebooks = load_notebooks(root, options.profile, executed)
    if options.chapter:
        notebooks = only(options.chapter, notebooks)
    make_folders(output / "_build", executed)
    with alone(output):
        remove_unfinished(output)
        execute_and_build(root, output, notebooks, options)


def only(chapter: str, notebooks: list) -> list:
    """The one notebook of that name."""
    chosen = [notebook for notebook in notebooks if notebook.name == chapter]
    if not chosen:
        names = ", ".join(notebook.name for notebook in notebooks)
        raise BuildError(f"There is no chapter {chapter!r}; the chapters are {names}")
    return chosen


def make_folders(*folders: Path) -> None:
    try:
        for folder in folders:
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise BuildError(
            f"{shown(folder)} cannot be written: {error.strerror}. A build writes notebooks and "
            "site there; to have them elsewhere, name a folder: book/build.py --output FOLDER"
        ) from error


@contextmanager
def alone(output: Path) -> Iterator[None]:
    """One build at a time writes to a folder; the next one waits until it has ended."""
    lock = FileLock(output / "_build" / "lock")
    try:
        lock.acquire(blocking=False)
    except Timeout:
        print(
            f"Waiting for another build, which writes to {shown(output)}",
            file=sys.stderr,
            flush=True,
        )
        lock.acquire()
    try:
        yield
    finally:
        lock.release()


def remove_unfinished(output: Path) -> None:
    """What a build leaves that was killed."""
    for path in chain.from_iterable(map(output.glob, UNFINISHED)):
        path.unlink()
    shutil.rmtree(output / "_build" / "new", ignore_errors=True)


def execute_and_build(
    root: Path, output: Path, notebooks: list, options: argparse.Namespace
) -> None:
    steps = []
    if options.setup_seconds is not None:
        steps.append(("set-up", f"{options.setup_seconds:.1f} s"))
    changed = [notebook for notebook in notebooks if not notebook.is_current()]
    failures = execute(changed, options.jobs)
    if failures:
        raise BuildError("\n\n".join(failures))
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


if __name__ == "__main__":
    sys.exit(main())
