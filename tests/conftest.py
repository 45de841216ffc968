"""What tests of several folders share: the site of this project, built once, smoke profile."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def pytest_collection_modifyitems(items) -> None:
    """Tests of the site wait until it is built: others first; unit tests fill what is left."""
    folders = {"site": 1, "unit": 2}
    items.sort(key=lambda item: folders.get(item.path.parent.name, 0))


@pytest.fixture(scope="session")
def smoke_build(tmp_path_factory, worker_id) -> Path:
    """The folder with `_executed/smoke` and `_build/html`, made by the build itself.

    Every worker asks for it; the first builds, the others wait and find nothing left to do.
    """
    folder = tmp_path_factory.getbasetemp()
    if worker_id != "master":
        folder = folder.parent
    output = folder / "smoke"
    command = [sys.executable, "book/build.py", "--profile", "smoke", "--output", str(output)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        pytest.fail(f"The book does not build:\n{done.stdout}{done.stderr}", pytrace=False)
    return output


@pytest.fixture(scope="session")
def built_site(smoke_build) -> Path:
    """The folder of the site's pages."""
    return smoke_build / "_build" / "html"
