"""Files behind a seal, the SHA-256 of all that follows it: a changed bit anywhere is an error.

The seal is a line of 64 hexadecimal digits. ``tail --bytes=+66`` shows what it seals.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

from experiments.files import replace_bytes

SEAL_LENGTH = 65  # with its line feed


class DamagedError(ValueError):
    """A file that is not what was written."""


def write_sealed(path: Path, content: bytes) -> None:
    """Replace the file, and its folder if need be, by the content behind its seal."""
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_bytes(path, _seal(content) + content)


def read_sealed(path: Path) -> bytes:
    """The content, without its seal.

    Raises:
        DamagedError: a file that is cut short or changed, or that never had a seal.
    """
    whole = path.read_bytes()
    seal, content = whole[:SEAL_LENGTH], whole[SEAL_LENGTH:]
    if seal != _seal(content):
        raise DamagedError(f"{path}: is cut short or changed, and cannot be used")
    return content


def digest_of(path: Path) -> str:
    """Of the content; a file that is not there is said to be so."""
    if not path.exists():
        return "no such file"
    return hashlib.sha256(read_sealed(path)).hexdigest()[:16]


def _seal(content: bytes) -> bytes:
    return hashlib.sha256(content).hexdigest().encode() + b"\n"
