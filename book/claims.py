"""Decides every claim of the paper from the rows in ``data/``, and writes the tables of the book.

``python book/claims.py`` prints the verdicts. The claims, their place in the paper and their
settings are in ``data/claims.yml``; the rules that decide them are in ``rules.py``.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pandas as pd
import yaml

from experiments.paper import read_paper
from experiments.store import Store
from fragments import write_fragment
from rules import (
    CONTRADICTED,
    EXPLAINED,
    IN_PART,
    NO_DATA,
    REPRODUCED,
    RULES,
    UNDECIDED,
    Cells,
    Finding,
    NoData,
)

DATA = Path(__file__).resolve().parent.parent / "data"
ROW_COLUMNS = ["method", "run", "domain", "metric", "value"]
BADGES = {  # colours of the verdicts, in the order in which they are counted
    REPRODUCED: "success",
    IN_PART: "warning",
    UNDECIDED: "muted",
    EXPLAINED: "info",
    CONTRADICTED: "danger",
    NO_DATA: "light",
}


# --- data -----------------------------------------------------------------------------------------


def read_results(book: dict, data: Path = DATA) -> dict[str, pd.DataFrame]:
    """The rows of every result that a claim names; a file that is not there has none."""
    names = {name for claim in book["claims"] for name in claim["results"]}
    paths = {name: data / "results" / name for name in names}
    return {name: Store(path.parent, path.name).rows() for name, path in paths.items()}


def cells_of(names: list[str], chapter: dict, results: dict[str, pd.DataFrame]) -> Cells:
    """The rows of all named results together; what stands in two of them is that of the last."""
    columns = [*ROW_COLUMNS, *chapter["columns"]]
    frames = {name: results[name] for name in names if len(results[name])}
    for name, rows in frames.items():
        if missing := set(columns) - set(rows.columns):
            raise ValueError(f"{name}: no column {sorted(missing)}")
    if not frames:
        return Cells(pd.DataFrame(columns=columns), chapter["num_runs"])
    rows = pd.concat(frames.values(), ignore_index=True)
    rows = rows.drop_duplicates([name for name in rows if name != "value"], keep="last")
    words = [name for name in rows if rows[name].dtype.kind not in "if"]
    return Cells(rows.astype(dict.fromkeys(words, "category")), chapter["num_runs"])


def load_paper(name: str | None, data: Path = DATA) -> pd.DataFrame:
    """The paper's numbers, if it has some; what stands in two of its tables is kept once."""
    if name is None:
        return pd.DataFrame()
    table = read_paper(name, data / "paper")
    return table.drop(columns="table", errors="ignore").drop_duplicates()


# --- verdicts ------------------------------------------------------------------------------------


def read_claims(data: Path = DATA) -> dict:
    path = data / "claims.yml"
    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: cannot be read: {error}") from error


def decide(claim: dict, book: dict, results: dict[str, pd.DataFrame], data: Path = DATA) -> Finding:
    """The verdict on one claim, and what it would be with other settings of its rule."""
    chapter = book["chapters"][claim["chapter"]]
    columns = claim.get("columns", chapter["columns"])
    cells = cells_of(claim["results"], chapter | {"columns": columns}, results)
    paper = load_paper(claim.get("paper", chapter.get("paper")), data)

    def ruled(**changes: object) -> Finding:
        try:
            return RULES[claim["rule"]](cells, paper, **claim["settings"] | changes)
        except NoData as missing:
            return Finding(NO_DATA, str(missing))

    variants = {name: ruled(**changes) for name, changes in claim.get("variants", {}).items()}
    return replace(ruled(), variants=variants)


def decide_all(
    book: dict, results: dict[str, pd.DataFrame], data: Path = DATA
) -> dict[str, Finding]:
    return {claim["id"]: decide(claim, book, results, data) for claim in book["claims"]}


# --- pages ---------------------------------------------------------------------------------------


