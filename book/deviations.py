"""Where text, programs and this book differ, and what it does to the result."""

from __future__ import annotations

import yaml

from experiments.registry import DATA
from fairness import row
from measured import listed

COLUMNS = {
    "what": "",
    "text": "The paper's text",
    "programs": "Its programs",
    "here": "Here",
    "effect": "What it does",
}


def tables() -> str:
    """A table for each problem."""
    deviations, problems = (
        yaml.safe_load((DATA / f"{name}.yml").read_text(encoding="utf-8"))
        for name in ("deviations", "fairness")
    )
    parts = []
    for name, own in deviations.items():
        problem = problems["problems"][name]
        lines = [f"### {problem['title']}", "", ":::{table}", ":class: fairness", ""]
        lines += [row(list(COLUMNS.values())), row([":--"] * len(COLUMNS))]
        for entry in own:
            first = [f"**{entry['what']}**", entry["text"], entry["programs"], entry["here"]]
            lines.append(row([*first, effect(problem, entry)]))
        parts.append("\n".join([*lines, ":::"]))
    return "\n\n".join(parts) + "\n"


def effect(problem: dict, entry: dict) -> str:
    """In words, by what was measured, and where to read on."""
    words = [entry["effect"]] if "effect" in entry else []
    return "<br>".join([*words, *listed(problem, entry), f"{{ref}}`{entry['see']}`"])
