"""A toy project of two notebooks, for tests of the build."""

from pathlib import Path

import nbformat
import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook

import claims
import costs
import first_page
import printing
import provenance
import sources

ROOT = Path(__file__).resolve().parents[1]
PROFILES = {
    "class": "plain: {num_runs: 3}\n",
    "unknown_notebook": "plane: {num_runs: 3}\n",
    "unknown_parameter": "plain: {num_rums: 3}\n",
    "no_mapping": "- plain\n",
    "no_parameters": "plain: 3\n",
    "broken": "plain:\n  num_runs: [3\n",
    "other_type": "plain: {num_runs: three}\n",
    "other_list": "plain: {num_runs: [3]}\n",
}
FILES = {
    "_config.yml": "title: A toy\nonly_build_toc_files: true\n"
    "execute: {execute_notebooks: 'off'}\n",
    "_toc.yml": "format: jb-book\nroot: intro\nchapters: [{file: plain}, {file: painted}, "
    "{file: run_times}, {file: licences}]\n",
    "environment.txt": "numpy==2\n",
    "book/intro.md": "# A toy\n\nSee [](plain.ipynb).\n",
    "book/run_times.md": "# Run times\n\n```{include} _generated/run_times.md\n```\n",
    "book/licences.md": (ROOT / "book" / "licences.md").read_text(),
    "data/paper/table.csv": "1\n",
    "data/results/plain/rows.csv": "1\n",
    "ipo/__init__.py": "",
    "ipo/colors.py": 'from ipo import shades\n\nRED = f"{shades.DARK} red"\n',
    "ipo/shades.py": 'DARK = "dark"\n',
} | {f"notebooks/profiles/{name}.yml": text for name, text in PROFILES.items()}
CELLS = {
    "plain": [
        ("num_runs = 10", "parameters"),
        ("import sys, warnings\nprint(num_runs, 'runs')\nwarnings.warn('careful')", ""),
        ("import pandas as pd\npd.DataFrame({'a': [1]}).style", ""),
        ("print('1 of 3', file=sys.stderr)\nprint('done')", "progress"),
    ],
    "painted": [("size = 1", "parameters"), ("from ipo import colors\ncolors.RED", "")],
}


def write_notebook(root: Path, name: str, cells: list, text: str = "A toy.") -> None:
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    notebook = new_notebook(metadata={"kernelspec": kernel})
    notebook.cells = [new_markdown_cell(f"# {name}\n\n{text}")] + [
        new_code_cell(source, metadata={"tags": [tag]} if tag else {}) for source, tag in cells
    ]
    for number, cell in enumerate(notebook.cells):
        cell.id = f"cell-{number}"
    nbformat.write(notebook, root / "notebooks" / f"{name}.ipynb")


def write_toy(root: Path) -> None:
    """Make all its files."""
    for path, text in FILES.items():
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        (root / path).write_text(text)
    for name, cells in CELLS.items():
        write_notebook(root, name, cells)


def in_toy(patch: pytest.MonkeyPatch, root: Path) -> None:
    """The toy's own package, and no claims."""
    patch.setattr(sources, "PACKAGES", {"ipo": root / "ipo"})
    patch.setattr(claims, "write_fragments", lambda folder: None)
    patch.setattr(first_page, "write_fragments", lambda folder: None)
    patch.setattr(printing, "chromium", lambda: None)
    for page in (provenance, costs):
        patch.setattr(page, "write_fragment", lambda folder: None)
