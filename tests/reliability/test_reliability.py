"""Faults that are there are counted; a few of two kinds, and with -m slow one of every kind."""

import json
import time
from pathlib import Path

import count_faults
import numpy as np
import pytest
from damaged import flipped
from faults import HARMLESS, HELD, killed, whole
from jobs import Reproduce, Sweep

from experiments.files import replace_text

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
def test_nothing_is_lost(kind):
    for row in count_faults.rows(kind, 0.05):
        assert row["lost"] == 0, row


def test_a_killed_sweep_loses_nothing(tmp_path, generator):
    assert killed(Sweep(tmp_path / "sweep"), generator, 2) == [HELD, HELD]


def test_a_reproduction_beside_a_toy_record_runs(tmp_path):
    job = Reproduce(tmp_path / "job")
    assert {name for name, _ in whole(job)} == {"trained", "played"}


class Steps:
    """A job that keeps its steps in a file, and may do the last one again when it goes on."""

    def __init__(self, folder: Path, again: bool) -> None:
        self.folder, self.again = folder, again

    def begin(self) -> None:
        self.folder.mkdir(exist_ok=True)
        self._write([])

    def run(self) -> None:
        steps = self._read()
        steps += steps[-1:] if self.again else []
        for number in range(len(steps), 40):
            steps.append(number)
            self._write(steps)
            time.sleep(0.01)

    def seen(self) -> set[int]:
        return set(self._read())

    def result(self) -> list[int]:
        return self._read()

    def _read(self) -> list[int]:
        return json.loads((self.folder / "steps").read_text())

    def _write(self, steps: list[int]) -> None:
        replace_text(self.folder / "steps", json.dumps(steps))


def test_another_end_is_counted_as_lost(tmp_path, generator):
    assert killed(Steps(tmp_path / "job", again=False), generator, 4) == [HELD] * 4
    assert "ended with another result" in killed(Steps(tmp_path / "job", again=True), generator, 4)


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
