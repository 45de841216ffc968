"""Files that are replaced as a whole: readers see the old one or the new one, never a half."""

from __future__ import annotations

import errno
import os
import tempfile
from pathlib import Path


def replace_bytes(path: Path, content: bytes) -> None:
    """Write to a temporary file beside it, read that back, and rename it.

    If any of it fails, what was there stays, and nothing is left beside it.

    Raises:
        OSError: it cannot be written; the error names the file.
    """
    temporary = None
    try:
        with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".tmp", delete=False) as file:
            temporary = Path(file.name)
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        if temporary.read_bytes() != content:
            raise OSError(errno.EIO, "what was written does not come back", str(path))
        temporary.chmod(0o644)
        os.replace(temporary, path)
    except OSError as error:  # of a full disk, which does not say for which file
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def replace_text(path: Path, text: str) -> None:
    replace_bytes(path, text.encode())


def check_file_name(name: str, value: str) -> None:
    """A name that a file in a given folder can have; a path could leave the folder."""
    if value in ("", ".", "..") or set(value) & set("/\\\0"):
        raise ValueError(f"{name} = {value!r}: must be the name of a file, without a path in it")
