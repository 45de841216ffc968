"""A controller by hand that hooks the handle and pulls: it knows the door, policies do not.

It shows that the doors can be opened, what a hooking manoeuvre is, and, where the motors are too
weak for the friction, that no skill would help.
"""

from __future__ import annotations

import numpy as np

from ipo.door import ANCHOR, GEAR, WRIST, DoorParams, hook_rotation, lever

# Where the handle's bar is wanted, in the wrist's frame: in front of the hook and beside it, then
# level with its mouth, then inside. The hook opens towards -y.
WAYPOINTS = np.array([[-0.26, -0.09, 0.0], [-0.125, -0.09, 0.0], [-0.125, -0.002, 0.0]])
NEAR = 0.02  # m, or rad / 5: when to go on to the next point
AHEAD = 0.4  # rad: how far ahead of the door the hook is led when it pulls
STIFFNESS, DAMPING = 30.0, 14.0  # of the wrist's joints, which weigh 1.7 kg and 1 kg m^2


class Hooking:
    """Acts on one door: ``action = hooking(qpos, qvel)``; call ``begin`` before an episode."""

    def begin(self, params: DoorParams, handle_shift: np.ndarray) -> None:
        self.hinge, self.arm = lever(params, handle_shift)
        self.arm = self.arm.copy()
        # The bar's axis, instead of the point that is rewarded.
        self.arm[0] += params.handle_depth - params.target_position[0]
        self.stage = 0

    def __call__(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        """Throttles ``[6]`` of the motors for the state of the 7 joints."""
        pulling = self.stage == len(WAYPOINTS)
        point = WAYPOINTS[min(self.stage, len(WAYPOINTS) - 1)]
        angle = qpos[6] + (AHEAD if pulling else 0.0)
        wanted = np.concatenate([self._slides(angle, point), [angle, 0.0, 0.0]])
        if not pulling:
            error = np.abs(wanted - qpos[:6]) / [1, 1, 1, 5, 5, 5]
            self.stage += bool((error < NEAR).all())
        force = STIFFNESS * (wanted - qpos[:6]) - DAMPING * qvel[:6]
        return np.clip(force / GEAR, -1, 1)

    def _slides(self, angle: float, point: np.ndarray) -> np.ndarray:
        """The wrist's x, y, z that bring its ``point`` to the bar of a door open by ``angle``."""
        R = hook_rotation(np.array([angle, 0.0, 0.0]))
        return self.hinge + R @ self.arm - (WRIST + ANCHOR + R @ (point - ANCHOR))
