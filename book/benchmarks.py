"""The table of speed and returns in your own domains, from what `tests/bench` has recorded."""

from __future__ import annotations

from experiments.registry import DATA
from experiments.sealed import read_record

RECORD = DATA / "bench" / "own_domains.json"


def overview() -> str:
    record = read_record(RECORD)
    lines = ["| Environment | | Frames per CPU second | Return |", "|:--|:--|--:|--:|"]
    for row in record["rows"]:
        speed, value = f"{row['frames_per_cpu_second']:,.0f}", f"{row['return']:,.0f}"
        lines.append(f"| {row['environment']} | {row['arm']} | {speed} | {value} |")
    title = f"After {record['frames']:,} frames; means of {record['num_seeds']} seeds:"
    return "\n".join([title, "", *lines, ""])
