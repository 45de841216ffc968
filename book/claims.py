"""Decides every claim of the paper from the rows in ``data/``, and writes the tables of the book.

``python book/claims.py`` prints the verdicts. The claims, their place in the paper and their
settings are in ``data/claims.yml``; here are the rules. A rule gets the cells of our results,
the cells of the paper and its settings, and returns a ``Finding``. It raises ``NoData`` where a
cell that it needs is missing or incomplete.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import scipy.stats
import yaml

DATA = Path(__file__).resolve().parent.parent / "data"
CELL = ["method", "num_domains", "dim_distractor", "optimizer"]
CONFIGURATION = ["num_domains", "dim_distractor"]
RESULT_COLUMNS = [*CELL, "run", "domain", "metric", "value"]

REPRODUCED = "reproduced"
IN_PART = "reproduced in part"
NOT_SUPPORTED = "not supported"
NO_DATA = "no data yet"
VERDICTS = (REPRODUCED, IN_PART, NOT_SUPPORTED, NO_DATA)
BADGES = {REPRODUCED: "success", IN_PART: "warning", NOT_SUPPORTED: "danger", NO_DATA: "secondary"}

NAMES = {
    "gradient_descent": "gradient descent",
    "overparameterized": "overparameterised",
    "ipo_fixed_phi": "IPO, fixed Φ",
    "ipo_variable_phi": "IPO, variable Φ",
    "oracle": "oracle",
}


class NoData(Exception):
    """A cell that a rule needs is missing."""


@dataclass(frozen=True)
class Finding:
    verdict: str
    evidence: str


# --- cells ---------------------------------------------------------------------------------------


class Cells:
    """Test costs by cell (method, number of domains, distractor dimension, optimiser)."""

    def __init__(self, rows: pd.DataFrame, num_runs: int):
        test = rows[(rows.metric == "test_cost") & (rows.domain == "test")]
        self._costs = {
            key: group.drop_duplicates("run").set_index("run")["value"].sort_index()
            for key, group in test.groupby(CELL)
        }
        self._num_runs = num_runs

    def costs(self, method, num_domains, dim_distractor, optimizer="adam") -> pd.Series:
        """Cost of every run, indexed by run."""
        key = (method, num_domains, dim_distractor, optimizer)
        costs = self._costs.get(key, pd.Series(dtype=float))
        if len(costs) < self._num_runs or costs.isna().any():
            raise NoData(
                f"{NAMES.get(method, method)} ({optimizer}) at {num_domains} domains and "
                f"{dim_distractor} distractors: {costs.count()} of {self._num_runs} runs"
            )
        return costs

    def mean(self, method, num_domains, dim_distractor, optimizer="adam") -> float:
        if method == "oracle":
            optimizer = "none"
        return float(self.costs(method, num_domains, dim_distractor, optimizer).mean())


def load_cells(results: list[str], num_runs: int, data: Path = DATA) -> Cells:
    """The rows of all named results together; a file that is not there has no rows."""
    frames = [pd.DataFrame(columns=RESULT_COLUMNS)]
    for name in results:
        path = data / "results" / f"{name}.csv"
        if path.exists():
            frames.append(pd.read_csv(path))
            if missing := set(RESULT_COLUMNS) - set(frames[-1].columns):
                raise ValueError(f"{path}: no column {sorted(missing)}")
    return Cells(pd.concat([frame for frame in frames if len(frame)] or frames), num_runs)


def load_paper(name: str, data: Path = DATA) -> pd.DataFrame:
    """The paper's means; the one configuration that stands in both tables is kept once."""
    table = pd.read_csv(data / "paper" / f"{name}.csv")
    return table.drop_duplicates(["method", *CONFIGURATION])


# --- rules ---------------------------------------------------------------------------------------


