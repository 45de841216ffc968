"""What tests of several folders share: the site of this project, built once, smoke profile."""

import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def pytest_collection_modifyitems(items) -> None:
    """One file asks for the site, so that a worker builds it; the others of that kind come last.

    Else the other worker would wait. Of those that come last, the one with the most tests is first,
    so that the workers end together.
    """
    num_tests = Counter(item.path for item in items)
    of_site = {item.path for item in items if "smoke_build" in item.fixturenames}
    first = next((item.path for item in items if item.path in of_site), None)

    def place(item) -> tuple[bool, bool, int]:
        last = item.path in of_site and item.path != first
        return item.path != first, last, -num_tests[item.path] if last else 0

    items.sort(key=place)


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
