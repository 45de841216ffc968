"""The paper's tables of hyperparameters beside its programs and the settings of our code."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pandas as pd

from experiments.doors.training import TRAIN_FRICTIONS, published_door
from experiments.keys import TRAINED, published
from experiments.paper import read_paper
from ipo.lqr_learners import LQR_METHODS, LQRSettings, published_lqr
from ipo.ppo import PPOSettings

NUM_DOMAINS = {"keys": len(TRAINED), "door": len(TRAIN_FRICTIONS)}
SETTINGS: dict[tuple[str, str], PPOSettings | LQRSettings] = {
    **{("lqr", method): published_lqr(method) for method in LQR_METHODS},
    **{("keys", method): published(method) for method in ("ppo", "ipo")},
    ("door", "ppo"): published_door("ppo"),
    ("door", "ipo"): published_door("ipo", num_updates=95),  # the policies "as published"
}
NAMES = {
    "gradient_descent": "Gradient descent",
    "overparameterized": "Overparam.",
    "ipo_fixed_phi": "IPO, fixed Φ",
    "ipo_variable_phi": "IPO, variable Φ",
    "ppo": "PPO",
    "ipo": "IPO",
}
TITLES = {
    "lqr": "Linear quadratic control (Table 5)",
    "keys": "Coloured keys (Table 6)",
    "door": "Door opening (Table 7)",
}
ROUNDED = {"K": 1e3, "M": 1e6}  # numbers of steps
IN_WORDS = {
    "none": "no",
    "rollout": "over the rollout",
    "terminal": "an end",
    "no_advantage": "without advantage",
    "adam": "Adam",
}


def envs_of(own: PPOSettings) -> list[int]:
    """Copies of the environment, of each domain if their numbers differ."""
    return list(own.num_envs) if isinstance(own.num_envs, tuple) else [own.num_envs]


def frames_of_moves(own: PPOSettings, num_domains: int) -> list[int]:
    """Of each rollout in a round."""
    return [own.num_steps * sum(copies) for copies in own.copies(num_domains)]


def num_frames(own: PPOSettings, num_domains: int) -> int:
    """In all of a training."""
    return own.num_updates * sum(frames_of_moves(own, num_domains))


def num_gradient_steps(own: PPOSettings, num_domains: int) -> int:
    """In all of a training, by all players together."""
    steps = 0
    for frames, copies in zip(
        frames_of_moves(own, num_domains), own.copies(num_domains), strict=True
    ):
        size = own.size_of_minibatches(frames)
        for epoch in range(own.num_epochs):
            left_out = sum(copies) if own.skip_last_frames and epoch % 2 else 0
            steps += math.ceil((frames - left_out) / size)
    return own.num_updates * steps


def batch_sizes(own: PPOSettings, num_domains: int) -> str:
    """Of each player's minibatches, or of all if they are the same."""
    sizes = [own.size_of_minibatches(n) for n in frames_of_moves(own, num_domains)]
    return " and ".join(map(str, dict.fromkeys(sizes)))


OURS: dict[str, Callable[[Any, int], Any]] = {
    "optimiser": lambda own, _: IN_WORDS[own.optimizer],
    "iterations": lambda own, _: own.num_iterations,
    "hidden units": lambda own, _: own.num_hidden,
    "start of Φ or K₁": lambda own, _: f"N(0, {own.phi_scale:g}²)",
    "start of Kᵈ or K₂": lambda own, _: f"N(0, {own.gain_scale:g}²)" if own.gain_scale else "0",
    "learning rate": lambda own, _: own.learning_rate,
    "time-steps per rollout": lambda own, _: own.num_steps,
    "epochs per rollout": lambda own, _: own.num_epochs,
    "discount γ": lambda own, _: own.discount,
    "GAE λ": lambda own, _: own.gae_lambda,
    "batch size": batch_sizes,
    "entropy bonus": lambda own, _: own.entropy_weight,
    "clip range": lambda own, _: own.clip,
    "total time-steps": lambda own, num_domains: f"{num_frames(own, num_domains):,}",
    "environments": lambda own, _: " + ".join(map(str, envs_of(own))),
    "Adam's ε": lambda own, _: own.adam_epsilon,
    "weight of the value loss": lambda own, _: own.value_weight,
    "gradient norm": lambda own, _: own.max_gradient_norm,
    "rewards normalised": lambda own, _: "by each player" if own.normalize_rewards else "no",
    "advantages normalised": lambda own, _: IN_WORDS[own.normalize_advantages],
    "a time-out is": lambda own, _: IN_WORDS[own.time_outs],
    "last frames left out": lambda own, _: (
        "every second epoch" if own.skip_last_frames else "never"
    ),
}


def ours(problem: str, method: str, setting: str) -> str:
    """A setting of our runs, as text."""
    return str(OURS[setting](SETTINGS[problem, method], NUM_DOMAINS.get(problem, 1)))


def tables() -> str:
    """A table for each problem: what the text says, and the programs and our code have, by method.

    What differs from the text is bold.
    """
    stated = read_paper("hyperparameters").fillna("")
    parts = []
    for problem, rows in stated.groupby("problem", sort=False):
        columns = {}
        for method, own in rows.groupby("method", sort=False):
            texts = own.set_index("setting")["paper"]
            here = {setting: ours(problem, method, setting) for setting in texts.index}
            columns[f"{NAMES[method]}, text"] = texts.replace("", "–")
            columns[f"{NAMES[method]}, runs"] = pd.Series(
                {s: f"**{now}**" if differs(texts[s], now) else now for s, now in here.items()}
            )
        table = pd.DataFrame(columns).reindex(rows["setting"].unique()).fillna("")
        table = table.rename_axis("Setting")
        if len(table.columns) > len(table):  # wider than a page
            table = table.T.rename_axis("Method")
        text = table.to_markdown(disable_numparse=True)
        parts.append(f"### {TITLES[problem]}\n\n{text}")
    return "\n\n".join(parts) + "\n"


def differs(text: str, here: str) -> bool:
    """Whether a setting is another than the text says, which rounds numbers of steps."""
    if not text or text == here:
        return False
    if text[-1] not in ROUNDED:
        return True
    stated = float(text[:-1]) * ROUNDED[text[-1]]
    return abs(float(here.replace(",", "")) - stated) > 0.05 * stated
