"""No process outlives the one that started it, however that one ends, ``kill -9`` included."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time

SECONDS = 0.5  # between two looks


def end_with(parent: int) -> None:
    """End this process soon after its parent: what a process that was started calls first.

    It looks who its parent is. Linux could send a signal instead, but does so when the *thread*
    ends that started a process, and joblib starts workers from threads.

    Args:
        parent: process id of the parent; given, and not looked up, since the parent may have
            ended before this call.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(SECONDS)
        os._exit(1)  # the main thread may compute for minutes, and has nobody to report to

    threading.Thread(target=watch, name="ends with its parent", daemon=True).start()


def python(code: str, *arguments: str) -> list[str]:
    """The command of a Python program that ends with this process; `arguments` are its argv[1:]."""
    watched = "import sys; from experiments.orphans import end_with; end_with(int(sys.argv.pop(1)))"
    return [sys.executable, "-c", f"{watched}\n{code}", str(os.getpid()), *arguments]


def interrupt_on_sigterm() -> None:
    """SIGTERM ends a program as Ctrl-C does: children are ended, temporary folders removed."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
