"""What is unequal in the published comparisons, and what is left of IPO's advantage without it."""

from __future__ import annotations

import yaml

from experiments.registry import DATA
from hyperparameters import NUM_DOMAINS, SETTINGS, envs_of, num_frames, num_gradient_steps
from measured import listed


def settings_by_name() -> dict[str, object]:
    """What the words of the table are filled in from."""
    found: dict[str, object] = {
        "lqr_gd": SETTINGS["lqr", "gradient_descent"],
        "lqr_ipo": SETTINGS["lqr", "ipo_fixed_phi"],
        "door_envs": envs_of(SETTINGS["door", "ppo"]),
    }
    for problem, num_domains in NUM_DOMAINS.items():
        for method in ("ppo", "ipo"):
            own, name = SETTINGS[problem, method], f"{problem}_{method}"
            found[name] = own
            found[f"{name}_frames"] = num_frames(own, num_domains)
            found[f"{name}_steps"] = num_gradient_steps(own, num_domains)
    return found


def table() -> str:
    """A row for each aspect, a column for each problem."""
    page = yaml.safe_load((DATA / "fairness.yml").read_text(encoding="utf-8"))
    problems, words = page["problems"], settings_by_name()
    lines = [":::{table}", ":class: fairness", ""]
    heads = [f"{own['title']}<br>*{own['measure']}*" for own in problems.values()]
    lines += [row(["", *heads]), row([":--"] * (1 + len(problems)))]
    for aspect in page["aspects"]:
        cells = [cell(own, aspect[name], words) for name, own in problems.items()]
        lines.append(row([f"**{aspect['aspect']}**", *cells]))
    return "\n".join([*lines, ":::"]) + "\n"


def cell(problem: dict, entry: dict, words: dict[str, object]) -> str:
    """What is unequal, then each difference that was measured."""
    return "<br>".join([entry["unequal"].format(**words), *listed(problem, entry)])


def row(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"
