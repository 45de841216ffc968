"""Jobs that are hit by faults: started, killed at random moments, run to their end, looked at.

A job is a folder and a command that goes on where it was. Every fault gives an outcome: ``HELD``,
``HARMLESS`` (the same comes out), or in words what was lost.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import tempfile
import time
import traceback
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import psutil

HELD, HARMLESS = "held", "harmless"
MARK = "RELIABILITY_JOB"  # in the environment of all that a job starts
SECONDS_TO_END = 15.0  # that workers and kernels have
FORK = multiprocessing.get_context("fork")  # what is imported here need not be imported there


class Job(Protocol):
    """A command with its folder."""

    folder: Path

    def begin(self) -> None:
        """Make the folder as it is before the command."""

    def run(self) -> None:
        """The command, in a process of its own."""

    def seen(self) -> set[Any]:
        """What is finished and must not be lost any more."""

    def result(self) -> Any:
        """What it comes to; without what is different in every run."""


def start(job: Job) -> multiprocessing.Process:
    """The command in a process of its own, whose messages are kept."""
    log = tempfile.TemporaryFile("w+", errors="replace")  # noqa: SIM115, it goes with the process

    def run() -> None:
        os.environ[MARK] = str(os.getppid())
        for stream in (1, 2):
            os.dup2(log.fileno(), stream)
        status = 1
        try:
            job.run()
            status = 0
        except SystemExit as end:
            status = end.code
        except BaseException:
            traceback.print_exc()
        finally:  # at once: to wait for idle workers at the end is for programs, not for forks
            os._exit(status)

    process = FORK.Process(target=run)
    process.start()
    process.log = log
    return process


def whole(job: Job) -> Any:
    """What comes of a job that nothing disturbs."""
    job.begin()
    return ended(job)


def ended(job: Job) -> Any:
    """What comes of a job that now runs to its end.

    Raises:
        RuntimeError: it fails.
    """
    process = start(job)
    process.join()
    if process.exitcode:
        raise RuntimeError(said(process))
    return job.result()


def wait(process: multiprocessing.Process, seconds: float) -> None:
    """Wait so long, or until it has ended; ``join`` would not come back where it is a program."""
    deadline = time.monotonic() + seconds
    while process.exitcode is None and (left := deadline - time.monotonic()) > 0:
        time.sleep(min(left, 0.02))


def said(process: multiprocessing.Process) -> str:
    process.log.seek(0)
    return process.log.read()


def kill(process: multiprocessing.Process, how: int, whole_tree: bool) -> str | None:
    """End a job. In words what is wrong with how it ended; None: nothing."""
    victims = [psutil.Process(process.pid)]
    if whole_tree:
        victims += victims[0].children(recursive=True)
    for victim in victims:
        with contextlib.suppress(psutil.NoSuchProcess):  # one of the short ones
            victim.send_signal(how)
    wait(process, SECONDS_TO_END)
    if process.exitcode is None:
        process.kill()
        return "did not end"
    return orphans()


def orphans() -> str | None:
    """Wait for all that jobs have started to end; what does not is named, and ended here."""
    deadline = time.monotonic() + SECONDS_TO_END
    while (alive := list(descendants())) and time.monotonic() < deadline:
        time.sleep(0.2)
    names = [process.name() for process in alive if process.is_running()]
    for process in alive:
        process.kill()
    return f"orphans: {names}" if names else None


def descendants() -> Iterator[psutil.Process]:
    """All processes that jobs of this process have started."""
    for process in psutil.process_iter():
        try:
            if process.environ().get(MARK) == str(os.getpid()):
                yield process
        except psutil.Error:  # it has ended, or is another user's
            pass


def killed(
    job: Job, generator: np.random.Generator, num: int, how: int = signal.SIGKILL
) -> Sequence[str]:
    """Outcomes of so many kills at random moments, each followed by the same command.

    Moments are uniform over the time that the job takes undisturbed. Who survives its moment has
    ended: its result is held beside the undisturbed one, and the job begins again.
    """
    began = time.monotonic()
    expected = whole(job)
    seconds = time.monotonic() - began
    outcomes: list[str] = []
    job.begin()
    num_before = 0  # outcomes when this job began
    while len(outcomes) < num:
        process = start(job)
        wait(process, generator.uniform(0, seconds))
        before = job.seen()
        if process.exitcode is None:
            problem = kill(process, how, bool(generator.integers(2)) and how == signal.SIGKILL)
            lost = len(before - job.seen())
            if process.exitcode != 0:  # it may have ended by itself between the two looks
                outcomes.append(problem or (f"{lost} lost" if lost else HELD))
                continue
        problem = (
            f"failed: {said(process)}" if process.exitcode else differs(job.result(), expected)
        )
        if problem and len(outcomes) > num_before:
            outcomes[-1] = problem
        job.begin()
        num_before = len(outcomes)
    if problem := differs(ended(job), expected):
        outcomes[-1] = problem
    return outcomes


def differs(found: Any, expected: Any) -> str | None:
    return None if found == expected else "ended with another result"


def count(fault: str, where: str, outcomes: Sequence[str]) -> dict[str, Any]:
    """A row of the table."""
    held, harmless = (outcomes.count(outcome) for outcome in (HELD, HARMLESS))
    return {
        "fault": fault,
        "where": where,
        "tried": len(outcomes),
        "held": held,
        "harmless": harmless,
        "lost": len(outcomes) - held - harmless,
        "how": sorted({outcome[-500:] for outcome in outcomes} - {HELD, HARMLESS}),
    }
