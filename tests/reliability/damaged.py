"""Files that are damaged, a bit at a time, or made to do harm: whether their readers notice."""

from __future__ import annotations

import functools
import io
import json
import pickle
import shutil
import tempfile
import time
import tracemalloc
import warnings
import zipfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch
from faults import HARMLESS, HELD
from jobs import ROOT, Build
from toy_book import in_toy

import claims
import website
from experiments.checkpoints import load_checkpoint, save_checkpoint
from experiments.doors.authors_policies import load_authors_policy
from experiments.paper import read_paper
from experiments.policies import load_policy
from experiments.sealed import DamagedError, read_record, write_sealed
from experiments.store import Store
from experiments.tabulated import load_or_tabulate
from experiments.tensors import read_tensors
from ipo.own_domains import Policy
from ipo.worlds.colored_keys import ColoredKeysEnv
from ipo.worlds.networks import GridNetwork
from messages import BuildError
from profiles import load_notebooks

DATA = ROOT / "data"
Read = Callable[[Path], Any]
MOST_SECONDS, MOST_BYTES = 1.0, 2**25  # that a file may take which is refused


# ------------------------------------------------------------------------------ readers


def read_rows(path: Path) -> tuple:
    store = Store(path.parent, path.stem)
    return store.rows().to_csv(), json.dumps(store.batches())


def read_policy(path: Path) -> str:
    tensors, about = read_tensors(path, "about")
    return repr(({name: tensor.numpy().tobytes() for name, tensor in tensors.items()}, about))


def read_checkpoint(path: Path) -> str:
    return repr(load_checkpoint(path))


def read_own_policy(path: Path) -> str:
    return repr(Policy.load(path))


def read_table(path: Path) -> bytes:
    """The table, whose making anew is a warning."""
    task = load_or_tabulate(ColoredKeysEnv, path.parent, size=5)
    return b"".join(np.asarray(array).tobytes() for array in vars(task).values())


def read_papers(path: Path) -> str:
    return "".join(read_paper(p.stem, p.parent).to_csv() for p in sorted(path.parent.glob("*.csv")))


def read_all_claims(path: Path) -> str:
    return repr(claims.read_claims(path.parent))


def read_executed(path: Path) -> str:
    """A notebook's executed copy or record, where a damaged one is made anew."""
    root = path.parents[3]
    for notebook in load_notebooks(root, path.parent.name, path.parent):
        if not notebook.is_current():
            raise DamagedError(f"{path} is made anew")
    return "current"


def read_site(path: Path) -> str:
    """A page, where a damaged site is built anew."""
    root = next(parent for parent in path.parents if (parent / "_toc.yml").exists())
    with pytest.MonkeyPatch.context() as patch:
        in_toy(patch, root)
        again = mock.Mock(side_effect=BuildError(f"{path} is built anew"))
        patch.setattr(website, "run_jupyter_book", again)
        notebooks = load_notebooks(root, "class", root / "book" / "_executed" / "class")
        website.build_site(root, root / "book" / "_build", notebooks, "class")
    return "current"


# -------------------------------------------------------------------------------- files


def copied(pattern: str, name: str, folder: Path) -> Path:
    """Of the files of a pattern in ``data/``, all copied, the one of that name."""
    folder.mkdir()
    for path in DATA.glob(pattern):
        shutil.copy(path, folder)
    return folder / name


def new_checkpoint(folder: Path) -> Path:
    for number in range(2):
        tree = {"number": number, "weights": torch.arange(50.0) + number}
        save_checkpoint(folder / "c.checkpoint", tree)
    return folder / "c.checkpoint"


def new_table(folder: Path) -> Path:
    load_or_tabulate(ColoredKeysEnv, folder, size=5)
    return next(folder.glob("*.table"))


@functools.cache
def built_book() -> tempfile.TemporaryDirectory:
    """A toy book that is built, once."""
    scratch = tempfile.TemporaryDirectory()
    Build(Path(scratch.name) / "book")
    return scratch


def in_book(name: str, folder: Path) -> Path:
    """A file of a copy of it."""
    shutil.copytree(Path(built_book().name) / "book", folder)
    return folder / "book" / name


# -------------------------------------------------------------------------------- faults


def outcome(read: Read, path: Path, expected: Any) -> str:
    """Whether a reader refuses a file by its name, or gives the same as before."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", UserWarning)  # as a damaged check-point is
            found = read(path)
    except (ValueError, UserWarning, BuildError) as error:
        return HELD if path.stem in str(error) else f"refused without a name: {error!r}"
    except Exception as error:
        return f"not refused, but a crash: {error!r}"
    return HARMLESS if found == expected else "silent"


def flipped(
    make: Callable[[Path], Path], read: Read, folder: Path, generator: np.random.Generator, num: int
) -> Iterator[str]:
    """One bit of the file is changed, anywhere."""
    path = make(folder)
    content, expected = path.read_bytes(), read(path)
    for _ in range(num):
        place, bit = int(generator.integers(len(content))), int(generator.integers(8))
        path.write_bytes(
            content[:place] + bytes([content[place] ^ 1 << bit]) + content[place + 1 :]
        )
        yield outcome(read, path, expected)
        path.write_bytes(content)


class Harm:
    """Unpickled, it makes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple:
        return Path.touch, (self.path,)


