"""Files behind a seal, the SHA-256 of all that follows it: a changed bit anywhere is an error.

The seal is a line of 64 hexadecimal digits. ``tail --bytes=+66`` shows what it seals. A record, in
JSON that others read as it is, has its seal as the last of its entries instead.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from experiments.files import replace_bytes, replace_text

SEAL_LENGTH = 65  # with its line feed
SEAL = "sha256"  # the entry of a record


class DamagedError(ValueError):
    """A file that is not what was written."""


def read_whole(path: Path) -> bytes:
    """All of a file.

    Raises:
        DamagedError: a link, say, to a pipe or a device, which may have no end.
    """
    if path.exists() and not path.is_file():
        raise DamagedError(f"{path}: is no file that can be read to its end")
    return path.read_bytes()


def write_sealed(path: Path, content: bytes) -> None:
    """Replace the file, and its folder if need be, by the content behind its seal."""
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_bytes(path, _seal(content) + content)


def read_sealed(path: Path) -> bytes:
    """The content, without its seal.

    Raises:
        DamagedError: a file that is cut short or changed, or that never had a seal.
    """
    whole = read_whole(path)
    seal, content = whole[:SEAL_LENGTH], whole[SEAL_LENGTH:]
    if seal != _seal(content):
        raise DamagedError(f"{path}: is cut short or changed, and cannot be used")
    return content


def digest_of(path: Path) -> str:
    """Of the content; a file that is not there is said to be so."""
    if not path.exists():
        return "no such file"
    return hashlib.sha256(read_sealed(path)).hexdigest()[:16]


def write_record(path: Path, record: Mapping[str, Any]) -> None:
    """Replace the file by plain values in JSON, and their seal."""
    replace_text(path, json.dumps({**record, SEAL: _seal_of(record)}, indent=1) + "\n")


def read_record(path: Path) -> dict[str, Any]:
    """The plain values, without their seal.

    Raises:
        DamagedError: a file that is cut short or changed, or that never had a seal.
    """
    try:
        record = dict(json.loads(read_whole(path)))
    except (ValueError, TypeError, RecursionError) as error:
        raise DamagedError(f"{path}: is cut short or changed: {error}") from error
    if record.pop(SEAL, None) != _seal_of(record):
        raise DamagedError(f"{path}: is cut short or changed; restore the file")
    return record


def _seal_of(record: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(record).encode()).hexdigest()


def _seal(content: bytes) -> bytes:
    return hashlib.sha256(content).hexdigest().encode() + b"\n"
