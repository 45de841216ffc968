"""Many doors at once: a ``gymnasium.vector.VectorEnv``, in this process or over several.

Each door has its own model and its own random stream, so what happens at a door depends on its
seed and on the actions there, and not on which doors stand beside it or in which process.
"""

from __future__ import annotations

import itertools
import multiprocessing
from collections.abc import Sequence
from dataclasses import asdict
from multiprocessing.connection import Connection
from typing import Any, ClassVar, NamedTuple

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.vector import AutoresetMode

from ipo.checks import check_count, check_number
from ipo.worlds.door import (
    MAX_STEPS,
    OPENED,
    TIMESTEP,
    DoorParams,
    build_door,
    check_actions,
    check_states,
    draw_start,
    lever,
    observe,
    shift_handle,
    substeps,
)


class Arrays(NamedTuple):
    """What doors read and write; a slice of it belongs to each process."""

    actions: np.ndarray  # [N, 6]
    observations: np.ndarray  # [N, 15]
    last_observations: np.ndarray  # [N, 15], before any new beginning
    rewards: np.ndarray  # [N]
    door_angles: np.ndarray  # [N], before any new beginning
    opened: np.ndarray  # [N], 1 where the door was ever open in this episode
    returns: np.ndarray  # [N], rewards of this episode so far

    @classmethod
    def of(cls, memory: Any, num_doors: int) -> Arrays:
        """Views of a buffer of ``SIZE x num_doors`` doubles."""
        flat = np.frombuffer(memory, dtype=np.float64)
        parts = np.split(flat, np.cumsum([width * num_doors for width in WIDTHS])[:-1])
        shapes = [(num_doors, width) if width > 1 else (num_doors,) for width in WIDTHS]
        return cls(*(part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)))

    def part(self, doors: slice) -> Arrays:
        return Arrays(*(array[doors] for array in self))


WIDTHS = (6, 15, 15, 1, 1, 1, 1)  # numbers for each door in Arrays
SIZE = sum(WIDTHS)


class Doors:
    """Doors in this process, stepped one after the other; episodes begin and end together.

    Args:
        arrays: where actions are found and results go.
        doors: frictions, or parameters.
        max_steps, timestep: see :class:`ipo.worlds.door.DoorEnv`.
        first: number of the first door, for messages.
    """

    def __init__(
        self,
        arrays: Arrays,
        doors: Sequence[float | DoorParams],
        max_steps: int,
        timestep: float,
        first: int,
    ) -> None:
        self.arrays, self.given, self.first = arrays, doors, first
        self.max_steps, self.timestep, self.num_substeps = max_steps, timestep, substeps(timestep)

    def reset(self, seeds: Sequence[int] | None) -> None:
        """Begin episodes; with seeds, draw the doors that are not given, too."""
        if seeds is not None:
            self.generators = [np.random.default_rng(seed) for seed in seeds]
            self._build(
                [
                    door if isinstance(door, DoorParams) else DoorParams.sample(generator, door)
                    for door, generator in zip(self.given, self.generators, strict=True)
                ]
            )
        self._begin()

    def step(self, _: None = None) -> None:
        """One step of every door, and a new beginning after the last one of the episode.

        What is said of the episode then still is that of the one which is over.
        """
        arrays = self.arrays
        check_actions(arrays.actions, self.step_count, self.first)
        if self.step_count == 0:
            arrays.opened[:] = arrays.returns[:] = 0
        arrays.rewards[:] = self.next_rewards
        for ctrl, action in zip(self.ctrls, arrays.actions, strict=True):
            ctrl[:] = action
        for model, data in zip(self.models, self.data, strict=True):
            mujoco.mj_step(model, data, self.num_substeps)
        self.step_count += 1
        self._look()
        arrays.returns[:] += arrays.rewards
        np.maximum(arrays.opened, np.abs(arrays.door_angles) >= OPENED, out=arrays.opened)
        if self.step_count == self.max_steps:
            angles = arrays.door_angles.copy()
            arrays.last_observations[:] = arrays.observations
            self._begin()
            arrays.door_angles[:] = angles

    def state(self, _: None = None) -> dict[str, Any]:
        """All that the future depends on, as arrays and plain values."""
        return {
            "doors": [asdict(params) for params in self.params],
            "generators": [generator.bit_generator.state for generator in self.generators],
            "step_count": self.step_count,
            "shifts": self.shifts,
            "physics": np.stack(
                [np.concatenate([data.qpos, data.qvel, data.qacc_warmstart]) for data in self.data]
            ),
            "episode": np.stack([self.arrays.opened, self.arrays.returns]),
        }

    def restore(self, state: dict[str, Any]) -> None:
        self._build([DoorParams(**params) for params in state["doors"]])
        self.generators = [np.random.default_rng() for _ in self.params]
        for generator, own in zip(self.generators, state["generators"], strict=True):
            generator.bit_generator.state = own
        for data, own in zip(self.data, np.asarray(state["physics"]), strict=True):
            data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = np.split(own, 3)
        self.step_count = state["step_count"]
        self._place(np.asarray(state["shifts"]))
        self.arrays.opened[:], self.arrays.returns[:] = np.asarray(state["episode"])

    def _build(self, params: list[DoorParams]) -> None:
        self.params = params
        self.models = [build_door(own, self.timestep).compile() for own in params]
        self.data = [mujoco.MjData(model) for model in self.models]
        # Views of MuJoCo's memory: to ask for them anew in each step would cost as much as a step.
        self.ctrls = [data.ctrl for data in self.data]
        self.qpos = [data.qpos for data in self.data]
        self.qvel = [data.qvel for data in self.data]

    def _begin(self) -> None:
        shifts = []
        for model, data, generator in zip(self.models, self.data, self.generators, strict=True):
            mujoco.mj_resetData(model, data)
            data.qpos[:], shift = draw_start(generator)
            shifts.append(shift)
        self.step_count = 0
        self._place(np.array(shifts))

    def _place(self, shifts: np.ndarray) -> None:
        """Shift the handles, and look."""
        self.shifts = shifts
        for model, params, shift in zip(self.models, self.params, shifts, strict=True):
            shift_handle(model, params, shift)
        levers = [lever(params, shift) for params, shift in zip(self.params, shifts, strict=True)]
        self.hinges, self.arms = (np.stack(part) for part in zip(*levers, strict=True))
        self._look()

    def _look(self) -> None:
        qpos, qvel = np.array(self.qpos), np.array(self.qvel)
        check_states(qpos, qvel, self.step_count, self.first)
        observations, self.next_rewards = observe(qpos, qvel, self.hinges, self.arms)
        self.arrays.observations[:] = observations
        self.arrays.door_angles[:] = qpos[:, 6]


