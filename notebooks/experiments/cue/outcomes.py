"""What the arms of the cued maze come to, beside what was predicted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from experiments.cue import theory
from experiments.cue.theory import CUE_WINS, LANDMARK_WINS, NEITHER
from ipo.stats import holm, paired_difference
from ipo.worlds.cued_maze import LANDMARK

NAMES = {
    "ppo": "PPO",
    "in_turn": "one network, one domain at a time",
    "ensemble": "ensemble, pooled data",
    "ipo": "IPO",
    "vrex": "V-REx",
}
BASELINES = ("ppo", "in_turn", "ensemble")  # that IPO is compared with
MARGIN = 0.1  # a difference of returns that counts
HALF = LANDMARK / 2  # between the returns of following landmark and cue where the cue is wrong
INFORMED = (0.5 + LANDMARK) / 2  # between chance and the landmark, where the cue says nothing


def by_run(rows: pd.DataFrame) -> pd.DataFrame:
    """What runs are judged by: a line for each run with three columns.

    A return is linear in the cue, so those at both extremes tell everything: ``worst`` is the
    return in the worst of *all* domains, ``plain`` that without a cue, ``use`` what the cue adds.
    """
    values = {"domain", "metric", "value"}
    places = [column for column in rows.columns if column not in values]
    wide = rows.pivot(index=sorted(places), columns="domain", values="value")
    wrong, right = wide["-1"], wide["1"]
    worst, plain = np.minimum(wrong, right), (wrong + right) / 2
    return pd.DataFrame({"worst": worst, "plain": plain, "use": right - wrong})


def name_of(method: str) -> str:
    """As readers know it, with the weight of the penalty if the method of the rows has one."""
    plain, _, penalty = method.partition("vrex_")
    return f"{NAMES['vrex']}, weight {penalty}" if penalty else NAMES[plain]


def with_chosen_penalty(runs: pd.DataFrame) -> pd.DataFrame:
    """The same with V-REx once: with the penalty that the training domains of a point choose."""
    flat = runs.reset_index()
    penalised = flat["method"].str.startswith("vrex_")
    parts = [flat[~penalised]]
    for (_, cues), own in flat[penalised].groupby(["encoding", "cues"]):
        strengths = [float(c) for c in cues.split()]
        spreads = {
            int(method.removeprefix("vrex_")): theory.spread(strengths, use)
            for method, use in own.groupby("method")["use"].mean().items()
        }
        chosen = f"vrex_{theory.chosen_penalty(spreads)}"
        parts.append(own[own["method"] == chosen].assign(method="vrex"))
    return pd.concat(parts).set_index(runs.index.names)


def _means(runs: pd.DataFrame) -> pd.DataFrame:
    return runs.groupby(level=["encoding", "cues", "method"]).mean()


def in_training(runs: pd.DataFrame) -> pd.Series:
    """Mean return in the training domains, of every arm at every point."""
    mean = _means(runs)
    cues = [
        np.mean([float(c) for c in text.split()]) for text in mean.index.get_level_values("cues")
    ]
    return mean["plain"] + np.array(cues) * mean["use"] / 2


def follows(worst: float, plain: float) -> str:
    """What the policies of an arm follow at a point, by their mean returns."""
    if worst < HALF:
        return CUE_WINS
    return LANDMARK_WINS if plain >= INFORMED else NEITHER


def outcomes(runs: pd.DataFrame) -> pd.Series:
    """:func:`follows` of every arm and point."""
    mean = _means(runs)
    return mean.apply(lambda line: follows(line["worst"], line["plain"]), axis=1)


def beside_predictions(runs: pd.DataFrame) -> pd.DataFrame:
    """What the rules say, and what came out, for every arm and point that was run."""
    found = outcomes(runs)
    predicted = [theory.predicted(*key) for key in found.index]
    return pd.DataFrame({"predicted": predicted, "found": found})


def predicted_difference(ipo: str, other: str) -> str:
    """Of the return in the worst domain, IPO's minus another's, from what they follow."""
    order = (CUE_WINS, NEITHER, LANDMARK_WINS)
    gained = order.index(ipo) - order.index(other)
    return "better" if gained > 0 else "worse" if gained < 0 else "alike"


def differences(runs: pd.DataFrame, baselines: Sequence[str]) -> pd.DataFrame:
    """IPO minus each baseline in the worst domain, at every point, paired by run.

    A difference counts if it is MARGIN or more and its p, by Holm's method over all of these, is
    below 5 %.
    """
    worst = runs["worst"].unstack("method")
    found = pd.DataFrame(
        {"encoding": encoding, "cues": cues, "baseline": baseline}
        | paired_difference(own["ipo"], own[baseline])._asdict()
        for (encoding, cues), own in worst.groupby(level=["encoding", "cues"])
        for baseline in baselines
    )
    counts = (np.array(holm(found["p"].tolist())) < 0.05) & (found["mean"].abs() >= MARGIN)
    sign = np.where(found["mean"] > 0, "better", "worse")
    return found.assign(verdict=np.where(counts, sign, "alike"))


# ---------------------------------------------------------------------------------- as tables


def score(compared: pd.DataFrame) -> pd.DataFrame:
    """A line for each method: of how many points what was predicted came out."""
    right = compared["predicted"] == compared["found"]
    follows = {
        f"{sign}: {column}": (compared[column] == sign)
        for sign in (LANDMARK_WINS, CUE_WINS, NEITHER)
        for column in ("predicted", "found")
    }
    each = (
        pd.DataFrame({"points": 1, "as predicted": right, **follows}).groupby(level="method").sum()
    )
    return each.reindex([m for m in NAMES if m in each.index]).rename(index=NAMES).reset_index()


def with_predictions(found: pd.DataFrame) -> pd.DataFrame:
    """:func:`differences` with what was predicted of each."""
    predicted = [
        predicted_difference(*(theory.predicted(encoding, cues, m) for m in ("ipo", baseline)))
        for encoding, cues, baseline in found[["encoding", "cues", "baseline"]].itertuples(
            index=False
        )
    ]
    return found.assign(predicted=predicted)


def difference_counts(found: pd.DataFrame) -> pd.DataFrame:
    """For each baseline: how many points were predicted to be what, and how many came out so."""
    lines = []
    for baseline, own in found.groupby("baseline", sort=False):
        line: dict[str, object] = {"IPO against": NAMES[baseline]}
        for verdict in ("better", "worse", "alike"):
            predicted = own[own["predicted"] == verdict]
            came = (predicted["verdict"] == verdict).sum()
            line[f"predicted {verdict}"] = len(predicted)
            line[f"… came out {verdict}"] = came
            line[f"{verdict}, not predicted"] = (own["verdict"] == verdict).sum() - came
        lines.append(line)
    return pd.DataFrame(lines)


def mean_by_method(runs: pd.DataFrame) -> pd.DataFrame:
    """Mean return in the worst domain: a line for each point, a column for each method by name."""
    mean = runs["worst"].groupby(level=["cues", "method"]).mean().unstack()
    return mean.rename(columns=NAMES).reset_index()


def point(line: pd.Series) -> dict[str, object]:
    """What is told of one comparison: its cues, their mean, and the difference; nothing of none."""
    if line.empty:
        return {"cues": "none", "cue": np.nan, "mean": np.nan, "interval": "none"}
    return {
        "cues": line["cues"].replace(" ", ", "),
        "cue": np.mean([float(c) for c in line["cues"].split()]),
        "mean": line["mean"],
        "interval": f"[{line['low']:+.2f}, {line['high']:+.2f}]",
    }


def notable(found: pd.DataFrame, shown: Sequence[str]) -> pd.DataFrame:
    """The lines in which IPO was predicted, or found, to differ, with some columns of means."""
    own = found[(found[["predicted", "verdict"]] != "alike").any(axis=1)]
    interval = [
        f"[{low:+.3f}, {high:+.3f}]" for low, high in zip(own["low"], own["high"], strict=True)
    ]
    return pd.DataFrame(
        {
            "cues": own["cues"].str.replace("-", "−"),
            **{name: own[name].map("{:.2f}".format) for name in shown},
            "difference": own["mean"].map("{:+.3f}".format).str.replace("-", "−"),
            "95 % interval": [text.replace("-", "−") for text in interval],
            "predicted": own["predicted"],
            "found": own["verdict"],
        }
    )
