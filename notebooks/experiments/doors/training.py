"""Training on doors: the published settings, runs that survive interruptions, saved policies.

Test frictions are looked at while training, for the curves, but nothing depends on them.
"""

from __future__ import annotations

import itertools
import re
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from tqdm import tqdm

from experiments.checkpoints import CheckpointError, load_checkpoint, save_checkpoint
from experiments.experiment import Experiment, difference, plain
from experiments.files import check_file_name
from experiments.policies import check_place, load_policy, save_policy
from ipo.checks import Count, checked
from ipo.dense_in_numpy import DenseInNumpy
from ipo.distributions import Gaussian, Generators
from ipo.networks import Weights, copied, of_run
from ipo.ppo import PPOSettings, Training
from ipo.worlds.many_doors import VectorDoor
from ipo.worlds.seeds import seeds_of
from ipo.worlds.vector_environments import FromGymnasium

TRAIN_FRICTIONS = (0.0, 0.1)
NETWORK = DenseInNumpy(15, 6, Gaussian)
NUM_LAST = 10  # training episodes whose mean return decides which policy is the best
CURVE_FRICTION, NUM_CURVE_DOORS, CURVE_SEED = 1.3, 50, 20201106
CHOICES = ("best", "last")
EVALUATION_SEED = 20210607  # of the doors that all policies are tested on


def published_door(method: str, **changes: Any) -> PPOSettings:
    """The settings of the paper's runs on doors (Table 7), with ``changes``.

    Where the published runs differ from the text, these are the runs': the table's batch size of
    256 was the number of minibatches, rewards were normalised, and training IPO ended after 95
    updates, 12.5 million steps. The loss of the critic had a factor 1/2 besides its weight 0.5.
    """
    paper = {
        "learning_rate": 5e-4 if method == "ipo" else 1e-3,
        "adam_epsilon": 1e-5,
        "num_updates": 190,
        "num_envs": (24, 8),
        "num_steps": 4096,
        "num_epochs": 10,
        "num_minibatches": 256,
        "value_weight": 0.25,
        "normalize_rewards": True,
        "normalize_advantages": "rollout",
        "time_outs": "no_advantage",
    }
    return PPOSettings(method, **(paper | changes))


@checked
@dataclass(frozen=True)
class Cell:
    """One configuration of the training.

    Attributes:
        label: the method's name in the rows.
        settings: how it is trained.
        saved_after: the policies are saved after so many updates. A training that ends there
            would be the same: its random streams do not depend on how long it will last.
        curve_every: updates between two looks at a friction that is not trained on.
        same_doors: the doors are IPO's, whoever learns from them; see :class:`SameDoors`.
        hidden: units of each hidden layer.
    """

    label: str
    settings: PPOSettings
    saved_after: tuple[Count, ...] = (95, 190)
    curve_every: Count = 10
    same_doors: bool = False
    hidden: tuple[Count, ...] = (64, 64)

    def __post_init__(self) -> None:
        check_file_name("label", self.label)  # of policies and check-points
        for updates in self.saved_after:
            if not 0 < updates <= self.settings.num_updates:
                raise ValueError(
                    f"saved_after = {self.saved_after}: must be between 1 and "
                    f"num_updates = {self.settings.num_updates}"
                )

    @property
    def network(self) -> DenseInNumpy:
        return DenseInNumpy(15, 6, Gaussian, self.hidden)

    @property
    def columns(self) -> dict[str, Any]:
        return {"method": self.label, "train_frictions": "+".join(map(str, TRAIN_FRICTIONS))}


def controls(num_updates: int = 95, curve_every: int = 10, **changes: Any) -> dict[str, Cell]:
    """Arms that show what a difference between IPO and PPO is due to.

    They end where the published training of IPO did: the ensemble, whose players learn from all
    doors; one network that learns from one domain at a time; IPO with PPO's learning rate. The
    latter two have IPO's doors by themselves. With the same doors: the ensemble, PPO, and PPO with
    one network of as many weights as IPO's two, with as many doors of one domain as of the other,
    and with the rewards of each domain normalised by themselves.
    """

    def control(
        label: str,
        method: str,
        learning_rate: float,
        same_doors: bool = True,
        hidden: tuple[int, ...] = (64, 64),
        **own: Any,
    ) -> Cell:
        settings = published_door(
            method, learning_rate=learning_rate, num_updates=num_updates, **changes, **own
        )
        return Cell(label, settings, (num_updates,), curve_every, same_doors, hidden)

    cells = [
        control("ensemble", "ensemble", 5e-4, same_doors=False),
        control("in_turn", "in_turn", 5e-4, same_doors=False),
        control("ipo_lr1e-3", "ipo", 1e-3, same_doors=False),
        control("ppo_same_doors", "ppo", 1e-3),
        control("ppo_wide_same_doors", "ppo", 1e-3, hidden=(94, 94)),
        control("ppo_16_16", "ppo", 1e-3, num_envs=(16, 16)),
        control("ppo_by_domain", "ppo", 1e-3, reward_scale="domain"),
        control("ensemble_same_doors", "ensemble", 5e-4),
    ]
    return {cell.label: cell for cell in cells}


