"""Trained policies that act, and their files; the networks that fit spaces."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from gymnasium.spaces import Box, Discrete, Space, flatdim

from ipo.distributions import Categorical, Distribution, Gaussian
from ipo.networks import Network, Weights, of_run
from ipo.own_domains.copies import clipped, dtype_of, is_image
from ipo.own_domains.networks import ImageNetwork, VectorNetwork

__all__ = ["Policy", "check_network", "network_for"]

FORMAT = "ipo policy, 1"


@dataclass(frozen=True)
class Policy:
    """Trained policies, one for each seed.

    Attributes:
        label: the method's name in rows.
        seeds: of the runs.
        observations: the space that they were trained with.
        actions: likewise.
        network: of every player.
        players: the weights ``{name: [R, ...]}`` of every player; their average acts.
    """

    label: str
    seeds: tuple[int, ...]
    observations: Space = field(repr=False)
    actions: Space = field(repr=False)
    network: Network = field(repr=False)
    players: list[Weights] = field(repr=False)

    @torch.no_grad()
    def act(self, observation: np.ndarray, run: int = 0) -> np.ndarray:
        """The most likely action of one run for one observation, for an environment's ``step``.

        Raises:
            TypeError, ValueError: an observation of another shape, a run that is not there.
        """
        seen = np.array(observation, dtype_of(self.observations))
        if seen.shape != self.observations.shape:
            raise ValueError(
                f"observation: has shape {seen.shape}, must have {self.observations.shape}"
            )
        own = of_run(self.players, run)
        parameters, _ = self.network.frozen(own)(torch.from_numpy(seen)[None, None])
        return clipped(self.network.distribution.mode(parameters)[0, 0].numpy(), self.actions)

    def save(self, path: str | os.PathLike) -> None:
        """Write a file of arrays (NumPy's ``npz``); an old one is replaced once all is written."""
        arrays: dict[str, Any] = {"format": FORMAT, "label": self.label, "seeds": self.seeds}
        arrays |= _bounds("observations", self.observations) | _bounds("actions", self.actions)
        for name in self.players[0]:
            arrays[f"weights.{name}"] = np.stack([player[name] for player in self.players])
        part = Path(f"{os.fspath(path)}.part")
        with part.open("wb") as file:
            np.savez(file, **arrays)
        part.replace(path)

    @classmethod
    def load(cls, path: str | os.PathLike, network: Network | None = None) -> Policy:
        """What ``save`` wrote. No code of the file is executed.

        Args:
            path: of the file.
            network: of the training; if none is given, that of
                :func:`ipo.own_domains.policy.network_for`.

        Raises:
            ValueError: a file that is damaged, of something else, or of another network.
        """
        with open(path, "rb") as file:
            try:
                arrays = _read(file)
                spaces = _space("observations", arrays), _space("actions", arrays)
                weights = _weights(arrays)
            except Exception as error:  # zip, zlib, NumPy, gymnasium: each has its own
                raise ValueError(
                    f"path = {os.fspath(path)!r}: is no file that Policy.save wrote: {error}"
                ) from error
        if network is None:
            network = network_for(*spaces)
        else:
            check_network(network, *spaces)
        shapes = {name: tuple(w.shape[2:]) for name, w in weights.items()}
        if shapes != network.weight_shapes:
            raise ValueError(
                f"network: has weights {network.weight_shapes}, "
                f"must have those of {os.fspath(path)!r}, {shapes}"
            )
        unbound = (w.unbind() for w in weights.values())
        players = [dict(zip(weights, own, strict=True)) for own in zip(*unbound, strict=True)]
        return cls(str(arrays["label"]), tuple(arrays["seeds"].tolist()), *spaces, network, players)


def network_for(observations: Space, actions: Space) -> VectorNetwork | ImageNetwork:
    """An actor-critic whose kind and sizes fit the spaces."""
    distribution: type[Distribution] = Gaussian if isinstance(actions, Box) else Categorical
    num_actions = int(actions.n) if isinstance(actions, Discrete) else flatdim(actions)
    if is_image(observations):
        return ImageNetwork(observations.shape or (), num_actions, distribution)
    return VectorNetwork(flatdim(observations), num_actions, distribution)


def check_network(network: Network, observations: Space, actions: Space) -> None:
    """Whether a network takes the observations and gives the actions.

    Raises:
        TypeError: something else than a network.
        ValueError: one of another size, or of another kind of actions.
    """
    if not isinstance(network, Network):
        raise TypeError(f"network = {network!r}: must be an ipo.networks.Network")
    generators = [np.random.default_rng(0)]
    seen = torch.from_numpy(np.zeros((1, 1, *(observations.shape or ())), dtype_of(observations)))
    name = type(network).__name__
    try:
        parameters, _ = network(network.start(generators), seen)
    except (RuntimeError, ValueError) as error:  # torch's, NumPy's
        raise ValueError(f"network: {name} must take observations {observations}") from error
    action = network.distribution.sample(parameters, generators)[0, 0]
    num_choices = parameters.shape[-1] if isinstance(actions, Discrete) else None
    if action.shape != actions.shape or num_choices != getattr(actions, "n", None):
        raise ValueError(f"network: {name} must give actions {actions}")


def _read(file: BinaryIO) -> dict[str, np.ndarray]:
    """All arrays; they take no more memory than the file is long."""
    size = os.fstat(file.fileno()).st_size
    if not size:  # or it is a device, which zipfile might read for ever
        raise ValueError("it is empty")
    with np.load(file, allow_pickle=False) as archive:
        if sum(part.file_size for part in archive.zip.infolist()) > size:
            raise ValueError("it would unpack to more than it is")
        arrays = dict(archive)
    if arrays.get("format") != FORMAT:
        raise ValueError(f"its format is not {FORMAT!r}")
    return arrays


def _weights(arrays: dict[str, np.ndarray]) -> Weights:
    """Those of all players ``[E, R, ...]``, a run for each seed."""
    weights = {
        key.removeprefix("weights."): torch.from_numpy(array)
        for key, array in arrays.items()
        if key.startswith("weights.")
    }
    seeds = arrays["seeds"]
    [(_, num_runs)] = {tuple(weight.shape[:2]) for weight in weights.values()}
    if seeds.dtype.kind != "i" or seeds.shape != (num_runs,):
        raise ValueError(f"it has {num_runs} runs, and not as many whole numbers as seeds")
    return weights


def _bounds(name: str, space: Space) -> dict[str, Any]:
    if isinstance(space, Discrete):
        return {f"{name}.n": space.n}
    return {f"{name}.low": space.low, f"{name}.high": space.high}  # type: ignore[attr-defined]


def _space(name: str, arrays: dict[str, np.ndarray]) -> Space:
    if f"{name}.n" in arrays:
        return Discrete(int(arrays[f"{name}.n"]))
    low = arrays[f"{name}.low"]
    return Box(low, arrays[f"{name}.high"], dtype=low.dtype.type)
