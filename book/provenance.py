"""The table of where the rows come from, when they were witnessed and what was confirmed."""

from __future__ import annotations

from collections import Counter

from experiments.confirm import confirmed, title
from experiments.registry import CHAPTERS, DATA
from experiments.store import Batch, Store
from experiments.witness import WITNESS, Slice


def overview() -> str:
    header = ["Rows", "Batches", "CPU minutes", "Computed at", "Slices", "Full batches"]
    lines = ["| " + " | ".join(header) + " |", "|:--|--:|--:|:--|:--|:--|"]
    for chapter, experiments in CHAPTERS.items():
        for name in experiments:
            batches = Store(DATA / "results" / chapter, name).batches()
            if batches:
                cells = [
                    f"`{chapter}/{name}`",
                    str(len(batches)),
                    f"{sum(batch['cpu_seconds'] for batch in batches) / 60:.1f}",
                    commits(batch["commit"] for batch in batches),
                    slices(chapter, name),
                    full(chapter, name, batches),
                ]
                lines.append("| " + " | ".join(cells) + " |")
    return "\n".join([*lines, "", *different()]) + "\n"


def different() -> list[str]:
    """A line for every cell that came out otherwise, and by how much at most."""
    return [
        f"- `{cell}` differs: {outcome['apart']}."
        for cell, outcome in confirmed().items()
        if outcome["how"] == "differs"
    ]


def slices(chapter: str, name: str) -> str:
    """How many slices of an experiment are recorded, and of which commit."""
    batches = Store(WITNESS / chapter, name).batches()
    if not batches:
        return "those of cells of the same kind"
    return f"{len(batches)} of {commits(batch['commit'] for batch in batches)}"


def full(chapter: str, name: str, batches: list[Batch]) -> str:
    """How many cells of an experiment were computed again in full, with which outcome."""
    titles = {title(Slice(chapter, name, batch)) for batch in batches}
    record = confirmed()
    found = [record[cell] for cell in titles if cell in record]
    if not found:
        return f"0 of {len(titles)} cells"
    kinds = Counter((outcome["how"], outcome["machine"]) for outcome in found)
    counted = ", ".join(
        f"{count} {how} on {machine}" for (how, machine), count in sorted(kinds.items())
    )
    return (
        f"{len(found)} of {len(titles)} cells: {counted}; at "
        f"{commits(outcome['commit'] for outcome in found)}"
    )


def commits(names) -> str:
    """Short names; a plus stays, which says that the code had changes of its own."""
    short = {name[:7] + "+" * name.endswith("+") for name in names}
    return ", ".join(f"`{name}`" for name in sorted(short))
