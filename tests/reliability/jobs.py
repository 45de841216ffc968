"""The jobs that faults hit: a sweep, a training, a build, its PDF and ``experiments.reproduce``."""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest
import toy_chapter
import toy_experiment
from faults import whole
from pypdf import PdfReader
from toy_book import CELLS, in_toy, write_notebook, write_toy
from toy_experiment import Cell

import build
import printing
from chapters import tree_hash
from experiments.checkpoints import load_checkpoint
from experiments.doors import training
from experiments.doors.training import checkpoint_path, published_door
from experiments.experiment import Places
from experiments.orphans import interrupt_on_sigterm
from experiments.store import Store
from experiments.tensors import read_tensors

ROOT = Path(__file__).resolve().parents[2]
EMPTY = "EXPERIMENTS, CELLS = {}, ()\n"
# What the registry imports.
CHAPTERS = dict.fromkeys(
    [
        *("causality.py", "keys.py", "keys_labels.py", "lqr_worst.py", "own_domains.py"),
        *("cue/training.py", "doors/success.py", "games/scalar.py"),
        *("regularized/linear.py", "regularized/trials.py"),
    ],
    EMPTY,
) | {"lqr.py": "from toy_chapter import EXPERIMENTS\n"}
UNFINISHED = (".tmp", ".new", ".running")  # in the names of files that are being written


def left(folder: Path) -> list[str]:
    """Files that should have gone."""
    return sorted(p.name for p in folder.rglob("*") if any(part in p.name for part in UNFINISHED))


def lines(folder: Path, name: str) -> set[str]:
    """The rows of a store, as they are in its file."""
    store = Store(folder, name)
    return set(store.rows().to_csv(index=False, header=False).splitlines())


class Sweep:
    """Many cells of the toy experiment, by two workers."""

    cells = tuple(Cell("slow", size) for size in range(1, 31))

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def begin(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir()

    def run(self) -> None:
        interrupt_on_sigterm()
        toy_experiment.fill(self.folder, self.cells, num_workers=2)

    def seen(self) -> set[str]:
        return lines(self.folder, "toy")

    def result(self) -> bytes:
        return (self.folder / "toy.csv").read_bytes()


class DoorTraining:
    """Two runs of PPO on two doors, trained together, a check-point after every update."""

    settings = published_door(
        "ppo", num_updates=4, num_envs=(1, 1), num_steps=512, num_minibatches=2, num_epochs=1
    )
    cell = training.Cell("ppo", settings, saved_after=(2, 4), curve_every=2)
    seeds = (0, 1)

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.places = Places(folder, folder / "policies", folder / "checkpoints")

    def begin(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir()

    def run(self) -> None:
        interrupt_on_sigterm()
        training.NUM_CURVE_DOORS = 2
        experiment = training.EXPERIMENT.at(self.places)
        Store(self.folder, "curves").fill(experiment, [self.cell], self.seeds, num_workers=1)

    def seen(self) -> set[Any]:
        """Rows, and updates of every run."""
        found: set[Any] = lines(self.folder, "curves")
        saved = {
            seed for batch in Store(self.folder, "curves").batches() for seed in batch["seeds"]
        }
        for seed in self.seeds:
            num_updates = 4 if seed in saved else self._num_updates()
            found |= {(seed, number) for number in range(num_updates)}
        return found

    def _num_updates(self) -> int:
        path = checkpoint_path(self.cell, self.seeds, self.places.checkpoints)
        while True:
            try:
                return (load_checkpoint(path) or {"num_updates": 0})["num_updates"]
            except FileNotFoundError:  # renamed by the training while it was looked for
                pass

    def result(self) -> tuple:
        rows = {line for line in lines(self.folder, "curves") if "cpu_seconds" not in line}
        return rows, {path.name: tensors(path) for path in self.places.policies.glob("*.s*")}


def tensors(path: Path) -> str:
    """A digest of the weights in a policy; what else it says has its time in it."""
    digest = hashlib.sha256()
    for name, weight in sorted(read_tensors(path, "about")[0].items()):
        digest.update(name.encode() + weight.numpy().tobytes())
    return digest.hexdigest()


class Build:
    """A toy book whose notebooks and pages change, over and over, between two states."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.state = folder, 0
        self.site = folder / "book" / "_build" / "html"
        write_toy(folder)
        (folder / "book" / "run_times.md").write_text("# Run times\n")  # they are never the same
        write_notebook(folder, "painted", CELLS["painted"][:1])  # without the toy's package
        self.complete = ["", ""]
        for _ in range(2):
            whole(self)
            self.complete[self.state] = tree_hash(self.site)

    def begin(self) -> None:
        """The other state; the site that is there is of the one before."""
        self.state = 1 - self.state
        text = f"State {self.state}"
        write_notebook(self.folder, "plain", [*CELLS["plain"], (f"print({text!r})", "")], text)

    def run(self) -> None:
        in_toy(pytest.MonkeyPatch(), self.folder)
        sys.exit(build.main(["--jobs", "2"], self.folder))

    def seen(self) -> set[str]:
        """Whether there is a site, one of the two that are complete."""
        return {"good site"} if tree_hash(self.site) in self.complete else set()

    def result(self) -> tuple:
        site = tree_hash(self.site)
        good = "the complete one" if site == self.complete[self.state] else site
        return good, left(self.folder / "book")


class Printing:
    """The PDF of a toy book, by a browser, which must end with the build."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.site = folder, Build(folder).site

    def begin(self) -> None:
        (self.site / printing.NAME).unlink(missing_ok=True)

    def run(self) -> None:
        interrupt_on_sigterm()
        printing.print_book(self.site, self.folder)

    def seen(self) -> set[str]:
        return set()

    def result(self) -> tuple:
        return len(PdfReader(self.site / printing.NAME).pages), left(self.folder / "book")


class Reproduce:
    """``experiments.reproduce`` itself, in a copy of the package beside a toy record.

    Of the chapters that the copy imports one is the toy, and the others are empty.
    """

    cells = tuple(Cell("slow", size) for size in (1, 2, 3))
    seeds = range(5)

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.reproduced = folder / "data" / "reproduced"
        package = folder / "notebooks" / "experiments"
        shutil.copytree(ROOT / "notebooks" / "experiments", package)
        for name, text in CHAPTERS.items():
            (package / name).write_text(text)
        places = Places(folder / "tables", folder / "policies", folder / "checkpoints")
        for name in ("trained", "played"):
            store = Store(folder / "data" / "results" / "lqr", name)
            experiment = toy_chapter.EXPERIMENTS[name].at(places)
            store.fill(experiment, self.cells, self.seeds, num_workers=1)

    def begin(self) -> None:
        shutil.rmtree(self.reproduced, ignore_errors=True)

    def run(self) -> None:
        paths = [str(self.folder / "notebooks"), *sys.path]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
        os.execve(sys.executable, [sys.executable, "-m", "experiments.reproduce"], environment)

    def seen(self) -> set[tuple[str, str]]:
        names = ("trained", "played")
        return {(name, row) for name in names for row in lines(self.reproduced / "lqr", name)}

    def result(self) -> set[tuple[str, str]]:
        return self.seen()
