"""Rows that are put into a store without an experiment, for tests of what reads them."""

from pathlib import Path

import pandas as pd

from experiments.files import replace_text
from experiments.store import Store, digest


def store_rows(data: Path, name: str, rows: pd.DataFrame) -> None:
    """Write ``data/results/<name>.csv`` and a record in which all rows are one batch."""
    chapter, _, file = name.partition("/")
    store = Store(data / "results" / chapter, file)
    store.folder.mkdir(parents=True, exist_ok=True)
    rows = rows.astype({"domain": str})
    batch = {
        **{"columns": {}, "cell": {}, "run": "by hand", "options": {}, "reads": {}},
        "seeds": sorted(rows["run"].unique().tolist()),
        "num_rows": len(rows),
        "sha256": digest(rows),
    }
    replace_text(store.csv, rows.to_csv(index=False))
    store.write_record(rows, [batch])
