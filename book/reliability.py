"""The table of faults and of what they did, as `tests/reliability` has counted it."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from costs import in_markdown
from experiments.registry import DATA
from experiments.sealed import read_record
from provenance import commits

RECORD = DATA / "bench" / "reliability.json"
COLUMNS = {"fault": "Fault", "where": "In", "tried": "Tried"} | {
    name: name.capitalize() for name in ("held", "harmless", "lost")
}


def write_fragment(folder: Path) -> None:
    """Writes ``_generated/reliability.md`` under ``folder``."""
    target = Path(folder) / "_generated"
    target.mkdir(parents=True, exist_ok=True)
    (target / "reliability.md").write_text(overview(), encoding="utf-8")


def overview() -> str:
    record = read_record(RECORD)
    rows = pd.DataFrame(record["rows"])
    counted = (
        f"Counted at {commits(rows['commit'])}, {rows['date'].max()}, {rows['machine'].iloc[-1]}, "
        f"seed {record['seed']}:"
    )
    table = in_markdown(rows[list(COLUMNS)].rename(columns=COLUMNS).astype(str), num_words=2)
    return f"{counted}\n\n{table}\n"
