"""A controller by hand that takes the handle and pulls: it knows the door, policies do not.

It shows that the doors can be opened, what a hooking manoeuvre is, and, where the motors are too
weak for the friction, that no skill would help. It can also pull with the outside of the hook, as
some of the paper's policies do.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np

from ipo.checks import checked, one_of
from ipo.worlds.door import ANCHOR, GEAR, WRIST, DoorParams, Shift, hook_rotation, lever

# Where the handle's bar is wanted, in the wrist's frame, one place after the other. ``inside``: in
# front of the hook and beside it, level with its mouth, which opens towards -y, then in the mouth.
# ``outside``: the hook comes from the side and passes behind the bar with its back to it.
WAYPOINTS = {
    "inside": np.array([[-0.26, -0.09, 0.0], [-0.125, -0.09, 0.0], [-0.125, -0.002, 0.0]]),
    "outside": np.array([[-0.30, -0.25, 0.0], [-0.30, 0.046, 0.0], [-0.135, 0.044, 0.0]]),
}
TURNED = {"inside": 0.0, "outside": -1.5}  # the wrist about z, against the door
NEAR = 0.02  # m, or rad / 5: when to go on to the next place
AHEAD = 0.4  # rad: how far ahead of the door the hook is led when it pulls
STIFFNESS, DAMPING = 30.0, 14.0  # of the wrist's joints, which weigh 1.7 kg and 1 kg m^2


class Hooking:
    """Acts on one door: ``action = hooking(qpos, qvel)``; call ``begin`` before an episode.

    Args:
        side: of the hook that pulls, ``inside`` or ``outside``. For the latter there must be room
            behind the handle: it works where ``handle_depth`` is near its maximum.
    """

    @checked
    def __init__(self, side: Annotated[str, one_of(WAYPOINTS)] = "inside") -> None:
        self.waypoints, self.turned = WAYPOINTS[side], TURNED[side]

    @checked
    def begin(self, params: DoorParams, handle_shift: Shift) -> None:
        self.hinge, arm = lever(params, handle_shift)
        # To the bar's axis, instead of the point that is rewarded.
        to_axis = params.handle_depth - params.target_position[0]
        self.arm = arm + np.array([to_axis, 0.0, 0.0])
        self.stage = 0

    def __call__(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        """Throttles ``[6]`` of the motors for the state of the 7 joints."""
        pulling = self.stage == len(self.waypoints)
        point = self.waypoints[min(self.stage, len(self.waypoints) - 1)]
        door_angle = qpos[6] + (AHEAD if pulling else 0.0)
        slides = self._slides(door_angle, point)
        wanted = np.array([*slides, door_angle + self.turned, 0.0, 0.0])
        if not pulling:
            error = np.abs(wanted - qpos[:6]) / [1, 1, 1, 5, 5, 5]
            self.stage += bool((error < NEAR).all())
        force = STIFFNESS * (wanted - qpos[:6]) - DAMPING * qvel[:6]
        return np.clip(force / GEAR, -1, 1)

    def _slides(self, door_angle: float, point: np.ndarray) -> np.ndarray:
        """The wrist's x, y, z that bring its ``point`` to the bar of a door open by so much."""
        door = hook_rotation(np.array([door_angle, 0.0, 0.0]))
        R = hook_rotation(np.array([door_angle + self.turned, 0.0, 0.0]))
        return self.hinge + door @ self.arm - (WRIST + ANCHOR + R @ (point - ANCHOR))
