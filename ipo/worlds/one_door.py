"""One door as a gymnasium environment: of many doors, the case in which there is one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import gymnasium as gym
import numpy as np

from ipo.checks import Count, Positive, Seed, checked
from ipo.worlds.door import MAX_STEPS, TIMESTEP, DoorParams
from ipo.worlds.many_doors import VectorDoor


class Picture(Protocol):
    """What draws a door; how it looks is no business of the simulation."""

    def frame(self, qpos: np.ndarray, handle_shift: np.ndarray) -> np.ndarray:
        """A picture ``[height, width, 3]`` of the joints ``[7]``."""

    def close(self) -> None: ...


class DoorEnv(gym.Env):
    """One door, which stays the same until ``reset`` is given a seed. ``ipo/Door-v0``.

    An episode ends at the time limit only: after ``max_steps`` steps ``truncated`` is true. The
    reward of a step is that of the state in which the action was chosen.

    ``info["door_angle"]`` is in radians; ``info["opened"]`` says whether the door was ever
    0.2 open in this episode.

    Args:
        friction: of the hinge, in N m: the domain.
        params: the door; without it, a random one is drawn at the first reset and at every reset
            with a seed. The seed also decides how episodes begin.
        max_steps: the horizon T.
        timestep: in s; an action lasts for 0.02 s, whatever it is.
        render_mode: ``rgb_array`` or none.
        draw: from a door to what makes its pictures; ``rgb_array`` needs it.

    Attributes:
        params: the door, once ``reset`` has drawn it.
        model: of MuJoCo.
        data: of MuJoCo, the state.
        handle_shift: of the handle along y and z in this episode, in m.

    Raises:
        TypeError, ValueError: a friction, a door or a horizon that makes no sense, friction and
            ``params`` together, ``rgb_array`` without ``draw``, actions that are not finite.
        FloatingPointError: a simulation that diverges.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012  (as gymnasium)

    @checked
    def __init__(
        self,
        friction: float | None = None,
        params: DoorParams | None = None,
        max_steps: Count = MAX_STEPS,
        timestep: Positive = TIMESTEP,
        render_mode: str | None = None,
        draw: Callable[[DoorParams], Picture] | None = None,
    ) -> None:
        if friction is not None and params is not None:
            raise ValueError(f"friction = {friction!r}: must not be given beside params")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode = {render_mode!r}: must be 'rgb_array' or None")
        if render_mode is not None and draw is None:
            raise ValueError(f"render_mode = {render_mode!r}: must come with draw")
        self.max_steps, self.render_mode, self.draw = max_steps, render_mode, draw
        # A step more than an episode has: many doors begin anew by themselves, this one does not.
        self.doors = VectorDoor([params or friction or 0.0], max_steps + 1, timestep)
        self.observation_space = self.doors.single_observation_space
        self.action_space = self.doors.single_action_space
        self.params: DoorParams | None = None
        self._picture: Picture | None = None

    @property
    def step_count(self) -> int:
        return self.doors.step_count

    @checked
    def reset(
        self, *, seed: Seed | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        (observation,), info = self.doors.reset(seed=None if seed is None else [seed])
        if self.params is not self.doors.params[0]:
            self.close()
        self.params, self.handle_shift = self.doors.params[0], self.doors.handle_shifts[0]
        self.model, self.data = self.doors.models[0], self.doors.data[0]
        return observation, self._info(info)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        if self.step_count >= self.max_steps:
            raise gym.error.ResetNeeded("the episode has ended: reset() must come before step()")
        if np.shape(action) != self.action_space.shape:
            raise ValueError(f"action: has shape {np.shape(action)}, must have (6,)")
        (observation,), (reward,), _, _, info = self.doors.step(np.asarray(action)[None])
        ended = self.step_count == self.max_steps
        return observation, float(reward), False, ended, self._info(info)

    def render(self) -> np.ndarray | None:
        """A picture of the present state; none without a ``render_mode``."""
        if self.draw is None or self.render_mode is None:
            return None
        if self.params is None:
            raise gym.error.ResetNeeded("reset() must come before render()")
        if self._picture is None:
            self._picture = self.draw(self.params)
        return self._picture.frame(self.data.qpos, self.handle_shift)

    def close(self) -> None:
        if self._picture is not None:
            self._picture.close()
            self._picture = None

    def _info(self, info: dict[str, Any]) -> dict[str, Any]:
        return {"door_angle": float(info["door_angle"][0]), "opened": bool(self.doors.opened[0])}
