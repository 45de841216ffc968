"""The cued maze: arms, their rows, and how they come out beside what was predicted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
import pandas as pd
import torch

from experiments import cue_theory as theory
from experiments.cue_theory import CUE_WINS, LANDMARK_WINS, NEITHER
from experiments.experiment import Experiment
from experiments.origin import ROOT
from experiments.paper import read_paper
from experiments.rows import tidy
from ipo.checks import Positive, checked, one_of
from ipo.networks import DenseOnTable, Weights
from ipo.ppo import PPOSettings, Training
from ipo.rollouts import Rollout
from ipo.stats import holm, paired_difference
from ipo.worlds.cued_maze import LANDMARK, Cue, cued_maze
from ipo.worlds.tabular import TabularDomains, expected_return

PREDICTIONS = ROOT / "data" / "predictions"
ENCODINGS = ("signs", "one_hot")
EXTREMES = (-1.0, 1.0)  # cues between which every return is linear
METHODS = ("ppo", "in_turn", "ensemble", "ipo")
NAMES = {
    "ppo": "PPO",
    "in_turn": "one network, one domain at a time",
    "ensemble": "ensemble, pooled data",
    "ipo": "IPO",
    "vrex": "V-REx",
}


@checked
@dataclass(frozen=True)
class Cell:
    """One method at one point of a phase diagram.

    Attributes:
        settings: how it is trained.
        cues: of the training domains.
        encoding: what the network sees: landmark, cue and whether it is at the junction as numbers
            (``signs``), or which of the eight observations it is (``one_hot``).
        penalty: of V-REx; ``None``: there is none.
    """

    settings: PPOSettings
    cues: Annotated[tuple[Cue, ...], "domains"]
    encoding: Annotated[str, one_of(ENCODINGS)] = "signs"
    penalty: Positive | None = None

    def __post_init__(self) -> None:
        if self.penalty is not None and self.settings.method != "ppo":
            raise ValueError(f"penalty = {self.penalty}: must be None, but for the method ppo")

    @property
    def columns(self) -> dict[str, Any]:
        method = self.settings.method if self.penalty is None else f"vrex_{self.penalty:g}"
        return {"method": method, "cues": theory.text(self.cues), "encoding": self.encoding}


def settings(method: str, num_updates: int) -> PPOSettings:
    """Of every arm: as many gradient steps for a player as for PPO's only one."""
    return PPOSettings(
        method,
        learning_rate=5e-3,
        num_updates=num_updates,
        num_envs=144,  # a multiple of 2^2, 3^2 and 4^2, for the players of an ensemble
        num_steps=16,
        num_minibatches=4,
    )


def phase_cells(num_domains: int, num_updates: int) -> list[Cell]:
    """Every arm at every point of a diagram."""
    ppo = settings("ppo", num_updates)
    return [
        cell
        for cues in theory.points(num_domains)
        for cell in (
            *(Cell(settings(method, num_updates), cues) for method in METHODS),
            *(Cell(ppo, cues, penalty=float(p)) for p in theory.PENALTIES),
        )
    ]


def encoding_cells(num_updates: int) -> list[Cell]:
    """PPO and IPO without signs that observations have in common, where these are disputed."""
    return [
        Cell(settings(method, num_updates), cues, "one_hot")
        for cues in theory.disputed()
        for method in ("ppo", "ipo")
    ]


class VREx(Training):
    """PPO on the mean return of the domains minus a penalty times its variance::

        J = mean_d R_d - penalty Var_d R_d,
        grad J = mean_d [1 - 2 penalty (R_d - mean R)] grad R_d

    So each domain's advantages get a weight. R_d is estimated by the mean of the returns in its
    part of the rollout. Source: Krueger et al. (2021), with returns in place of risks.
    """

    def __init__(self, penalty: float, *given: Any) -> None:
        super().__init__(*given)
        self.penalty, self.num_domains = penalty, len(self.moves[0].domains)

    def weighted(self, rollout: Rollout) -> Rollout:
        """Of ``[R, N, T]``, whose copies are in the order of their domains, evenly many of each."""
        by_domain = rollout.returns.unflatten(1, (self.num_domains, -1))
        returns = by_domain.mean((2, 3), keepdim=True)  # [R, E, 1, 1]
        weights = 1 - 2 * self.penalty * (returns - returns.mean(1, keepdim=True))
        advantages = rollout.advantages.view_as(by_domain) * weights
        return rollout._replace(advantages=advantages.flatten(1, 2))

    def respond(self, d: int) -> None:
        """PPO's only move, with these weights."""
        average = self.network.frozen(self.players)
        rollout = self.collectors[d].collect(average, self.network.distribution, self.draws)
        self.num_frames += rollout.values[0].numel()
        self.improve(self.moves[d].player, self.weighted(rollout).frames())