CELLS = {
    "ppo": Cell("ppo", published_door("ppo")),
    "ipo": Cell("ipo", published_door("ipo")),
    **controls(),
}


def train_run(
    cell: Cell,
    seeds: Sequence[int],
    checkpoints: str | Path,
    policies: str | Path,
    progress: bool = True,
) -> pd.DataFrame:
    """Train runs together, or go on where they were interrupted; save their policies; their curves.

    The state is saved after every update in ``checkpoints``, and stays there in the end: it is all
    that there is until the rows are saved, and then the store removes it.

    Returns:
        rows with the cell's columns, ``frames``, ``run``, ``domain``, ``metric`` and ``value``.
        Metrics of training episodes, whose actions are random: ``return``, ``success``;
        ``deviation``, the mean of the policy's standard deviations; of the most likely actions on
        the same fresh doors: ``success_most_likely``; ``cpu_seconds``, an equal share for each.

    Raises:
        CheckpointError: a check-point of other settings, or of some of these runs and others; one
            that cannot be written.
        ValueError: policies of other settings are where these would be saved.
    """
    runs = Runs(cell, seeds, Path(checkpoints), Path(policies))
    earlier = runs.cpu_seconds * len(seeds)
    bar = tqdm(
        total=cell.settings.num_updates,
        initial=runs.num_updates,
        desc=f"{cell.label} {', '.join(map(str, seeds))}",
        unit="update",
        disable=not progress,
        leave=False,
    )
    with bar:
        while runs.num_updates < cell.settings.num_updates:
            runs.update()
            bar.update()
    rows = runs.rows()
    rows.attrs["earlier_cpu_seconds"] = earlier
    return rows