def cells_come_back(cells: Cells, paper: pd.DataFrame, tolerance: dict[str, float]) -> Finding:
    """Every mean of the paper within the tolerance of its method."""
    inside, parts = [], []
    for method, bound in tolerance.items():
        rows = paper[paper.method == method]
        apart = [
            abs(cells.mean(method, row.num_domains, row.dim_distractor) - row.mean)
            for row in rows.itertuples(index=False, name="PaperCell")
        ]
        good = [distance <= bound for distance in apart]
        inside += good
        parts.append(
            f"{NAMES[method]}: {sum(good)} of {len(good)} within {bound}, largest difference "
            f"{max(apart):.2f}"
        )
    return Finding(all_some_none(inside), "; ".join(parts))


def lower_everywhere(cells: Cells, paper: pd.DataFrame, method: str, baseline: str) -> Finding:
    """The method's mean is below the baseline's in every configuration of the paper."""
    gaps = {
        configuration: cells.mean(baseline, *configuration) - cells.mean(method, *configuration)
        for configuration in configurations(paper)
    }
    smallest, largest = min(gaps, key=gaps.get), max(gaps, key=gaps.get)
    evidence = (
        f"lower in {sum(gap > 0 for gap in gaps.values())} of {len(gaps)} configurations; by "
        f"{gaps[smallest]:.1f} ({describe(*smallest)}) to {gaps[largest]:.1f} "
        f"({describe(*largest)})"
    )
    return Finding(all_some_none([gap > 0 for gap in gaps.values()]), evidence)


def significantly_lower(
    cells: Cells, paper: pd.DataFrame, methods: list[str], baselines: list[str]
) -> Finding:
    """The 95 % interval of the paired difference over runs lies below zero, in every cell."""
    lower, exceptions = [], []
    for method, baseline, configuration in itertools.product(
        methods, baselines, configurations(paper)
    ):
        difference = cells.costs(method, *configuration) - cells.costs(baseline, *configuration)
        lower.append(upper_end(difference) < 0)
        if not lower[-1]:
            exceptions.append(
                f"{NAMES[method]} is {higher_or_lower(difference.mean())} than {NAMES[baseline]} "
                f"at {describe(*configuration)}"
            )
    theirs = paper_means(paper)
    own = [
        theirs[method, *configuration] < theirs[baseline, *configuration]
        for method, baseline, configuration in itertools.product(
            methods, baselines, configurations(paper)
        )
    ]
    evidence = (
        f"significantly lower in {sum(lower)} of {len(lower)} comparisons of a method with a "
        f"baseline (the paper's own means are lower in {sum(own)})"
    )
    if exceptions:
        evidence += "; the others: " + "; ".join(exceptions)
    return Finding(all_some_none(lower), evidence)


def tends_to_oracle(
    cells: Cells,
    paper: pd.DataFrame,
    method: str,
    dim_distractor: int,
    num_domains: list[int],
    remaining_share: float,
) -> Finding:
    """The gap to the oracle shrinks with every step and ends below a share of the first gap."""
    oracle = cells.mean("oracle", num_domains[0], dim_distractor)
    gaps = [cells.mean(method, number, dim_distractor) - oracle for number in num_domains]
    shrinks = all(after < before for before, after in itertools.pairwise(gaps))
    close = gaps[-1] <= remaining_share * gaps[0]
    evidence = f"gap of {NAMES[method]} to the oracle ({oracle:.1f}): " + "; ".join(
        f"{number} domains {gap:.1f}" for number, gap in zip(num_domains, gaps, strict=True)
    )
    if not shrinks:
        return Finding(NOT_SUPPORTED, evidence)
    return Finding(REPRODUCED if close else IN_PART, evidence)


