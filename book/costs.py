"""What it costs to compute every row from nothing, by the record beside the shipped rows."""

from __future__ import annotations

from itertools import groupby

import pandas as pd

from experiments.registry import CHAPTERS, DATA
from experiments.reproduce import cost, recorded, wall_seconds
from experiments.sealed import read_record

CORES = (1, 2, 4, 8, 16, 32, 64)
SCALING = DATA / "bench" / "scaling.json"


def overview() -> str:
    """Both tables, with what lies between them in words."""
    bench = read_record(SCALING)
    text = [core_hours(), scaling(bench), wall_hours(bench), limits(bench)]
    return "\n\n".join(text) + "\n"


def core_hours() -> str:
    """A table of experiments, with the sum of each chapter and of all."""
    everything = [part for wave in recorded([]) for part in wave]
    everything.sort(key=lambda part: list(CHAPTERS).index(part.chapter))
    lines = []
    for chapter, parts in groupby(everything, lambda part: part.chapter):
        own = list(parts)
        lines.append(line(f"**{chapter}**", own))
        for name in CHAPTERS[chapter]:
            lines.append(line(f"{chapter}/{name}", [part for part in own if part.name == name]))
    lines.append(line("**all**", everything))
    return in_markdown(pd.DataFrame(lines))


def line(title: str, parts: list) -> dict[str, str]:
    costs = [cost(part) for part in parts]
    return {
        "Rows": title,
        "Batches": str(len(parts)),
        "Core-hours": at_least(sum(costs) / 3600, 2),
        "Longest batch [min]": at_least(max(costs) / 60, 1),
    }


def at_least(number: float, digits: int) -> str:
    """A number, or a bound where rounding would leave nothing of it."""
    least = 10**-digits
    return f"{number:.{digits}f}" if number >= least / 2 else f"< {least:g}"


def scaling(bench: dict) -> str:
    """How much faster two workers are than one, in words."""
    median = bench["median"]
    return (
        f"A sweep of {median['CPU-seconds']:.0f} CPU-seconds (`tests/bench/bench_scaling.py`, "
        f"{bench['machine']}, load {median['load before']:.1f} before it began, rounds: "
        f"{bench['rounds']}) was {median['times as fast']:.2f} times as fast with two workers as "
        f"with one, and its jobs cost {median['CPU-seconds beside each other']:.2f} times as many "
        "CPU-seconds beside each other as alone. With this factor for more than one core, and "
        "long batches first, chapters take so many hours of wall time:"
    )


def wall_hours(bench: dict) -> str:
    """A table of wall times by the number of cores."""
    factor = bench["median"]["CPU-seconds beside each other"]
    chapters = {chapter: [chapter] for chapter in CHAPTERS if any(recorded([chapter]))} | {
        "all": []
    }
    lines = [
        {"Cores": str(cores)}
        | {
            title: at_least(hours(names, cores) * (factor if cores > 1 else 1), 2)
            for title, names in chapters.items()
        }
        for cores in CORES
    ]
    return in_markdown(pd.DataFrame(lines))


def hours(chapters: list[str], cores: int) -> float:
    """Wall time of chapters on so many cores, each as fast as if it were alone."""
    waves = recorded(chapters, cores)
    return wall_seconds([[cost(part) for part in wave] for wave in waves], cores) / 3600


def limits(bench: dict) -> str:
    """What keeps more cores from helping, in words."""
    longest = [max(wave, key=cost) for wave in recorded([])]
    trained, played = ([f"{p.chapter}/{p.name}", cost(p) / 60] for p in longest)
    memory = ", ".join(f"{gib:.1f} GiB for `{name}`" for name, gib in bench["gib"].items())
    return (
        f"What limits it is the longest batch, {trained[1]:.0f} minutes of `{trained[0]}`, which "
        f"does not become shorter on more cores, and after it the longest that reads its policies, "
        f"{played[1]:.1f} minutes of `{played[0]}`. A worker needs memory: {memory}."
    )


def in_markdown(table: pd.DataFrame, num_words: int = 1) -> str:
    """A table of text whose columns but the first ones are numbers."""
    align = ["left"] * num_words + ["right"] * (table.shape[1] - num_words)
    return table.to_markdown(index=False, colalign=align, disable_numparse=True)