class WorkerError(RuntimeError):
    """A process that simulates doors has ended before its time."""


class VectorDoor(gym.vector.VectorEnv):
    """N doors, each as ``ipo/Door-v0``: the same seed and the same actions, the same episode.

    Episodes of all doors end together, at the time limit, and begin anew in the same step
    (``AutoresetMode.SAME_STEP``). ``info`` holds ``door_angle``, ``opened`` and
    ``episode_return`` so far, each ``[N]``; where episodes have ended they are those of the old
    episodes, and ``final_obs`` is there, too. ``episodes`` keeps ``(episode_return, opened)`` of
    all that ended until somebody clears it, ``frictions`` the domain of each door.

    Args:
        doors: for each door its friction, then the door is drawn from its seed; or its parameters.
        num_workers: processes beside this one that simulate; 0: none. In a script, more than 0
            needs the usual ``if __name__ == "__main__":``.
        max_steps, timestep: see :class:`ipo.worlds.door.DoorEnv`.

    Raises:
        TypeError, ValueError: no doors, more workers than doors, a friction or a number that makes
            no sense, actions of another shape or not finite.
        FloatingPointError: a simulation that diverges.
        WorkerError: a worker has ended. The others are ended, too.
    """

    metadata: ClassVar[dict[str, Any]] = {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self,
        doors: Sequence[float | DoorParams],
        num_workers: int = 0,
        max_steps: int = MAX_STEPS,
        timestep: float = TIMESTEP,
    ) -> None:
        doors = list(doors)
        check_count("the number of doors", len(doors))
        check_count("num_workers", num_workers, minimum=0)
        check_count("max_steps", max_steps)
        check_number("timestep", timestep, above=0)
        if num_workers > len(doors):
            raise ValueError(f"num_workers = {num_workers}: must be at most {len(doors)} doors")
        self.frictions = [
            (door if isinstance(door, DoorParams) else DoorParams(friction=door)).friction
            for door in doors
        ]
        self.num_envs = len(doors)
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (15,), np.float64)
        self.single_action_space = gym.spaces.Box(-1.0, 1.0, (6,), np.float32)
        self.observation_space = gym.vector.utils.batch_space(
            self.single_observation_space, self.num_envs
        )
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, self.num_envs)
        self.max_steps = max_steps
        self.step_count: int | None = None
        self.episodes: list[tuple[np.ndarray, np.ndarray]] = []

        memory = multiprocessing.RawArray("d", SIZE * self.num_envs) if num_workers else None
        self.arrays = Arrays.of(memory or bytearray(8 * SIZE * self.num_envs), self.num_envs)
        bounds = np.linspace(0, self.num_envs, max(num_workers, 1) + 1).round().astype(int)
        self.slices = [slice(int(a), int(b)) for a, b in itertools.pairwise(bounds)]
        options = (max_steps, timestep)
        if num_workers:
            self.parts = [
                _Worker(memory, self.num_envs, own, doors[own], *options) for own in self.slices
            ]
        else:
            self.parts = [_Here(Doors(self.arrays, doors, *options, first=0))]

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin episodes. A seed is a list of one for each door; one number is spread over them.

        Without a seed, doors and random streams stay; at the first reset they are drawn anew.
        """
        if seed is None and self.step_count is None:
            seed = int(np.random.SeedSequence().generate_state(1)[0])
        if seed is not None and not isinstance(seed, Sequence):
            streams = np.random.SeedSequence(seed).spawn(self.num_envs)
            seed = [int(stream.generate_state(1)[0]) for stream in streams]
        if seed is not None and len(seed) != self.num_envs:
            raise ValueError(f"seed: names {len(seed)} seeds, must be {self.num_envs}, one a door")
        self._ask("reset", [seed and list(seed[own]) for own in self.slices])
        self.step_count = 0
        return self.arrays.observations.copy(), {"door_angle": self.arrays.door_angles.copy()}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        if self.step_count is None:
            raise gym.error.ResetNeeded("reset() must come before step()")
        if np.shape(actions) != self.arrays.actions.shape:
            raise ValueError(
                f"actions have shape {np.shape(actions)}, must be {self.arrays.actions.shape}"
            )
        self.arrays.actions[:] = actions
        self._ask("step")
        self.step_count = (self.step_count + 1) % self.max_steps
        arrays = self.arrays
        info = {
            "door_angle": arrays.door_angles.copy(),
            "opened": arrays.opened > 0,
            "episode_return": arrays.returns.copy(),
        }
        truncated = np.full(self.num_envs, self.step_count == 0)
        if self.step_count == 0:
            info["final_obs"] = arrays.last_observations.copy()
            self.episodes.append((info["episode_return"], info["opened"]))
        never = np.zeros(self.num_envs, bool)
        return arrays.observations.copy(), arrays.rewards.copy(), never, truncated, info

    def state(self) -> dict[str, Any]:
        """All that the future of the doors depends on; for :meth:`restore`."""
        return {"step_count": self.step_count, "parts": self._ask("state")}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from ``state()`` of a vector of as many doors and workers."""
        self.step_count = state["step_count"]
        self._ask("restore", state["parts"])

    def close_extras(self, **_: Any) -> None:
        for part in self.parts:
            part.close()

    def _ask(self, method: str, arguments: Sequence[Any] | None = None) -> list[Any]:
        """Call a method of all parts at the same time."""
        if self.closed:
            raise gym.error.ClosedEnvironmentError("the doors are closed")
        try:
            for part, argument in zip(
                self.parts, arguments or [None] * len(self.parts), strict=True
            ):
                part.send(method, argument)
            return [part.receive() for part in self.parts]
        except BaseException:
            self.close()
            raise


