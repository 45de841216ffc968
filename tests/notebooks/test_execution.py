"""Every notebook runs: by the build in the smoke profile, and by hand."""

import nbformat
import pytest
from by_hand import NAMES, ROOT, papermill, run_elsewhere, shipped

QUICK = ("lqr", "your_own_domains")


@pytest.mark.parametrize("name", NAMES)
def test_every_cell_ran(smoke_build, name):
    executed = nbformat.read(smoke_build / "_executed" / "smoke" / f"{name}.ipynb", as_version=4)
    code = [cell for cell in executed.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    assert "error" not in {output.output_type for cell in code for output in cell.outputs}


@pytest.mark.parametrize("name", NAMES)
def test_executed_copy_holds_no_times_and_no_places(smoke_build, name):
    text = (smoke_build / "_executed" / "smoke" / f"{name}.ipynb").read_text()
    traces = ('"papermill"', "start_time", "iopub", str(ROOT), "ipykernel_")
    assert [trace for trace in traces if trace in text] == []


@pytest.mark.parametrize(
    "name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in NAMES]
)
def test_runs_by_hand_with_rows_of_ones_own(tmp_path, name):
    """Elsewhere, with a folder for the rows that is relative: what ships stays as it is.

    No notebook depends on the folder (see test_sources), so the quick ones stand for all.
    """
    before = shipped()
    done = run_elsewhere(name, tmp_path, {})
    assert done.returncode == 0, done.stderr
    assert shipped() == before
    policies = tmp_path / "rows" / "policies"
    assert policies.exists() == (name in ("keys", "door"))


@pytest.mark.parametrize("name", NAMES)
def test_a_misspelt_parameter_is_an_error(tmp_path, name):
    done = papermill(name, tmp_path / "out.ipynb", "-p", "num_rums", "3")
    assert done.returncode != 0
    errors = [line for line in done.stderr.splitlines() if "Error: " in line]
    assert any("num_rums" in line for line in errors), done.stderr
