"""The table of faults and of what they did, as `tests/reliability` has counted it."""

from __future__ import annotations

import pandas as pd

from costs import in_markdown
from experiments.registry import DATA
from experiments.sealed import read_record
from provenance import commits

RECORD = DATA / "bench" / "reliability.json"
COLUMNS = {"fault": "Fault", "where": "In", "tried": "Tried"} | {
    name: name.capitalize() for name in ("held", "harmless", "lost")
}


def overview() -> str:
    record = read_record(RECORD)
    rows = pd.DataFrame(record["rows"])
    counted = (
        f"Counted at {commits(rows['commit'])}, {rows['date'].max()}, {rows['machine'].iloc[-1]}, "
        f"seed {record['seed']}:"
    )
    table = in_markdown(rows[list(COLUMNS)].rename(columns=COLUMNS).astype(str), num_words=2)
    return f"{counted}\n\n{table}\n"