class Runs:
    """R runs of a cell that are trained together, with their check-point.

    It takes less time than one after the other, and a run is the same to the digit, whoever is
    trained beside it.
    """

    def __init__(self, cell: Cell, seeds: Sequence[int], checkpoints: Path, policies: Path) -> None:
        self.cell, self.seeds, self.policies = cell, list(seeds), policies
        self.checkpoint = checkpoint_path(cell, self.seeds, checkpoints)
        self.training = new_training(cell, seeds)
        self.num_updates = 0
        self.cpu_seconds = 0.0  # of each run
        self.best_returns = torch.full((len(self.seeds),), -torch.inf, dtype=torch.float64)
        self.best = copied(self.training.players)
        self.curve: list[list[Any]] = []  # frames, run, domain, metric, value
        self.identity = plain({"settings": cell})
        for seed in self.seeds:
            for updates in cell.saved_after:
                for choice in CHOICES:
                    check_place(*self._policy(seed, updates, choice))
        for runs in checkpoints_of(cell, checkpoints):
            if list(runs) != self.seeds and not set(runs).isdisjoint(self.seeds):
                raise CheckpointError(
                    f"{checkpoint_path(cell, runs, checkpoints)}: carries runs {list(runs)}, asked "
                    f"for {self.seeds}; ask for all of them, with as many workers as before, or "
                    "delete it to begin anew"
                )
        state = load_checkpoint(self.checkpoint)
        if state is not None:
            self._restore(state)

    def update(self) -> None:
        """One update of all players; then save policies where it is time, and the state."""
        before = time.process_time()
        self.training.update()
        self.num_updates += 1
        self._note_episodes()
        if self.num_updates % self.cell.curve_every == 0:
            self._note(CURVE_FRICTION, "success_most_likely", self._successes())
        self.cpu_seconds += (time.process_time() - before) / len(self.seeds)
        self._note("training", "cpu_seconds", [self.cpu_seconds] * len(self.seeds))
        if self.num_updates in self.cell.saved_after:
            self._save_policies()
        save_checkpoint(self.checkpoint, self._state())

    def rows(self) -> pd.DataFrame:
        return pd.DataFrame(
            {
                **self.cell.columns,
                "frames": frames,
                "run": seed,
                "domain": str(domain),
                "metric": metric,
                "value": value,
            }
            for frames, seed, domain, metric, value in self.curve
        )

    def _note(self, domain: float | str, metric: str, values: Iterable[float]) -> None:
        for seed, value in zip(self.seeds, values, strict=True):
            self.curve.append([self.training.num_frames, seed, domain, metric, float(value)])

    def _note_episodes(self) -> None:
        """Returns and successes of the episodes of this update, and the best policies so far.

        The last ten episodes, by which the published runs choose, are the last to end; of those
        that end together, the doors with more friction come last.
        """
        episodes = []
        for collector in self.training.collectors:
            doors = collector.environments.envs
            episodes += [(doors.frictions, *episode) for episode in doors.episodes]
            doors.episodes.clear()
        frictions, returns, successes = (
            np.concatenate([np.reshape(part, (len(self.seeds), -1)) for part in parts], 1)
            for parts in zip(*episodes, strict=True)
        )
        for friction in TRAIN_FRICTIONS:
            chosen = frictions[0] == friction
            self._note(friction, "return", returns[:, chosen].mean(1))
            self._note(friction, "success", successes[:, chosen].mean(1))
        deviations = torch.stack([player["log_std"].exp() for player in self.training.players])
        self._note("training", "deviation", deviations.mean(2).mean(0))
        last = torch.from_numpy(returns[:, -NUM_LAST:].mean(1))
        better = last > self.best_returns
        self.best_returns[better] = last[better]
        for best, now in zip(self.best, self.training.players, strict=True):
            for name, weights in best.items():
                weights[better] = now[name][better]

    def _successes(self) -> list[float]:
        """What share of the same fresh doors each run opens by its most likely actions."""
        door = CURVE_FRICTION, NUM_CURVE_DOORS, CURVE_SEED, self.cell.network
        players = [of_run(self.training.players, r) for r in range(len(self.seeds))]
        return [last_info(own, *door)["opened"].mean() for own in players]

    def _policy(self, seed: int, updates: int, choice: str) -> tuple[Path, dict[str, Any]]:
        """Where a policy is, and what it is made for."""
        path = policy_path(self.policies, self.cell.label, seed, updates, choice)
        return path, made_for(self.cell, seed, updates, choice)

    def _save_policies(self) -> None:
        notes = {
            "frames": self.training.num_frames,
            "cpu_seconds": round(self.cpu_seconds, 1),
            "versions": {name: version(name) for name in ("torch", "numpy", "mujoco")},
        }
        for r, seed in enumerate(self.seeds):
            for choice, players in (("best", self.best), ("last", self.training.players)):
                path, about = self._policy(seed, self.num_updates, choice)
                save_policy(path, of_run(players, r), about, notes)

    def _state(self) -> dict[str, Any]:
        return {
            "identity": self.identity,
            "training": self.training.state(),
            "num_updates": self.num_updates,
            "cpu_seconds": self.cpu_seconds,
            "best_returns": self.best_returns,
            "best": self.best,
            "curve": self.curve,
        }

    def _restore(self, state: dict[str, Any]) -> None:
        if differs := difference(state["identity"], self.identity):
            raise CheckpointError(
                f"{self.checkpoint}: was made for others: {differs}; delete it to begin anew"
            )
        self.training.restore(state["training"])
        for name in ("num_updates", "cpu_seconds", "best_returns", "best", "curve"):
            setattr(self, name, state[name])


def new_training(cell: Cell, seeds: Sequence[int]) -> Training:
    """Runs of training on doors, from their start."""
    doors = SameDoors() if cell.same_doors else make_doors
    return Training(cell.network, doors, len(TRAIN_FRICTIONS), cell.settings, seeds)


def make_doors(domains: list[int], num_copies: list[int], generators: Generators) -> FromGymnasium:
    """Random doors of the training frictions for every run.

    A player who owns all domains draws them together, so that no more than doors of the first
    domain are those of IPO with the same seed.
    """
    streams = [new_stream(generator) for generator in generators]
    return _doors(domains, num_copies, [seeds_of(own, sum(num_copies)) for own in streams])


