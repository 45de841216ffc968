"""Vector environments of gymnasium as the environments that players collect in."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from torch import Tensor

from ipo.rollouts import Step
from ipo.worlds.seeds import seeds_of


class FromGymnasium:
    """``R x N`` copies in one ``gymnasium.vector.VectorEnv``, which begin anew in the same step.

    Args:
        envs: made with ``autoreset_mode=AutoresetMode.SAME_STEP``; observations are arrays.
        num_runs: R; copies r N to (r + 1) N belong to run r.
        seed: of the first reset, spread over the copies; or one for each of them.
    """

    def __init__(self, envs: VectorEnv, num_runs: int, seed: int | Sequence[int]) -> None:
        mode = envs.metadata.get("autoreset_mode")
        if getattr(mode, "name", None) != "SAME_STEP":  # gymnasium before 1.1 has no modes
            raise ValueError(f"envs: have autoreset_mode = {mode}, must have SAME_STEP")
        if envs.num_envs % num_runs:
            raise ValueError(f"envs: {envs.num_envs} copies, must be a multiple of {num_runs} runs")
        self.envs, self.num_runs = envs, num_runs
        if not isinstance(seed, Sequence):
            seed = seeds_of(np.random.SeedSequence(seed), envs.num_envs)
        if len(seed) != envs.num_envs:
            raise ValueError(f"seed: {len(seed)} seeds, must be one for each of {envs.num_envs}")
        self.seeds = seed

    def reset(self) -> Tensor:
        return self._by_run(self.envs.reset(seed=self.seeds)[0])  # type: ignore[arg-type]

    def step(self, actions: Tensor) -> Step:
        answer = self.envs.step(actions.flatten(0, 1).numpy())
        observation, reward, terminated, truncated, info = answer
        last = observation
        over = np.flatnonzero(terminated | truncated)
        if len(over):
            last = observation.copy()
            for copy in over:
                last[copy] = info["final_obs"][copy]
        return Step(*map(self._by_run, (observation, reward, terminated, truncated, last)))

    def state(self) -> dict[str, Any]:
        """Of environments that have one."""
        return self.envs.state()  # type: ignore[attr-defined]

    def restore(self, state: dict[str, Any]) -> None:
        self.envs.restore(state)  # type: ignore[attr-defined]

    def _by_run(self, values: np.ndarray) -> Tensor:
        """A copy ``[R, N, ...]``, in single precision where they are numbers."""
        copy = values.astype(bool if values.dtype == bool else np.float32)
        return torch.from_numpy(copy.reshape(self.num_runs, -1, *values.shape[1:]))