def write_fragments(folder: Path, data: Path = DATA) -> None:
    """Writes ``_generated/found.md`` and ``_generated/claims.md`` under ``folder``."""
    book = read_claims(data)
    results = read_results(book, data)
    findings = decide_all(book, results, data)
    numbers = {
        key: headlines(chapter, results, data)
        for key, chapter in book["chapters"].items()
        if "headline" in chapter
    }
    write_fragment(folder, "found", overview(book, findings, numbers))
    write_fragment(folder, "claims", full_list(book, findings))


def overview(
    book: dict, findings: dict[str, Finding], numbers: dict[str, list[tuple[str, str, str]]]
) -> str:
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
        shown = zip(*numbers.get(key, [("–", "–", "–")]), strict=True)
        labels, theirs, ours = ("<br>".join(column) for column in shown)
        verdicts = "<br>".join(tally([findings[claim["id"]].verdict for claim in claims]))
        lines.append(
            f"| {{doc}}`{chapter['title']} <{key}>`<br>{chapter['claim']} | {labels} | {theirs} "
            f"| {ours} | {verdicts} |"
        )
    return "\n".join([*lines, ":::"]) + "\n"


def headlines(
    chapter: dict, results: dict[str, pd.DataFrame], data: Path
) -> list[tuple[str, str, str]]:
    """Labels, the paper's numbers and ours."""
    cells = cells_of(chapter["shown"], chapter, results)
    paper = load_paper(chapter["paper"], data)
    numbers = [headline(entry, chapter, cells, paper) for entry in chapter["headline"]]
    return [(f"*{chapter['measure']}*", "&nbsp;", "&nbsp;"), *numbers]


def headline(entry: dict, chapter: dict, cells: Cells, paper: pd.DataFrame) -> tuple[str, str, str]:
    """Label, the paper's number and ours; a dash where there is none."""
    try:
        ours = f"{cells.runs(**chapter['measured'], **entry['cell']).mean():{chapter['format']}}"
    except NoData:
        ours = "–"
    theirs = "–"
    if entry["paper"]:
        mean = Cells(paper, num_runs=1).select(**entry["paper"])["mean"].item()
        theirs = f"{mean:{chapter['format']}}"
    return entry["label"], theirs, ours


def tally(verdicts: list[str]) -> list[str]:
    """How often each verdict fell, as badges."""
    return [
        badge(verdict, f"{verdicts.count(verdict)} {verdict}")
        for verdict in BADGES
        if verdict in verdicts
    ]


def badge(verdict: str, text: str) -> str:
    return f"{{bdg-{BADGES[verdict]}}}`{text}`"


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
                f"{badge(finding.verdict, finding.verdict)}\n\n"
                f"*The paper claims* ({claim['where']}): {claim['claim']}\n\n"
                f"*We test:* {claim['test']}\n\n"
                f"*We find:* {finding.evidence}.\n\n"
                + (f"*The paper's own table:* {finding.theirs}.\n\n" if finding.theirs else "")
                + f"{sensitivity(finding)}"
                f"*Decided by* `{claim['rule']}` *from* {sources or 'no rows'}.\n"
            )
    return "\n".join(parts)


def sensitivity(finding: Finding) -> str:
    """What the verdict becomes with other choices, as a table; evidence only where it differs."""
    if not finding.variants:
        return ""
    lines = [
        f"| {name} | {badge(own.verdict, own.verdict)} | "
        f"{'as above' if own.evidence == finding.evidence else own.evidence} |"
        for name, own in finding.variants.items()
    ]
    head = "| With another choice | Verdict | We find |\n|:--|:--|:--|\n"
    return head + "\n".join(lines) + "\n\n"


def main() -> None:
    book = read_claims()
    for name, finding in decide_all(book, read_results(book)).items():
        print(f"{name}: {finding.verdict}\n    {finding.evidence}")
        if finding.theirs:
            print(f"    the paper's own table: {finding.theirs}")
        for choice, own in finding.variants.items():
            print(f"    {choice}: {own.verdict}\n        {own.evidence}")


if __name__ == "__main__":
    main()
