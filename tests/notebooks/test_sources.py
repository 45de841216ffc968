"""Notebooks are committed as sources: nothing in them comes from a run."""

import re
from pathlib import Path

import nbformat
import pytest
import yaml

import chapters

NOTEBOOKS = Path(__file__).resolve().parents[2] / "notebooks"
CHAPTERS = sorted(NOTEBOOKS.glob("*.ipynb"))
SOURCES = [*CHAPTERS, *sorted(NOTEBOOKS.glob("exercises/*/*.ipynb"))]


@pytest.fixture(params=SOURCES, ids=lambda path: path.stem)
def notebook(request):
    return nbformat.read(request.param, as_version=4)


def test_has_no_outputs(notebook):
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.source for cell in code if cell.outputs or cell.execution_count] == []


def test_has_no_traces_of_a_run(notebook):
    assert "papermill" not in notebook.metadata
    for cell in notebook.cells:
        assert not {"papermill", "execution", "collapsed"} & cell.metadata.keys(), cell.source


@pytest.mark.parametrize("path", CHAPTERS, ids=lambda path: path.stem)
def test_has_one_parameters_cell(path):
    notebook = nbformat.read(path, as_version=4)
    tagged = [cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", [])]
    assert [cell.cell_type for cell in tagged] == ["code"]


def test_finds_data_from_every_folder(notebook):
    """By the folder of the project; only parameters are relative, and ``Chapter`` knows to what."""
    code = [cell.source for cell in notebook.cells if cell.cell_type == "code"]
    lines = [line.strip() for source in code for line in source.splitlines() if "data/" in line]
    wrong = [n for n in lines if "ROOT / " not in n and not re.match(r'\w+_dir = "data/', n)]
    assert wrong == []


def test_has_no_long_cell(notebook):
    code = [cell.source for cell in notebook.cells if cell.cell_type == "code"]
    assert [source for source in code if len(source.splitlines()) > 40] == []


def test_runs_on_the_environment_of_the_book(notebook):
    assert notebook.metadata.kernelspec.name == "python3"


def test_cells_have_ids_of_their_own(notebook):
    assert notebook.nbformat_minor >= 5
    ids = [cell.id for cell in notebook.cells]
    assert len(ids) == len(set(ids))


def test_begins_with_a_title(notebook):
    assert notebook.cells[0].cell_type == "markdown"
    assert "# " in notebook.cells[0].source


@pytest.mark.parametrize("profile", ["smoke", "class", "paper"])
def test_every_profile_names_existing_notebooks(profile):
    parameters = yaml.safe_load((NOTEBOOKS / "profiles" / f"{profile}.yml").read_text())
    assert parameters.keys() <= {path.stem for path in CHAPTERS}


# ------------------------------------------------------------------------------ what is read

# Modules that may read files, each with a check of what it finds, or of what comes from elsewhere.
READERS = {
    "store",  # rows
    "sealed",  # policies, check-points, tables, and records: benchmarks and confirmations, too
    "files",  # what it has just written
    "paper",  # the paper's numbers
    "pictures",  # a film that was just made
}
READING = re.compile(
    r"\bread_(?:csv|json|text|bytes|table|pickle|parquet)\(|\bopen\(|\bsafe_open\(|\bload_file\("
    r"|\b(?:np|numpy)\.(?:load|loadtxt|genfromtxt|fromfile)\((?!io\.BytesIO)|\bZipFile\("
)
PLACE = re.compile(r"""(?:\bDATA|"data")\s*/\s*"(\w+)"|["']data/(\w+)""")
MODULES = {
    ".".join(path.relative_to(NOTEBOOKS / "experiments").with_suffix("").parts): path.read_text()
    for path in (NOTEBOOKS / "experiments").rglob("*.py")
}
CODE = MODULES | {
    path.name: "\n".join(
        cell.source for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"
    )
    for path in CHAPTERS  # exercises have no more than the rows that ship beside them
}


def test_nothing_is_read_past_the_store():
    """All other code gets rows, policies and the paper's numbers from one of the readers."""
    assert {name for name, code in CODE.items() if READING.search(code)} == READERS


def test_all_that_is_read_makes_a_notebook_run_again():
    """Folders of data/ are in the fingerprint of every notebook, but for those made on the way."""
    named = {a or b for code in CODE.values() for a, b in PLACE.findall(code)}
    on_the_way = {"tabulated", "confirmed", "reproduced"}  # a cache; a page's record; outputs
    assert named - on_the_way == set(chapters.DATA)