class _Here:
    """Doors in this process, asked like those of a worker."""

    def __init__(self, doors: Doors) -> None:
        self.doors = doors

    def send(self, method: str, argument: Any) -> None:
        self.reply = getattr(self.doors, method)(argument)

    def receive(self) -> Any:
        return self.reply

    def close(self) -> None:
        pass


class _Worker:
    """Doors in a process of their own, which ends with this one."""

    def __init__(
        self, memory: Any, num_doors: int, own: slice, doors: list, max_steps: int, timestep: float
    ) -> None:
        # A process that starts from nothing: a copy of this one could hold locks of its threads.
        context = multiprocessing.get_context("spawn")
        self.name = f"the worker of doors {own.start} to {own.stop - 1}"
        self.pipe, end = context.Pipe()
        arguments = (end, memory, num_doors, own, doors, max_steps, timestep)
        self.process = context.Process(target=_work, args=arguments, daemon=True)
        self.process.start()
        end.close()  # the worker's end: only so does its death end the pipe

    def send(self, method: str, argument: Any) -> None:
        try:
            self.pipe.send((method, argument))
        except OSError as error:
            raise self._died() from error

    def receive(self) -> Any:
        try:
            reply = self.pipe.recv()
        except (EOFError, OSError) as error:
            raise self._died() from error
        if isinstance(reply, Exception):
            raise reply
        return reply

    def close(self) -> None:
        self.pipe.close()
        self.process.join(timeout=1)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()

    def _died(self) -> WorkerError:
        self.process.join(timeout=1)
        return WorkerError(f"{self.name} ended with exit code {self.process.exitcode}")


def _work(
    pipe: Connection,
    memory: Any,
    num_doors: int,
    own: slice,
    doors: list,
    max_steps: int,
    timestep: float,
) -> None:
    """Answer until the other end of the pipe is closed, be it because its process has died."""
    fleet = Doors(Arrays.of(memory, num_doors).part(own), doors, max_steps, timestep, own.start)
    while True:
        try:
            method, argument = pipe.recv()
        except (EOFError, KeyboardInterrupt):
            return
        try:
            reply = getattr(fleet, method)(argument)
        except Exception as error:
            reply = error
        pipe.send(reply)
