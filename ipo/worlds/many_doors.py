"""Many doors at once, as a ``gymnasium.vector.VectorEnv``.

Each door has its own model and its own random stream, so what happens at a door depends on its
seed and on the actions there, and not on which doors stand beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Annotated, Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.vector import AutoresetMode

from ipo.checks import Count, Positive, Seed, checked
from ipo.worlds.door import (
    MAX_STEPS,
    OPENED,
    TIMESTEP,
    DoorParams,
    build_door,
    draw_start,
    lever,
    observe,
    shift_handle,
    substeps,
)
from ipo.worlds.seeds import seeds_of


class VectorDoor(gym.vector.VectorEnv):
    """N doors, each as ``ipo/Door-v0``: the same seed and the same actions, the same episode.

    Episodes of all doors end together, at the time limit, and begin anew in the same step
    (``AutoresetMode.SAME_STEP``). ``info`` holds ``door_angle``, ``opened`` and
    ``episode_return`` so far, each ``[N]``; where episodes have ended they are those of the old
    episodes, and ``final_obs`` is there, too. ``episodes`` keeps ``(episode_return, opened)`` of
    all that ended until somebody clears it, ``frictions`` the domain of each door, and ``params``
    the doors themselves, once ``reset`` has drawn them.

    Args:
        doors: for each door its friction, then the door is drawn from its seed; or its parameters.
        max_steps, timestep: see :class:`ipo.worlds.one_door.DoorEnv`.

    Raises:
        TypeError, ValueError: no doors, a friction or a number that makes no sense, actions of
            another shape or not finite. Nothing has moved then.
        FloatingPointError: a simulation that diverges.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012  (as gymnasium has it)

    @checked
    def __init__(
        self,
        doors: Annotated[Sequence[float | DoorParams], "N"],
        max_steps: Count = MAX_STEPS,
        timestep: Positive = TIMESTEP,
    ) -> None:
        self.given = list(doors)
        self.num_envs, self.max_steps = len(self.given), max_steps
        self.timestep, self.num_substeps = timestep, substeps(timestep)
        given = [d if isinstance(d, DoorParams) else DoorParams(friction=d) for d in self.given]
        self.frictions = [door.friction for door in given]
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (15,), np.float64)
        self.single_action_space = gym.spaces.Box(-1.0, 1.0, (6,), np.float32)
        batch_space = gym.vector.utils.batch_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.params: list[DoorParams] = []
        self.step_count = 0
        self.episodes: list[tuple[np.ndarray, np.ndarray]] = []

    @checked
    def reset(
        self, *, seed: Seed | Sequence[Seed] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin episodes. A seed is a list of one for each door; one number is spread over them.

        Without a seed, doors and random streams stay; at the first reset they are drawn anew.
        """
        if seed is not None or not self.params:
            self.generators = [np.random.default_rng(own) for own in self._seeds(seed)]
            self._build(
                [
                    door if isinstance(door, DoorParams) else DoorParams.sample(generator, door)
                    for door, generator in zip(self.given, self.generators, strict=True)
                ]
            )
        observations, door_angles = self._begin()
        return observations, {"door_angle": door_angles}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One step of every door, and a new beginning after the last one of the episodes."""
        self._check_reset("step()")
        actions = self._checked(np.asarray(actions))
        rewards = self.next_rewards
        for model, data, ctrl, action in zip(
            self.models, self.data, self.ctrl, actions, strict=True
        ):
            ctrl[:] = action
            mujoco.mj_step(model, data, self.num_substeps)
        self.step_count += 1
        observations, door_angles = self._observe()
        self.returns += rewards
        self.opened |= np.abs(door_angles) >= OPENED
        info = {
            "door_angle": door_angles,
            "opened": self.opened.copy(),
            "episode_return": self.returns.copy(),
        }
        ended = self.step_count == self.max_steps
        if ended:
            info["final_obs"] = observations
            self.episodes.append((info["episode_return"], info["opened"]))
            observations, _ = self._begin()
        never = np.zeros(self.num_envs, bool)
        return observations, rewards, never, np.full(self.num_envs, ended), info

    def state(self) -> dict[str, Any]:
        """All that the future of the doors depends on, as arrays and plain values."""
        self._check_reset("state()")
        physics = [np.concatenate([d.qpos, d.qvel, d.qacc_warmstart]) for d in self.data]
        return {
            "params": [asdict(params) for params in self.params],
            "generators": [generator.bit_generator.state for generator in self.generators],
            "step_count": self.step_count,
            "handle_shifts": self.handle_shifts,
            "physics": np.stack(physics),
            "returns": self.returns.copy(),
            "opened": self.opened.copy(),
        }

    @checked
    def restore(self, state: dict[str, Any]) -> None:
        """Go on from ``state()`` of as many doors."""
        if len(state["params"]) != self.num_envs:
            raise ValueError(f"state: of {len(state['params'])} doors, must be of {self.num_envs}")
        self._build([DoorParams(**params) for params in state["params"]])
        self.generators = [np.random.default_rng() for _ in self.params]
        for generator, own in zip(self.generators, state["generators"], strict=True):
            generator.bit_generator.state = own
        for data, own in zip(self.data, np.asarray(state["physics"]), strict=True):
            data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = np.split(own, 3)
        self.step_count = state["step_count"]
        self.returns = np.asarray(state["returns"]).copy()
        self.opened = np.asarray(state["opened"]).copy()
        self._shift_handles(np.asarray(state["handle_shifts"]))
        self._observe()

    def _check_reset(self, what: str) -> None:
        if not self.params:
            raise gym.error.ResetNeeded(f"reset() must come before {what}")

    def _seeds(self, seed: int | Sequence[int] | None) -> Sequence[int]:
        """One for each door."""
        if isinstance(seed, Sequence):
            if len(seed) != self.num_envs:
                raise ValueError(
                    f"seed: names {len(seed)} seeds, must be {self.num_envs}, one a door"
                )
            return seed
        return seeds_of(np.random.SeedSequence(seed), self.num_envs)

    def _build(self, params: list[DoorParams]) -> None:
        self.params = params
        self.models = [build_door(own, self.timestep).compile() for own in params]
        self.data = [mujoco.MjData(model) for model in self.models]
        # Views of MuJoCo's memory: to ask for them anew in each step would cost as much as a step.
        self.ctrl = [data.ctrl for data in self.data]
        self.qpos = [data.qpos for data in self.data]
        self.qvel = [data.qvel for data in self.data]

    def _begin(self) -> tuple[np.ndarray, np.ndarray]:
        """Begin the next episode of every door; what is observed then."""
        shifts = []
        for model, data, generator in zip(self.models, self.data, self.generators, strict=True):
            mujoco.mj_resetData(model, data)
            data.qpos[:], shift = draw_start(generator)
            shifts.append(shift)
        self.step_count = 0
        self.returns, self.opened = np.zeros(self.num_envs), np.zeros(self.num_envs, bool)
        self._shift_handles(np.array(shifts))
        return self._observe()

    def _shift_handles(self, shifts: np.ndarray) -> None:
        """Put the handles in their places ``[N, 2]`` for the episode."""
        self.handle_shifts = shifts
        for model, params, shift in zip(self.models, self.params, shifts, strict=True):
            shift_handle(model, params, shift)
        levers = [lever(params, shift) for params, shift in zip(self.params, shifts, strict=True)]
        self.hinges, self.arms = (np.stack(part) for part in zip(*levers, strict=True))

    def _observe(self) -> tuple[np.ndarray, np.ndarray]:
        """Observations ``[N, 15]`` and door angles ``[N]``; notes the rewards of the next step."""
        qpos, qvel = np.array(self.qpos), np.array(self.qvel)
        self._check_states(qpos, qvel)
        observations, self.next_rewards = observe(qpos, qvel, self.hinges, self.arms)
        return observations, qpos[:, 6].copy()

    def _checked(self, actions: np.ndarray) -> np.ndarray:
        """Actions ``[N, 6]`` in double precision; refuses those that are not finite numbers."""
        if actions.shape != (self.num_envs, 6):
            raise ValueError(f"actions: have shape {actions.shape}, must have {self.num_envs, 6}")
        if actions.dtype.kind not in "fiu":
            raise TypeError(f"action: holds {actions.dtype}, must hold real numbers")
        finite = np.isfinite(actions).all(1)
        if not finite.all():
            door = int(np.flatnonzero(~finite)[0])
            raise ValueError(
                f"action = {actions[door].tolist()} of door {door} in step {self.step_count}: "
                "must be finite"
            )
        return actions.astype(np.float64, copy=False)

    def _check_states(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Raise FloatingPointError where a simulation, ``[N, 7]``, has diverged."""
        if not (np.abs(qpos).max() < 1e3 and np.abs(qvel).max() < 1e6):  # so it is for NaN
            sound = (np.abs(qpos) < 1e3).all(1) & (np.abs(qvel) < 1e6).all(1)
            door = int(np.flatnonzero(~sound)[0])
            raise FloatingPointError(
                f"the simulation of door {door} diverged in step {self.step_count}: "
                f"joints at {qpos[door].tolist()}"
            )
