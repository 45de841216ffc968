"""The first page's sentences and its picture, made from verdicts and rows."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pandas as pd

import claims
from experiments import figures
from experiments.cue import outcomes, training
from experiments.figures import Advantage
from experiments.store import Store
from fragments import write_fragment
from rules import Cells, NoData
from rules.verdicts import compare

PICTURE = "advantages.svg"
FIRST = "many_steps"  # of the maze: what the first predictions were tested with


def write_fragments(folder: Path, data: Path = claims.DATA) -> None:
    """Writes ``_generated/finding.md`` and the picture that it shows under ``folder``."""
    book = claims.read_claims(data)
    text = f"{finding(book, data)} {maze(data)}".rstrip()
    if shown := list(advantages(book, data)):
        picture = folder / "_generated" / PICTURE
        picture.parent.mkdir(parents=True, exist_ok=True)
        figures.save(figures.draw_advantages(shown), picture)
        text += f"\n```{{image}} _generated/{PICTURE}\n:alt: {in_words(shown)}\n```\n"
    write_fragment(folder, "finding", text)


def finding(book: dict, data: Path = claims.DATA) -> str:
    """Two sentences: what each says depends on the verdicts."""
    sentences = (
        "; ".join(clause(part, book, data) for part in sentence) for sentence in book["sentences"]
    )
    return " ".join(f"{sentence[0].upper()}{sentence[1:]}." for sentence in sentences)


def clause(part: dict, book: dict, data: Path) -> str:
    """What a verdict means, in words; where nobody foresaw it, the question and the verdict."""
    claim = part.get("claim")
    decided = next(own for own in book["claims"] if own["id"] == claim) if claim else part
    results = claims.read_results({"claims": [decided]}, data)
    verdict = claims.decide(decided, book, results, data).verdict
    return part["says"].get(verdict, f"whether {part['question']}: {verdict}")


def maze(data: Path = claims.DATA) -> str:
    """At how many points of the maze the game helps and harms, of those where theory says so."""
    phases = beside_theory(list(training.PHASES.values()), data)
    first = beside_theory([FIRST], data)
    if not phases or not first:
        return ""
    return (
        "In {doc}`a maze where domains disagree <cue>`, IPO beats PPO in "
        f"{phases['better']} cases where theory predicts it (first round: {first['better']}), and "
        f"loses in {phases['worse']}."
    )


def beside_theory(names: list[str], data: Path) -> dict[str, str]:
    """By what was predicted of IPO against PPO: how often it came out so; nothing without rows."""
    rows = pd.concat([Store(data / "results" / "cue", name).rows() for name in names])
    if rows.empty:
        return {}
    found = outcomes.differences(outcomes.by_run(rows), ["ppo"])
    [counts] = outcomes.difference_counts(outcomes.with_predictions(found)).to_dict("records")
    return {
        sign: f"{counts[f'… came out {sign}']} of {counts[f'predicted {sign}']}"
        for sign in ("better", "worse")
    }


def advantages(book: dict, data: Path = claims.DATA) -> Iterator[Advantage]:
    """How much better IPO is than another arm, in units of what the paper reports."""
    for row in book["picture"]:
        chapter = book["chapters"][row["chapter"]]
        results = claims.read_results({"claims": [row]}, data)
        cells = claims.cells_of(row["results"], chapter, results)
        paper = Cells(claims.load_paper(chapter["paper"], data), num_runs=1)
        sign = -1 if row.get("lower_is_better") else 1
        try:
            ours, other = (
                sign * sum(cells.runs(**place, **row["common"], **arm) for place in row["places"])
                for arm in row["arms"]
            )
        except NoData:
            continue
        theirs = [
            sum(paper.select(**place, method=m)["mean"].item() for place in row["paper_places"])
            for m in row["paper"]
        ]
        unit = sign * (theirs[0] - theirs[1])
        mean, low, high, _ = compare(ours, other).difference
        yield Advantage(row["label"], mean / unit, low / unit, high / unit)


def in_words(shown: list[Advantage]) -> str:
    """The picture for those who do not see it."""
    rows = "; ".join(
        f"{row.label} {row.mean:z.1f}, from {row.low:z.1f} to {row.high:z.1f}" for row in shown
    )
    return f"Advantage of IPO, where the paper's is 1, with 95 % intervals: {rows}."
