"""What a build says to whoever started it."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterable
from pathlib import Path

ANSI = re.compile(r"\x1b\[[0-9;]*m")


class BuildError(Exception):
    """Something that the reader of the message can repair; shown without a traceback."""


def listed(names: Iterable) -> str:
    return ", ".join(sorted(map(str, names))) or "none"


def for_terminal(text: str) -> str:
    return text if sys.stderr.isatty() else ANSI.sub("", text)


def shown(path: Path) -> str:
    """A path as the user would type it from here."""
    return os.path.relpath(path)