def training(cell: Cell, seeds: list[int]) -> Training:
    """Runs of a cell that have not begun."""
    domains = TabularDomains([cued_maze(cue) for cue in cell.cues])
    given = (network(cell.encoding), domains, len(cell.cues), cell.settings, seeds)
    return Training(*given) if cell.penalty is None else VREx(cell.penalty, *given)


def network(encoding: str) -> DenseOnTable:
    """A player's, with 16 tanh units. All domains have the same eight observations."""
    images = torch.tensor(TabularDomains([cued_maze(0.0)]).images).float()
    table = images if encoding == "signs" else torch.eye(len(images))
    return DenseOnTable(table, num_actions=3, hidden=(16,))


def run_cell(cell: Cell, seeds: list[int]) -> pd.DataFrame:
    """Train, and give the exact returns where the cue is always wrong and where it is right."""
    *_, (_, players) = training(cell, seeds).reports()
    return tidy(cell, seeds, exact(network(cell.encoding), players))


def exact(network: DenseOnTable, players: Sequence[Weights]) -> dict[tuple[str, str], np.ndarray]:
    """Exact returns ``[R]`` of the average policy at both extremes of the cue."""
    doubled = [{name: w.double() for name, w in player.items()} for player in players]
    policy = network.average(doubled)[0].softmax(-1).numpy()
    (seen,) = TabularDomains([cued_maze(0.0)]).observation_of
    return {
        (f"{cue:g}", "return_exact"): expected_return(cued_maze(cue), policy[:, seen])[0]
        for cue in EXTREMES
    }


def short(cell: Cell) -> Cell | None:
    """Two updates at one point of each diagram; the others are of no other kind."""
    if sorted(set(cell.cues)) != [-0.9, 0.9]:
        return None
    return replace(cell, settings=replace(cell.settings, num_updates=2))


EXPERIMENTS = {
    name: Experiment(run_cell, Cell, short)
    for name in ("two_domains", "three_domains", "four_domains", "encodings")
}


# ------------------------------------------------------------------------- read off the rows

MARGIN = 0.1  # a difference of returns that counts
HALF = LANDMARK / 2  # between the returns of following landmark and cue where the cue is wrong
INFORMED = (0.5 + LANDMARK) / 2  # between chance and the landmark, where the cue says nothing


def by_run(rows: pd.DataFrame) -> pd.DataFrame:
    """What runs are judged by: a line for each run with three columns.

    A return is linear in the cue, so those at both extremes tell everything: ``worst`` is the
    return in the worst of *all* domains, ``plain`` that without a cue, ``use`` what the cue adds.
    """
    wide = rows.pivot(index=["encoding", "cues", "method", "run"], columns="domain", values="value")
    wrong, right = wide["-1"], wide["1"]
    worst, plain = np.minimum(wrong, right), (wrong + right) / 2
    return pd.DataFrame({"worst": worst, "plain": plain, "use": right - wrong})


def with_chosen_penalty(runs: pd.DataFrame) -> pd.DataFrame:
    """The same with V-REx once: with the penalty that the training domains of a point choose."""
    parts = [runs.drop([m for m in runs.index.unique("method") if m.startswith("vrex")], level=2)]
    for (encoding, cues), mean in _means(runs).groupby(level=["encoding", "cues"]):
        use = {
            int(method.removeprefix("vrex_")): mean["use"][encoding, cues, method]
            for method in mean.index.unique("method")
            if method.startswith("vrex")
        }
        if use:
            strengths = [float(c) for c in cues.split()]
            spreads = {penalty: theory.spread(strengths, u) for penalty, u in use.items()}
            method = f"vrex_{theory.chosen_penalty(spreads)}"
            parts.append(runs.loc[[(encoding, cues, method)]].rename({method: "vrex"}, level=2))
    return pd.concat(parts)


def _means(runs: pd.DataFrame) -> pd.DataFrame:
    return runs.groupby(level=["encoding", "cues", "method"]).mean()


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
    """What was predicted, and what came out, for every arm and point that was run."""
    predicted = read_paper("cue", PREDICTIONS).set_index(["encoding", "cues", "method"])["follows"]
    found = outcomes(runs)
    return pd.DataFrame({"predicted": predicted.reindex(found.index), "found": found})


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
