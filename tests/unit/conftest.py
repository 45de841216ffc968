"""Settings of the unit tests: one thread, the same hypothesis examples every time; tables."""

from pathlib import Path

import hypothesis
import pytest
import torch

from experiments.tabulated import load_or_tabulate
from ipo.worlds.colored_keys import COLORS, ColoredKeysEnv
from ipo.worlds.tabular import TabularTask

# Derandomised: the suite decides the same way on every machine and on every day.
hypothesis.settings.register_profile("unit", deadline=None, derandomize=True, max_examples=25)
hypothesis.settings.load_profile("unit")


@pytest.fixture(autouse=True, scope="session")
def one_thread():
    """The matrices here are too small for more."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def tables(tmp_path_factory, worker_id) -> Path:
    """A folder for tabulated tasks: what one worker has tabulated, the others load."""
    folder = tmp_path_factory.getbasetemp()
    return (folder if worker_id == "master" else folder.parent) / "tables"


@pytest.fixture(scope="session")
def keys(tables) -> dict[str, TabularTask]:
    """The coloured keys as tables, by colour."""
    return {
        color: load_or_tabulate(ColoredKeysEnv, tables, size=5, color=color) for color in COLORS
    }
