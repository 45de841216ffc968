"""Text that is made of data and included in pages of prose."""

from __future__ import annotations

from pathlib import Path


def write_fragment(folder: Path, name: str, text: str) -> None:
    """Writes ``_generated/<name>.md`` under ``folder``, where the pages are."""
    path = Path(folder) / "_generated" / f"{name}.md"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
