"""Tables of the book's notebooks, in one style."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from pandas.io.formats.style import Styler

from experiments.store import Store


def show(frame: pd.DataFrame, formats: dict[str, str] | str | None = None) -> Styler:
    """A table without its index; ``formats`` of its numbers, by column."""
    return frame.style.format(formats).hide().set_table_attributes('class="dataframe"')


def mean_and_std(values: pd.Series, digits: int = 1) -> str:
    """Of runs; the standard deviation is that of the paper (ddof 0)."""
    return f"{values.mean():.{digits}f} ± {values.std(ddof=0):.{digits}f}"


def costs(folder: str | Path, names: Sequence[str]) -> Styler:
    """What it took to compute experiments, from the record beside the rows of each."""

    def row(name: str) -> dict[str, object]:
        batches = Store(Path(folder), name).batches()
        return {
            "experiment": name,
            "batches": len(batches),
            "runs": sum(len(batch["seeds"]) for batch in batches),
            "CPU minutes": sum(batch["cpu_seconds"] for batch in batches) / 60,
            "machine": ", ".join(sorted({batch["machine"] for batch in batches})),
            "torch": ", ".join(sorted({batch["versions"]["torch"] for batch in batches})),
            "commit": ", ".join(sorted({batch["commit"] for batch in batches})),
        }

    return show(pd.DataFrame(map(row, names)), {"CPU minutes": "{:.1f}"})


def beside_shipped(live: pd.DataFrame, shipped: pd.DataFrame) -> pd.DataFrame:
    """Live rows with the shipped ones of the same keys, and how far they are apart.

    Raises:
        ValueError: a live row of which none is shipped.
    """
    keys = [column for column in live.columns if column != "value"]
    both = live.rename(columns={"value": "live"}).merge(
        shipped.rename(columns={"value": "shipped"}), on=keys, how="left", validate="one_to_one"
    )
    if both["shipped"].isna().any():
        first = both.loc[both["shipped"].isna(), keys].iloc[0].to_dict()
        raise ValueError(f"shipped: has no row for {first}, must have one for each live row")
    return both.assign(**{"relative difference": (both["live"] / both["shipped"] - 1).abs()})
