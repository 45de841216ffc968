"""What is kept of an execution: the committed notebook with outputs, and a record beside it.

The copy has nothing else that a run leaves behind, so two runs differ only where results do.
"""

from __future__ import annotations

import copy
import os
import platform
import re
from importlib.metadata import version
from pathlib import Path

import joblib
from nbformat import NotebookNode


def with_outputs(source: NotebookNode, executed: NotebookNode, root: Path) -> NotebookNode:
    """The source notebook with the outputs of an execution of the same code cells.

    The cell with the injected parameters stays, for whoever downloads the notebook, but is
    hidden from the page.
    """
    code = [cell for cell in executed.cells if cell.cell_type == "code"]
    injected = [copy.deepcopy(cell) for cell in code if is_tagged(cell, "injected-parameters")]
    ran = iter(cell for cell in code if not is_tagged(cell, "injected-parameters"))
    for cell in injected:
        cell.update(id="injected-parameters", metadata=NotebookNode())
        cell.metadata.tags = ["injected-parameters", "remove-cell"]
    result = copy.deepcopy(source)
    result.cells = []
    for cell in copy.deepcopy(source.cells):
        result.cells.append(cell)
        if cell.cell_type == "code":
            twin = next(ran)
            cell.execution_count = twin.execution_count
            cell.outputs = [
                reproducible(output, cell, root)
                for output in twin.outputs
                if is_shown(output, cell)
            ]
        if is_tagged(cell, "parameters"):
            result.cells.extend(injected)
    if "language_info" in executed.metadata:
        result.metadata.language_info = executed.metadata.language_info
    return result


def is_tagged(cell: NotebookNode, tag: str) -> bool:
    return tag in cell.metadata.get("tags", [])


def is_shown(output: NotebookNode, cell: NotebookNode) -> bool:
    """Everything, except the progress bars of cells that are tagged `progress`."""
    return not (is_tagged(cell, "progress") and output.get("name") == "stderr")


def reproducible(output: NotebookNode, cell: NotebookNode, root: Path) -> NotebookNode:
    """An output without what differs in every run: where it ran, addresses, random names."""
    if output.get("name") == "stderr":  # warnings name the file that gave them
        output.text = output.text.replace(f"{root}{os.sep}", "")
        output.text = re.sub(r"\S*ipykernel_\d+[/\\]\d+\.py", "<cell>", output.text)
    data = output.get("data", {})
    if "text/plain" in data:
        data["text/plain"] = re.sub(r" at 0x[0-9a-f]+", "", data["text/plain"])
    if "text/html" in data:  # pandas gives each styled table a random name
        random_names = re.findall(r'<table id="(T_[0-9a-f]{5})"', data["text/html"])
        for number, name in enumerate(random_names):
            data["text/html"] = data["text/html"].replace(name, f"T_{cell.id}_{number}")
    return output


def run_record(raw: NotebookNode) -> dict:
    """What papermill measured, and on what."""
    numbered = enumerate(cells_of_source(raw), start=1)
    return {
        "date": raw.metadata.papermill.start_time[:10],
        "seconds": raw.metadata.papermill.duration,
        "cores": joblib.cpu_count(),
        "versions": {"python": platform.python_version(), "torch": version("torch")},
        "cells": [
            {
                "cell": number,
                "first_line": first_line(cell),
                "seconds": cell.metadata.papermill.duration,
            }
            for number, cell in numbered
            if cell.cell_type == "code"
        ],
    }


def cells_of_source(raw: NotebookNode) -> list[NotebookNode]:
    """The cells of an execution that are in the source, so that their numbers agree."""
    added = ("injected-parameters", "papermill-error-cell-tag")
    return [cell for cell in raw.cells if not any(is_tagged(cell, tag) for tag in added)]


def last_started(raw: NotebookNode) -> tuple[int, NotebookNode]:
    """The cell that an execution came to, with its number in the source."""
    started = [
        (number, cell)
        for number, cell in enumerate(cells_of_source(raw), start=1)
        if cell.metadata.papermill.start_time
    ]
    return started[-1]


def first_line(cell: NotebookNode) -> str:
    """The first line of a cell that does something, or else its first line."""
    lines = [line.strip() for line in cell.source.splitlines() if line.strip()]
    return next((line for line in lines if not line.startswith("#")), "".join(lines[:1]))