def tensors(plain: str, size: int = 1) -> bytes:
    """A few numbers, so many by what their header says, and JSON beside them."""
    entry = {"dtype": "F32", "shape": [size], "data_offsets": [0, 4 * size]}
    beside = dict.fromkeys(("about", "tree", "made_by"), plain)
    header = json.dumps({"__metadata__": beside, "w": entry}).encode()
    return len(header).to_bytes(8, "little") + header + bytes(4)


NO_TENSORS = [
    tensors("{}", 2**40),  # larger than any memory
    tensors("[" * 10**6),
    tensors('["tensor:nowhere"]'),
    (2**62).to_bytes(8, "little"),
]


def claimed(size: int) -> bytes:
    """An array of so many numbers, by what its header says."""
    content = io.BytesIO()
    header = {"descr": "<f8", "fortran_order": False, "shape": (size,)}
    np.lib.format.write_array_header_1_0(content, header)
    return b"\x93NUMPY\x01\x00" + content.getvalue()


def archive(content: bytes) -> bytes:
    """A zip of an array, which is packed as small as can be."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as parts:
        parts.writestr("format.npy", content)
    return file.getvalue()


def objects(harm: Harm) -> bytes:
    """An archive with an array of objects, which are pickled."""
    file = io.BytesIO()
    np.savez(file, format=np.array([harm], dtype=object))
    return file.getvalue()


def hostile(folder: Path, generator: np.random.Generator, num: int) -> Iterator[str]:
    """Files in the place of others, behind the right seal where there is one."""
    folder.mkdir()
    harm = Harm(folder / "harm")
    pickled = pickle.dumps(harm)
    table = new_table(folder / "tables").name
    sealed = [
        (read, name, content)
        for read, name in (
            (partial(load_policy, network=GridNetwork()), "a.safetensors"),
            (read_checkpoint, "a.checkpoint"),
            (read_table, f"tables/{table}"),
        )
        for content in (*NO_TENSORS, pickled, b"")
    ]
    for read, name, content in sealed:
        write_sealed(folder / name, content)
        yield _refused(read, folder / name, harm)
    archives = [archive(claimed(2**31)), archive(bytes(2**28)), objects(harm)]
    plain = [
        (read_policy, "b.safetensors", pickled),
        (read_checkpoint, "b.checkpoint", pickled),
        (read_table, f"tables/{table}", pickled),
        (load_authors_policy, "authors.pt", pickled),
        *((read_own_policy, "own.npz", c) for c in (*archives, pickled, b"")),
        (read_rows, "rows.json", pickled),
        (read_rows, "rows.json", b"[" * 10**6),
        (read_record, "confirmed.json", b'{"a":' * 10**6),
        (read_all_claims, "claims.yml", f"!!python/object/apply:os.mkdir [{harm.path}]".encode()),
    ]
    for read, name, content in plain:
        (folder / name).write_bytes(content)
        yield _refused(read, folder / name, harm)
    copied(ROWS, "linear.csv", folder / "results")
    endless = {name: read for read, name, _ in (*sealed, *plain[:-1])}  # claims.yml is ours
    for name, read in (endless | {"results/linear.csv": read_rows}).items():
        (folder / name).unlink()
        (folder / name).symlink_to("/dev/zero")
        yield _refused(read, folder / name, harm)


def _refused(read: Read, path: Path, harm: Harm) -> str:
    """Whether a reader refuses a file at once, without the memory that it is to take."""
    tracemalloc.start()
    began = time.monotonic()
    found = outcome(read, path, expected=None)
    seconds, (_, most) = time.monotonic() - began, tracemalloc.get_traced_memory()
    tracemalloc.stop()
    if harm.path.exists():
        return "its code was executed"
    if seconds > MOST_SECONDS or most > MOST_BYTES:
        return f"took {seconds:.1f} s and {most} bytes: {found}"
    return found


def flips(where: str, make: Callable[[Path], Path], read: Read, num: int = 60) -> tuple:
    return "a bit flips", where, num, partial(flipped, make, read)


ROWS, WITNESS = "results/causality/linear.*", "witness/lqr/tables.*"
POLICY = "ppo_red+green_none_5.safetensors"
KINDS = {
    "bits": [
        flips("results, rows", partial(copied, ROWS, "linear.csv"), read_rows),
        flips("results, origin", partial(copied, ROWS, "linear.json"), read_rows),
        flips("witness, rows", partial(copied, WITNESS, "tables.csv"), read_rows),
        flips("witness, origin", partial(copied, WITNESS, "tables.json"), read_rows),
        flips("policy", partial(copied, f"policies/keys/{POLICY}", POLICY), read_policy),
        flips("check-point", new_checkpoint, read_checkpoint),
        flips("table of a task", new_table, read_table),
        flips("the paper's numbers", partial(copied, "paper/*", "lqr.csv"), read_papers),
        flips("their digests", partial(copied, "paper/*", "SHA256SUMS"), read_papers),
        flips("confirmations", partial(copied, "confirmed.json", "confirmed.json"), read_record),
        flips("benchmarks", partial(copied, "bench/lqr.json", "lqr.json"), read_record),
    ],
    "bits of a book": [
        flips("executed notebook", partial(in_book, "_executed/class/plain.ipynb"), read_executed),
        flips("its record", partial(in_book, "_executed/class/plain.json"), read_executed),
        flips("page", partial(in_book, "_build/html/plain.html"), read_site),
    ],
    "bits without a seal": [
        flips("`claims.yml`", partial(copied, "claims.yml", "claims.yml"), read_all_claims),
    ],
    "hostile files": [("made to do harm", "files of all kinds", 20, hostile)],
}
