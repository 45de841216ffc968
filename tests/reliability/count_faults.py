"""Counts what faults do to sweeps, trainings, builds, reproductions and files.

    python tests/reliability/count_faults.py [--tries 1.0] [--json PATH] [kills ...]

Moments, bits and places are random, by a seed that is recorded. With names only those kinds of
fault are tried, and their rows replaced in the file.
"""

from __future__ import annotations

import argparse
import datetime
import math
import sys
import zlib
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

TESTS = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(TESTS), str(TESTS.parent / "book")]

import damaged  # noqa: E402
import disturbed  # noqa: E402
import numpy as np  # noqa: E402
from faults import count  # noqa: E402

from experiments.origin import commit, machine  # noqa: E402
from experiments.sealed import read_record, write_record  # noqa: E402

SEED = 20261127
KINDS = disturbed.KINDS | damaged.KINDS  # by name: rows of (fault, where, tries, outcomes)


def rows(kind: str, tries: float) -> Iterator[dict[str, Any]]:
    """The table's rows of one kind of fault, with so many times the usual tries, at least one."""
    today = datetime.datetime.now(datetime.UTC).date()
    for fault, where, num, outcomes in KINDS[kind]:
        generator = np.random.default_rng([SEED, zlib.crc32(f"{kind} {where}".encode())])
        with TemporaryDirectory() as scratch:
            found = list(outcomes(Path(scratch) / "job", generator, math.ceil(num * tries)))
        made = {"commit": commit(), "date": today.isoformat(), "machine": machine()}
        yield {**count(fault, where, found), **made}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("kinds", nargs="*", metavar="kind", help=f"of {', '.join(KINDS)}")
    parser.add_argument("--tries", type=float, default=1.0, help="times the usual number")
    parser.add_argument("--json", type=Path, metavar="PATH", help="write the counts there, too")
    options = parser.parse_args()
    if unknown := set(options.kinds) - KINDS.keys():
        parser.error(f"no kind of fault is called {', '.join(sorted(unknown))}")
    for kind in options.kinds or KINDS:
        for row in rows(kind, options.tries):
            print(", ".join(f"{key} {value}" for key, value in row.items()), flush=True)
            if options.json:
                keep(options.json, row)


def keep(path: Path, row: dict[str, Any]) -> None:
    """Put a row in the file, in the place of the one of the same fault and place."""
    record = read_record(path) if path.exists() else {"rows": []}
    found = {(r["fault"], r["where"]): r for r in [*record["rows"], row]}
    order = [(fault, where) for parts in KINDS.values() for fault, where, *_ in parts]
    write_record(path, {"seed": SEED, "rows": [found[key] for key in order if key in found]})


if __name__ == "__main__":
    main()