def gap_survives_plain_steps(
    cells: Cells,
    paper: pd.DataFrame,
    method: str,
    baseline: str,
    dim_distractor: int,
    num_domains: list[int],
    survives: float,
    vanishes: float,
) -> Finding:
    """The advantage under Adam is still there when both methods take plain gradient steps."""
    shares, parts = [], []
    for number in num_domains:
        adam, plain = (
            cells.mean(baseline, number, dim_distractor, optimizer)
            - cells.mean(method, number, dim_distractor, optimizer)
            for optimizer in ("adam", "plain")
        )
        shares.append(plain / adam)
        parts.append(
            f"{number} domains {shown(adam)} with Adam, {shown(plain)} with plain gradient steps"
        )
    evidence = f"{NAMES[baseline]} minus {NAMES[method]}: " + "; ".join(parts)
    if all(share >= survives for share in shares):
        return Finding(REPRODUCED, evidence)
    if all(share <= vanishes for share in shares):
        return Finding(NOT_SUPPORTED, evidence)
    return Finding(IN_PART, evidence)


RULES = {
    rule.__name__: rule
    for rule in (
        cells_come_back,
        lower_everywhere,
        significantly_lower,
        tends_to_oracle,
        gap_survives_plain_steps,
    )
}


def all_some_none(outcomes: list[bool]) -> str:
    if all(outcomes):
        return REPRODUCED
    return IN_PART if any(outcomes) else NOT_SUPPORTED


def configurations(paper: pd.DataFrame) -> list[tuple[int, int]]:
    """The paper's pairs of number of domains and distractor dimension."""
    return list(paper[CONFIGURATION].drop_duplicates().itertuples(index=False, name=None))


def paper_means(paper: pd.DataFrame) -> dict[tuple, float]:
    """Mean by (method, number of domains, distractor dimension)."""
    return paper.set_index(["method", *CONFIGURATION])["mean"].to_dict()


def upper_end(difference: pd.Series) -> float:
    """Upper end of the 95 % Student interval of the mean."""
    error = difference.std(ddof=1) / np.sqrt(len(difference))
    return float(difference.mean() + scipy.stats.t.ppf(0.975, len(difference) - 1) * error)


def shown(number: float) -> str:
    """One decimal, a true minus sign, and no negative zero."""
    return f"{number:z.1f}".replace("-", "−")


def higher_or_lower(difference: float) -> str:
    return f"{abs(difference):.1f} {'higher' if difference > 0 else 'lower'}"


def describe(num_domains: int, dim_distractor: int) -> str:
    return f"{num_domains} domains, {dim_distractor} distractors"


# --- verdicts ------------------------------------------------------------------------------------


def read_claims(data: Path = DATA) -> dict:
    return yaml.safe_load((data / "claims.yml").read_text(encoding="utf-8"))


def decide(claim: dict, book: dict, data: Path = DATA) -> Finding:
    """The verdict on one claim."""
    cells = load_cells(claim["results"], book["num_runs"], data)
    paper = load_paper(book["chapters"][claim["chapter"]]["paper"], data)
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
        cells = load_cells(results, book["num_runs"], data)
        paper = load_paper(chapter["paper"], data)
        numbers = [(f"*{chapter['measure']}*", "&nbsp;", "&nbsp;")]
        numbers += [headline(entry, cells, paper) for entry in chapter["headline"]]
        labels, theirs, ours = ("<br>".join(column) for column in zip(*numbers, strict=True))
        verdicts = "<br>".join(tally([findings[claim["id"]].verdict for claim in claims]))
        lines.append(
            f"| {{doc}}`{chapter['title']} <{key}>`<br>{chapter['claim']} | {labels} | {theirs} "
            f"| {ours} | {verdicts} |"
        )
    return "\n".join([*lines, ":::"]) + "\n"


def headline(entry: dict, cells: Cells, paper: pd.DataFrame) -> tuple[str, str, str]:
    """Label, the paper's number and ours; a dash where there is none."""
    cell = entry["cell"]
    try:
        ours = f"{cells.mean(**cell):.1f}"
    except NoData:
        ours = "–"
    # The paper trained with Adam only.
    if cell["optimizer"] == "plain":
        return entry["label"], "–", ours
    theirs = paper_means(paper)[cell["method"], cell["num_domains"], cell["dim_distractor"]]
    return entry["label"], f"{theirs:.1f}", ours


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
