"""Settings of the unit tests: one thread, and the same hypothesis examples every time."""

import hypothesis
import pytest
import torch

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
