"""The paper's numbers, in ``data/paper/``. They were carried by hand, once.

No run can bring them back, so each file is held against its digest in ``SHA256SUMS``, of the form
that ``sha256sum --check`` reads.
"""

from __future__ import annotations

import hashlib
import io
from pathlib import Path

import pandas as pd

from experiments.origin import ROOT
from experiments.sealed import DamagedError

PAPER = ROOT / "data" / "paper"


def read_paper(name: str, folder: Path = PAPER) -> pd.DataFrame:
    """The table ``folder/name.csv``; domains are words, as in all rows.

    Raises:
        DamagedError: a file that is not as it was recorded.
    """
    path, sums = folder / f"{name}.csv", folder / "SHA256SUMS"
    content = path.read_bytes()
    line = f"{hashlib.sha256(content).hexdigest()}  {path.name}"
    if line.encode() not in sums.read_bytes().splitlines():
        raise DamagedError(
            f"{path}: is not as {sums.name} beside it has it; restore it, or record a correction "
            f"there: {line}"
        )
    return pd.read_csv(io.BytesIO(content), dtype={"domain": str})