class SameDoors:
    """As :func:`make_doors` for players with a domain each, and the same doors for all others.

    The doors of a domain have random streams of their own; each player takes the next ones.
    """

    def __init__(self) -> None:
        self.streams: list[list[np.random.SeedSequence]] = []  # of every run, one for each domain

    def __call__(
        self, domains: list[int], num_copies: list[int], generators: Generators
    ) -> FromGymnasium:
        if not self.streams:
            self.streams = [[new_stream(own) for _ in TRAIN_FRICTIONS] for own in generators]
        taken = list(zip(domains, num_copies, strict=True))
        seeds = [
            [seed for domain, number in taken for seed in seeds_of(streams[domain], number)]
            for streams in self.streams
        ]
        return _doors(domains, num_copies, seeds)


def _doors(domains: list[int], num_copies: list[int], seeds: list[list[int]]) -> FromGymnasium:
    """Doors of these domains for every run, drawn from the run's seeds."""
    frictions = np.repeat([TRAIN_FRICTIONS[d] for d in domains], num_copies).tolist()
    together = list(itertools.chain(*seeds))
    return FromGymnasium(VectorDoor(frictions * len(seeds)), len(seeds), together)


def new_stream(generator: np.random.Generator) -> np.random.SeedSequence:
    return np.random.SeedSequence(int(generator.integers(2**63)))


def last_info(
    players: Sequence[Weights],
    friction: float,
    num_doors: int,
    seed: int,
    network: DenseInNumpy = NETWORK,
    **options: Any,
) -> dict[str, np.ndarray]:
    """What the players' average makes of fresh doors in one episode, by its most likely actions.

    The doors and the starts are those of the seed, whoever is asked and at every friction.
    ``options`` are those of :class:`ipo.worlds.many_doors.VectorDoor`.

    Returns:
        the ``info`` of the last step, such as ``opened`` and ``episode_return``, each ``[N]``.
    """
    doors = VectorDoor([friction] * num_doors, **options)
    try:
        policy = network.frozen(players)
        observations, _ = doors.reset(seed=seed)
        while True:
            rows = torch.tensor(observations, dtype=torch.float32).unsqueeze(0)
            actions = Gaussian.mode(policy(rows)[0])[0]
            observations, _, _, truncated, info = doors.step(actions.numpy())
            if truncated.all():
                return info
    finally:
        doors.close()


def checkpoint_path(cell: Cell, seeds: Sequence[int], checkpoints: str | Path) -> Path:
    """The check-point of runs that are trained together."""
    return Path(checkpoints) / f"{cell.label}_{'-'.join(map(str, seeds))}.checkpoint"


def checkpoints_of(cell: Cell, checkpoints: str | Path) -> dict[tuple[int, ...], list[Path]]:
    """The files of all check-points of a cell, the ones before among them, by their runs."""
    name, found = re.compile(rf"{re.escape(cell.label)}_([\d-]+)\.checkpoint(\..+)?"), {}
    for path in sorted(Path(checkpoints).glob("*.checkpoint*")):
        if match := name.fullmatch(path.name):
            found.setdefault(tuple(map(int, match[1].split("-"))), []).append(path)
    return found


def policy_path(
    folder: str | Path, label: str, seed: int, num_updates: int, choice: str = "best"
) -> Path:
    """The file of a run's policy after so many updates."""
    check_file_name("label", label)
    return Path(folder) / f"{label}_{seed}_{num_updates}_{choice}.safetensors"


def made_for(cell: Cell, seed: int, num_updates: int, choice: str) -> dict[str, Any]:
    """What a policy's file says about it."""
    return {"settings": cell, "seed": seed, "updates": num_updates, "choice": choice}


def load_players(
    folder: str | Path, cell: Cell, seed: int, num_updates: int, choice: str = "best"
) -> list[Weights]:
    """The players of a run, from its file."""
    path = policy_path(folder, cell.label, seed, num_updates, choice)
    return load_policy(path, cell.network, made_for(cell, seed, num_updates, choice))[0]


def shorter(settings: PPOSettings) -> PPOSettings:
    """The same with short rollouts and as many frames in a minibatch."""
    return replace(settings, num_steps=512, num_minibatches=32)


def short(cell: Cell) -> Cell:
    """One update on short rollouts."""
    settings = replace(shorter(cell.settings), num_updates=1)
    return replace(cell, settings=settings, saved_after=(1,), curve_every=1)


EXPERIMENT = Experiment(
    train_run, Cell, short, (0,), runs_at_once=5, divisible=True, checkpoints=checkpoints_of
)
