"""A chapter's notebook: where its executed copy lies, and whether that is still today's."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

import nbformat
from IPython.core.inputtransformer2 import TransformerManager
from nbformat import NotebookNode

import sources
from experiments.files import replace_text
from outputs import with_outputs

DATA = ("paper", "predictions", "results", "policies", "witness", "bench")  # what notebooks read


@dataclass(frozen=True)
class Notebook:
    """A chapter's notebook, the parameters of a profile, and where its executed copy goes."""

    name: str
    root: Path
    parameters: dict
    folder: Path

    @property
    def source(self) -> Path:
        return self.root / "notebooks" / f"{self.name}.ipynb"

    @property
    def executed(self) -> Path:
        return self.folder / f"{self.name}.ipynb"

    @property
    def record(self) -> Path:
        return self.folder / f"{self.name}.json"

    @property
    def failed(self) -> Path:
        return self.folder / f"{self.name}.failed.ipynb"

    def read(self) -> NotebookNode:
        return nbformat.read(self.source, as_version=4)

    def read_executed(self) -> NotebookNode:
        """The executed copy with today's text: prose may change without an execution."""
        return with_outputs(self.read(), nbformat.read(self.executed, as_version=4), self.root)

    def read_record(self) -> dict:
        return json.loads(self.record.read_text(encoding="utf-8"))

    def keep(self, executed: NotebookNode, record: dict) -> None:
        """Replace the executed copy and its record, whose digest covers both."""
        replace_text(self.executed, nbformat.writes(executed))
        record = record | {"sha256": self.digest(record)}
        replace_text(self.record, json.dumps(record, indent=1) + "\n")

    def is_current(self) -> bool:
        """Whether copy and record are whole, of one run, and of what is there now."""
        if not (self.executed.exists() and self.record.exists()):
            return False
        try:
            record = dict(self.read_record())
        except (ValueError, TypeError):  # damaged: as good as none
            return False
        made_of = {"fingerprint": fingerprint(self), "sha256": self.digest(record)}
        return made_of.items() <= record.items()

    def digest(self, record: dict) -> str:
        """Of the executed copy, and of all in its record but the digest itself."""
        rest = {key: value for key, value in record.items() if key != "sha256"}
        plain = json.dumps(rest, sort_keys=True).encode()
        return hashlib.sha256(plain + self.executed.read_bytes()).hexdigest()


def fingerprint(notebook: Notebook) -> str:
    """Hash of all that the outputs depend on: code, parameters, data, ipo modules, packages."""
    cells = [cell for cell in notebook.read().cells if cell.cell_type == "code"]
    code = [[cell.source, cell.metadata.get("tags", [])] for cell in cells]
    python = TransformerManager().transform_cell("\n".join(cell.source for cell in cells))
    # All of it, not only the chapter's own: one chapter may show what another one has computed.
    folders = [notebook.root / "data" / name for name in DATA]
    everything = {
        "code": code,
        "parameters": notebook.parameters,
        "modules": sources.source_hash(sources.imported_modules(python)),
        "data": {str(folder.relative_to(notebook.root)): tree_hash(folder) for folder in folders},
        "packages": (notebook.root / "environment.txt").read_text(encoding="utf-8"),
    }
    return hashlib.sha256(json.dumps(everything, sort_keys=True).encode()).hexdigest()


def tree_hash(folder: Path) -> str:
    """Hash of the names and contents of all files in a folder."""
    digest = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        content = hashlib.sha256(path.read_bytes()).hexdigest()
        digest.update(f"{path.relative_to(folder).as_posix()} {content}\n".encode())
    return digest.hexdigest()
