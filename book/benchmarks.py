"""The table of speed and returns in your own domains, from what `tests/bench` has recorded."""

from __future__ import annotations

from experiments.registry import DATA
from experiments.sealed import read_record

RECORD = DATA / "bench" / "own_domains.json"


def overview() -> str:
    record = read_record(RECORD)
    heads = ["Environment", "Learner", "Frames", "Frames per CPU second", "Return"]
    lines = [f"| {' | '.join(heads)} |", "|:--|:--|--:|--:|--:|"]
    for row in record["rows"]:
        frames, speed = f"{row['frames']:,}", f"{row['frames_per_cpu_second']:,.0f}"
        value = f"{row['return']:,.{2 if abs(row['return']) < 1 else 0}f}"
        lines.append(f"| {row['environment']} | {row['arm']} | {frames} | {speed} | {value} |")
    title = f"Means of {record['num_seeds']} seeds, after as many frames as stand there:"
    return "\n".join([title, "", *lines, ""])
