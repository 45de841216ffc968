"""Decides every claim of the paper from the rows in ``data/``, and writes the tables of the book.

``python book/claims.py`` prints the verdicts. The claims, their place in the paper and their
settings are in ``data/claims.yml``; the rules that decide them are in ``rules.py``.
"""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import yaml

from experiments.paper import read_paper
from experiments.store import Store
from rules import IN_PART, NO_DATA, NOT_SUPPORTED, REPRODUCED, RULES, Cells, Finding, NoData

DATA = Path(__file__).resolve().parent.parent / "data"
ROW_COLUMNS = ["method", "run", "domain", "metric", "value"]
VERDICTS = (REPRODUCED, IN_PART, NOT_SUPPORTED, NO_DATA)
BADGES = {REPRODUCED: "success", IN_PART: "warning", NOT_SUPPORTED: "danger", NO_DATA: "secondary"}


# --- data -----------------------------------------------------------------------------------------


def load_cells(results: list[str], chapter: dict, data: Path = DATA) -> Cells:
    """The rows of all named results together; a file that is not there has no rows."""
    columns = [*ROW_COLUMNS, *chapter["columns"]]
    frames = []
    for name in results:
        folder, _, file = name.partition("/")
        rows = Store(data / "results" / folder, file).rows()
        if len(rows):
            frames.append(rows)
            if missing := set(columns) - set(rows.columns):
                raise ValueError(f"{name}: no column {sorted(missing)}")
    rows = pd.concat(frames) if frames else pd.DataFrame(columns=columns)
    return Cells(rows, chapter["num_runs"])


def load_paper(name: str, data: Path = DATA) -> pd.DataFrame:
    """The paper's means; what stands in two of its tables is kept once."""
    table = read_paper(name, data / "paper")
    return table.drop(columns="table", errors="ignore").drop_duplicates()


# --- verdicts ------------------------------------------------------------------------------------


def read_claims(data: Path = DATA) -> dict:
    path = data / "claims.yml"
    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: cannot be read: {error}") from error


def decide(claim: dict, book: dict, data: Path = DATA) -> Finding:
    """The verdict on one claim."""
    chapter = book["chapters"][claim["chapter"]]
    cells = load_cells(claim["results"], chapter, data)
    paper = load_paper(claim["chapter"], data)
    try:
        return RULES[claim["rule"]](cells, paper, **claim["settings"])
    except NoData as missing:
        return Finding(NO_DATA, str(missing))


def decide_all(data: Path = DATA) -> dict[str, Finding]:
    book = read_claims(data)
    return {claim["id"]: decide(claim, book, data) for claim in book["claims"]}


# --- pages ---------------------------------------------------------------------------------------


def write_fragments(folder: Path, data: Path = DATA) -> None:
    """Writes ``_generated/found.md`` and ``_generated/claims.md`` under ``folder``."""
    book, findings = read_claims(data), decide_all(data)
    target = Path(folder) / "_generated"
    target.mkdir(parents=True, exist_ok=True)
    (target / "found.md").write_text(overview(book, findings, data), encoding="utf-8")
    (target / "claims.md").write_text(full_list(book, findings), encoding="utf-8")


def overview(book: dict, findings: dict[str, Finding], data: Path = DATA) -> str:
    """One row per chapter: what is claimed, the paper's numbers, ours, the verdicts."""
    lines = [
        ":::{table}",
        ":class: found",
        "",
        "| The paper claims | Numbers | Paper | Here | Verdicts |",
        "|:--|:--|--:|--:|:--|",
    ]
    for key, chapter in book["chapters"].items():
        claims = [claim for claim in book["claims"] if claim["chapter"] == key]
        results = sorted({name for claim in claims for name in claim["results"]})
        cells = load_cells(results, chapter, data)
        paper = load_paper(key, data)
        numbers = [(f"*{chapter['measure']}*", "&nbsp;", "&nbsp;")]
        numbers += [headline(entry, chapter, cells, paper) for entry in chapter["headline"]]
        labels, theirs, ours = ("<br>".join(column) for column in zip(*numbers, strict=True))
        verdicts = "<br>".join(tally([findings[claim["id"]].verdict for claim in claims]))
        lines.append(
            f"| {{doc}}`{chapter['title']} <{key}>`<br>{chapter['claim']} | {labels} | {theirs} "
            f"| {ours} | {verdicts} |"
        )
    return "\n".join([*lines, ":::"]) + "\n"


def headline(entry: dict, chapter: dict, cells: Cells, paper: pd.DataFrame) -> tuple[str, str, str]:
    """Label, the paper's number and ours; a dash where there is none."""
    digits = chapter["digits"]
    try:
        ours = f"{cells.runs(**chapter['measured'], **entry['cell']).mean():.{digits}f}"
    except NoData:
        ours = "–"
    theirs = Cells(paper, num_runs=1).select(**entry["paper"])
    return entry["label"], f"{theirs['mean'].item():.{digits}f}" if entry["paper"] else "–", ours


def tally(verdicts: list[str]) -> list[str]:
    """How often each verdict fell, as badges."""
    return [
        f"{{bdg-{BADGES[verdict]}}}`{verdicts.count(verdict)} {verdict}`"
        for verdict in VERDICTS
        if verdict in verdicts
    ]


def full_list(book: dict, findings: dict[str, Finding]) -> str:
    """Every claim with its place in the paper, the verdict and what it rests on."""
    parts = []
    for key, chapter in book["chapters"].items():
        parts.append(f"## {chapter['title']}\n")
        for claim in (claim for claim in book["claims"] if claim["chapter"] == key):
            finding = findings[claim["id"]]
            sources = ", ".join(f"`data/results/{name}.csv`" for name in claim["results"])
            parts.append(
                f"({claim['id']})=\n"
                f"### {claim['title']}\n\n"
                f"{{bdg-{BADGES[finding.verdict]}}}`{finding.verdict}`\n\n"
                f"*The paper claims* ({claim['where']}): {claim['claim']}\n\n"
                f"*We test:* {claim['test']}\n\n"
                f"*We find:* {finding.evidence}.\n\n"
                f"*Decided by* `{claim['rule']}` *from* {sources}.\n"
            )
    return "\n".join(parts)


def main() -> None:
    for name, finding in decide_all().items():
        print(f"{name:34s} {finding.verdict:20s} {finding.evidence}")


if __name__ == "__main__":
    main()
