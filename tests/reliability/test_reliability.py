"""Faults that are there are counted; a few of two kinds, and with -m slow one of every kind."""

import count_faults
import numpy as np
import pytest
from damaged import flipped
from faults import HARMLESS, HELD, count, killed
from jobs import Sweep

QUICK = ("bits", "hostile files")


@pytest.fixture
def generator() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(kind, marks=[] if kind in QUICK else pytest.mark.slow)
        for kind in count_faults.KINDS
        if kind != "bits without a seal"
    ],
)
def test_nothing_is_lost(kind, tmp_path):
    for row in count_faults.rows(kind, 0.05, tmp_path):
        assert row["lost"] == 0, row


def test_a_killed_sweep_loses_nothing(tmp_path, generator):
    assert killed(Sweep(tmp_path / "sweep"), generator, 2) == [HELD, HELD]


class Forgetful(Sweep):
    """It ends with other rows than before."""

    num = 0

    def result(self) -> int:
        self.num += 1
        return self.num


def test_another_end_is_counted_as_lost(tmp_path, generator):
    row = count("kill", "sweep", killed(Forgetful(tmp_path / "sweep"), generator, 1))
    assert (row["tried"], row["held"], row["lost"]) == (1, 0, 1)
    assert row["how"] == ["ended with another result"]


def words(folder):
    folder.mkdir()
    (folder / "words").write_text("eight words, and one of them is wrong")
    return folder / "words"


@pytest.mark.parametrize(
    ("read", "expected"),
    [
        (lambda path: path.read_bytes(), "silent"),
        (lambda path: len(path.read_bytes()), HARMLESS),
        (lambda path: path.read_bytes().index(b"eight words, and one of them is wrong"), "refused"),
        (
            lambda path: {"eight words, and one of them is wrong": 1}[path.read_text()],
            "not refused",
        ),
    ],
    ids=["silent", "harmless", "nameless", "crash"],
)
def test_flips_are_told_apart(tmp_path, generator, read, expected):
    found = list(flipped(words, read, tmp_path / "folder", generator, 20))
    assert len(found) == 20
    assert all(outcome.startswith(expected) for outcome in found if "Unicode" not in outcome)
