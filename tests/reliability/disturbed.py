"""What disturbs a running job: kills, a second one, a full disk, a read-only one, a wrong clock."""

from __future__ import annotations

import contextlib
import itertools
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from faults import HELD, Job, differs, ended, kill, killed, said, start, wait, whole
from jobs import Build, DoorTraining, Printing, Reproduce, Sweep, left

from chapters import tree_hash

DISK = "size=16m"
TEN_YEARS = 3.2e8  # seconds


def twice(job: Job, generator: np.random.Generator, num: int) -> Iterator[str]:
    """The same command two times at once."""
    expected = whole(job)
    for _ in range(num):
        job.begin()
        programs = [start(job) for _ in range(2)]
        for program in programs:
            program.join()
        failed = [said(program) for program in programs if program.exitcode]
        yield failed[0] if failed else differs(job.result(), expected) or HELD


def with_wrong_clock(job: Job, generator: np.random.Generator, num: int) -> Iterator[str]:
    """A killed job goes on while the clock runs backwards, with files of any age, of the future."""
    began = time.monotonic()
    expected = whole(job)
    seconds = time.monotonic() - began
    forwards = job.run

    def backwards() -> None:
        now, minutes = time.time(), itertools.count()
        time.time = lambda: now - 60 * next(minutes)
        forwards()

    for _ in range(num):
        job.begin()
        _stop(job, generator.uniform(0, seconds))
        for path in job.folder.rglob("*"):
            when = time.time() + generator.uniform(-TEN_YEARS, TEN_YEARS)
            os.utime(path, (when, when))
        job.run = backwards
        yield differs(ended(job), expected) or HELD
        job.run = forwards


def on_full_disk(job: Job, generator: np.random.Generator, num: int) -> Iterator[str]:
    """The disk gets full at some file, which is named; with room again, the command goes on."""
    expected = whole(job)
    needed = sum(path.stat().st_size for path in job.folder.rglob("*"))
    filler = job.folder.parent / "filler"
    for _ in range(num):
        job.begin()
        free = shutil.disk_usage(job.folder).free - int(generator.uniform(0, 1.5 * needed))
        filler.write_bytes(bytes(free))
        program, seen = start(job), set()
        while program.exitcode is None:
            wait(program, 0.5)
            seen |= job.seen()
        unfinished, lost = left(job.folder), len(seen - job.seen())
        filler.unlink()
        if program.exitcode and not (
            "No space left" in said(program) and str(job.folder) in said(program)
        ):
            yield f"no clear message: {said(program)}"
        elif unfinished or lost:
            yield f"{lost} lost, left behind: {unfinished}"
        else:
            yield differs(ended(job), expected) or HELD


def on_read_only_disk(job: Job, generator: np.random.Generator, num: int) -> Iterator[str]:
    """What is there is loaded, and what is not is refused; the folder is named, and goes on."""
    began = time.monotonic()
    expected = whole(job)
    seconds = time.monotonic() - began
    for number in range(num):
        job.begin()
        if number % 2:
            ended(job)
        else:
            _stop(job, generator.uniform(0, seconds / 2))
        before = tree_hash(job.folder)
        _mount("-o", "remount,ro", job.folder.parent)
        program = start(job)
        program.join()
        _mount("-o", "remount,rw", job.folder.parent)
        if number % 2 and program.exitcode:
            yield f"could not be loaded: {said(program)}"
        elif program.exitcode and str(job.folder) not in said(program):
            yield f"no clear message: {said(program)}"
        elif tree_hash(job.folder) != before:
            yield "the folder has changed"
        else:
            yield differs(ended(job), expected) or HELD


def _stop(job: Job, seconds: float) -> None:
    """A job that is killed after some seconds, if it has not ended."""
    program = start(job)
    wait(program, seconds)
    if program.exitcode is None:
        kill(program, signal.SIGKILL, whole_tree=True)


@contextlib.contextmanager
def disk(folder: Path) -> Iterator[Path]:
    """A small file system.

    Raises:
        subprocess.CalledProcessError: it may not be mounted here.
    """
    folder.mkdir()
    _mount("-t", "tmpfs", "-o", DISK, "tmpfs", folder)
    try:
        yield folder
    finally:
        subprocess.run(["umount", folder], check=True)


def _mount(*arguments: str | Path) -> None:
    subprocess.run(["mount", *arguments], check=True, capture_output=True)


def of(make: Callable[[Path], Job], fault: Callable) -> Callable:
    """A fault that hits a job: outcomes by folder, generator and number of tries."""
    return lambda folder, generator, num: fault(make(folder), generator, num)


def on_disk(make: Callable[[Path], Job], fault: Callable) -> Callable:
    """The same on a small file system; nothing is tried where none may be mounted."""

    def outcomes(folder: Path, generator: np.random.Generator, num: int) -> list[str]:
        try:
            with disk(folder) as place:
                return list(fault(make(place / "job"), generator, num))
        except subprocess.CalledProcessError:
            return []

    return outcomes


terminated = partial(killed, how=signal.SIGTERM)
# By kind of fault: what it is called, where it hits, how often, and its outcomes.
KINDS = {
    "kills": [
        ("`kill -9`", "sweep", 40, of(Sweep, killed)),
        ("`kill -9`", "training", 25, of(DoorTraining, killed)),
        ("`kill -9`", "build", 15, of(Build, killed)),
        ("`kill -9`", "`reproduce`", 20, of(Reproduce, killed)),
    ],
    "terminations": [
        ("SIGTERM", "sweep", 4, of(Sweep, terminated)),
        ("SIGTERM", "training", 3, of(DoorTraining, terminated)),
        ("SIGTERM", "build", 3, of(Build, terminated)),
        ("SIGTERM", "`reproduce`", 3, of(Reproduce, terminated)),
    ],
    "printing": [
        ("`kill -9`", "PDF of the book", 20, of(Printing, killed)),
        ("SIGTERM", "PDF of the book", 10, of(Printing, terminated)),
    ],
    "two at once": [
        ("two at once", "sweep", 4, of(Sweep, twice)),
        ("two at once", "build", 2, of(Build, twice)),
        ("two at once", "`reproduce`", 2, of(Reproduce, twice)),
    ],
    "disks": [
        ("full disk", "sweep", 8, on_disk(Sweep, on_full_disk)),
        ("full disk", "training", 4, on_disk(DoorTraining, on_full_disk)),
        ("full disk", "build", 4, on_disk(Build, on_full_disk)),
        ("read-only disk", "sweep", 4, on_disk(Sweep, on_read_only_disk)),
        ("read-only disk", "training", 2, on_disk(DoorTraining, on_read_only_disk)),
    ],
    "clocks": [
        ("clock runs backwards", "sweep", 4, of(Sweep, with_wrong_clock)),
        ("clock runs backwards", "training", 2, of(DoorTraining, with_wrong_clock)),
    ],
}
