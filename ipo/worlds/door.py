"""The paper's door (Section 5.3): a floating hook pulls a door open by its handle, in MuJoCo.

A domain is the friction of the hinge. Robot, doors, reward and the distribution of what is random
are those of DoorGym (Urakami et al., 2019), rebuilt from primitive shapes; lengths are in metres,
angles in radians, masses in kilograms. The door hangs in the plane x = 0 and opens towards the
robot, which hovers at x = 1; y points along the wall and z up; there is no gravity.

The state is that of 7 joints: the wrist's x, y, z, its angles about z, y and x, and the door's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from typing import Annotated, Any

import mujoco
import numpy as np

from ipo.checks import Positive, check_number, checked

TIMESTEP, NUM_SUBSTEPS = 0.004, 5  # 50 actions a second; the published runs simulate 0.001 x 20
MAX_STEPS = 512  # an episode lasts 10.24 s
OPENED = 0.2  # a door that was ever so far open counts as a success

WRIST = np.array([1.0, 0.0, 1.2])  # where the wrist is when all joints are 0
ANCHOR = np.array([-0.06416, 0.0, 0.00526])  # of the wrist's three hinges, in the wrist's frame
FINGERTIP = np.array([-0.15989, 0.0, 0.0])  # in the wrist's frame
FINGER = np.array([-0.06, -0.02, 0.0])  # frame in which the tubes of the hook are given
TUBES = (  # from, to: the axes of the hook, a round tube
    ((-0.055, 0.045, 0.0), (-0.095, 0.045, 0.0)),
    ((-0.1, 0.0405, 0.0), (-0.1, -0.0005, 0.0)),
    ((-0.095, -0.005, 0.0), (-0.085, -0.005, 0.0)),
    ((-0.0505, 0.04, 0.0), (-0.0495, 0.026, 0.0)),
    ((-0.0495, 0.026, 0.0), (-0.034, 0.008, 0.0)),
)
TUBE_RADIUS = 0.005
WRIST_MASS, HANDLE_MASS = 0.657, 1.1
GEAR = 2.0  # newtons, or newton metres, of a motor at full throttle

JOINTS = ("slide_x", "slide_y", "slide_z", "turn_z", "turn_y", "turn_x")
AXES = ((1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 1), (0, 1, 0), (1, 0, 0))
RANGES = ((-3, 3), (-3, 3), (-3, 3), (-1.57, 1.57), (-1.57, 1.57), (0, 3.13))

# Where an episode begins: five joints, the last one, and the handle's shift in y and in z.
START_LOW = np.array([-0.3] * 5 + [0.0] + [-0.10, -0.15])
START_HIGH = np.array([0.3] * 5 + [3.13] + [0.15, 0.0])

Shift = Annotated[Sequence[float] | np.ndarray, "2"]  # of a handle along y and z, in m
Draw = Callable[[np.random.Generator], float]


def _size(default: float, limits: tuple[float, float], draw: Draw | None = None) -> Any:
    """A field of :class:`DoorParams`: its default, its bounds, and how a random door draws it."""
    return field(default=default, metadata={"limits": limits, "draw": draw})


def _grid(low: int, high: int, unit: float) -> Draw:
    return lambda generator: round(int(generator.integers(low, high)) * unit, 6)


def _uniform(low: float, high: float) -> Draw:
    return lambda generator: float(generator.uniform(low, high))


@dataclass(frozen=True)
class DoorParams:
    """A door. :meth:`sample` draws one; the defaults are the middle of what it draws.

    Attributes:
        friction: of the hinge, in N m: the torque below which it does not move. The domain.
        height: of the panel, in m.
        width: of the panel, in m.
        thickness: of the panel, in m.
        handle_height: above the floor, in m.
        handle_ratio: distance from the handle to the free edge, as a part of the width.
        wall_offset: of the whole door along the wall, in m.
        density: of the panel, in kg / m^3.
        hinge_damping: in N m s / rad.
        hinge_stiffness: in N m / rad.
        joint_damping: of the wrist's joints, in N s / m and N m s / rad.
        handle_diameter: of the bar, in m.
        handle_depth: distance from the door to the bar's axis, in m.
        handle_half_length: from the middle of the handle to the axis of a standoff, in m.
        handle_fillet: radius of the bend between bar and standoff, in m.
    """

    friction: float = _size(0.0, (0.0, 100.0))
    height: float = _size(2.25, (1.2, 4.0), _grid(2000, 2500, 0.001))
    width: float = _size(0.975, (0.3, 3.0), _grid(750, 1200, 0.001))
    thickness: float = _size(0.025, (0.005, 0.2), _grid(20, 30, 0.001))
    handle_height: float = _size(1.0, (0.3, 2.0), _grid(900, 1100, 0.001))
    handle_ratio: float = _size(0.15, (0.01, 0.5), _grid(10, 20, 0.01))
    wall_offset: float = _size(0.0, (-1.0, 1.0), _grid(-100, 100, 0.001))
    density: float = _size(250.0, (10.0, 10_000.0), _grid(200, 300, 1.0))
    hinge_damping: float = _size(1.5, (0.0, 100.0), _grid(10, 20, 0.1))
    hinge_stiffness: float = _size(0.15, (0.0, 100.0), _grid(10, 20, 0.01))
    joint_damping: float = _size(0.095, (0.0, 10.0), _grid(9, 11, 0.01))
    handle_diameter: float = _size(0.016, (0.005, 0.04), _uniform(0.012, 0.020))
    handle_depth: float = _size(0.095, (0.04, 0.3), _uniform(0.070, 0.120))
    handle_half_length: float = _size(0.0875, (0.05, 0.3), _uniform(0.075, 0.100))
    handle_fillet: float = _size(0.02, (0.002, 0.1), _uniform(0.008, 0.035))

    def __post_init__(self) -> None:
        for size in fields(self):
            low, high = size.metadata["limits"]
            check_number(size.name, getattr(self, size.name), least=low, most=high)
        for name in ("handle_depth", "handle_half_length"):
            if self.handle_fillet >= getattr(self, name):
                raise ValueError(
                    f"handle_fillet = {self.handle_fillet!r}: must be less than "
                    f"{name} = {getattr(self, name)!r}"
                )

    @classmethod
    @checked
    def sample(cls, generator: np.random.Generator, friction: float = 0.0) -> DoorParams:
        """A random door, which but for its friction does not depend on the friction.

        On DoorGym's grids: millimetres, whole kg / m^3, and tenths or hundredths of the others.
        The handle's four sizes are uniform over what five measured handles span. The draws follow
        the order of the fields.
        """
        draws = {size.name: size.metadata["draw"] for size in fields(cls)}
        drawn = {name: draw(generator) for name, draw in draws.items() if draw is not None}
        return cls(friction=friction, **drawn)

    @property
    def lever_arm(self) -> float:
        """Distance from the hinge to the handle along the door, in m."""
        return self.width * (1 - self.handle_ratio)

    @property
    def mass(self) -> float:
        """Of the panel, in kg."""
        return self.height * self.width * self.thickness * self.density

    @property
    def position(self) -> np.ndarray:
        """Of the door's frame, whose origin is in the panel behind the middle of the handle."""
        beside = self.wall_offset - (0.5 - self.handle_ratio) * self.width
        return np.array([1.1 * self.thickness, beside, self.handle_height])

    @property
    def handle_position(self) -> np.ndarray:
        """Of the handle's frame in the door's, before it is shifted."""
        return np.array([self.thickness / 2 - 0.006, 0.0, 0.0])

    @property
    def target_position(self) -> np.ndarray:
        """Of the point that the fingertip is rewarded to approach, in the handle's frame.

        It lies on the axis of the bar or a little inside, as far out as the middle of the bend's
        outer half.
        """
        radius = self.handle_diameter / 2
        F = self.handle_fillet
        rho = 0.97450 * (F + radius**2 / (4 * F))
        return np.array([self.handle_depth - F + rho * np.sin(np.pi / 8), 0.0, 0.0])


@checked
def substeps(timestep: Positive) -> int:
    """How many steps of the simulation an action lasts."""
    number = round(TIMESTEP * NUM_SUBSTEPS / timestep)
    if number < 1 or abs(number * timestep - TIMESTEP * NUM_SUBSTEPS) > 1e-9:
        raise ValueError(
            f"timestep = {timestep!r}: a whole number of them must make "
            f"{TIMESTEP * NUM_SUBSTEPS} s, the time of an action"
        )
    return number


@checked
def build_door(
    params: DoorParams, timestep: Positive = TIMESTEP, handle_shift: Shift = (0.0, 0.0)
) -> mujoco.MjSpec:
    """The robot in front of a door, to be compiled: bodies ``wrist``, ``door`` and ``handle``.

    Args:
        params: the door.
        timestep: in s.
        handle_shift: of the handle along y and z, in m. To shift it later, set ``body_pos`` of
            the body, never the ``geom_pos``, from which MuJoCo has built its search trees.
    """
    spec = mujoco.MjSpec()
    spec.modelname = "door"
    spec.compiler.degree = False
    spec.option.timestep = timestep
    spec.option.gravity = [0, 0, 0]
    # A simulation that diverges must show NaN, not start again silently.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    _add_wrist(spec, params)
    door = _add_panel(spec, params)
    _add_handle(door, params, handle_shift)
    return spec


def _add_wrist(spec: mujoco.MjSpec, params: DoorParams) -> None:
    wrist = spec.worldbody.add_body(name="wrist", pos=WRIST)
    wrist.explicitinertial = True
    wrist.mass, wrist.ipos, wrist.inertia = WRIST_MASS, ANCHOR, [1e-3, 1e-3, 1e-3]
    for name, axis, limits in zip(JOINTS, AXES, RANGES, strict=True):
        sliding = name.startswith("slide")
        wrist.add_joint(
            name=name,
            type=mujoco.mjtJoint.mjJNT_SLIDE if sliding else mujoco.mjtJoint.mjJNT_HINGE,
            axis=axis,
            pos=ANCHOR,
            limited=True,
            range=limits,
            armature=1.0,  # of the arm that is not there: it decides how fast the wrist can move
            damping=[params.joint_damping, 0, 0],
        )
        motor = spec.add_actuator(name=name, target=name, ctrllimited=True, ctrlrange=[-1, 1])
        motor.trntype = mujoco.mjtTrn.mjTRN_JOINT
        motor.gear[0] = GEAR

    def add(name: str, **shape: Any) -> None:
        wrist.add_geom(name=name, friction=[1, 1, 1], **shape)

    capsule = mujoco.mjtGeom.mjGEOM_CAPSULE
    for number, (start, end) in enumerate(TUBES):
        ends = [*(FINGER + start), *(FINGER + end)]
        add(f"hook_{number}", type=capsule, size=[TUBE_RADIUS, 0, 0], fromto=ends)
    ends = [-0.045, 0.0005, 0, -0.017, 0.0005, 0]
    add("wrist_back", type=capsule, size=[0.0475, 0, 0], fromto=ends)
    add(
        "wrist_front",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[0.020, 0.042, 0.022],
        pos=[-0.0785, 0.0005, 0],
    )


def _add_panel(spec: mujoco.MjSpec, params: DoorParams) -> mujoco.MjsBody:
    door = spec.worldbody.add_body(name="door", pos=params.position)
    door.add_joint(
        name="hinge",
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=[0, 0, 1],
        pos=[0, params.lever_arm, 0],
        limited=True,
        range=[0, 1.57],
        armature=1e-4,
        damping=[params.hinge_damping, 0, 0],
        stiffness=[params.hinge_stiffness, 0, 0],
        frictionloss=params.friction,
    )
    door.add_geom(
        name="panel",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[params.thickness / 2, params.width / 2, params.height / 2],
        pos=[
            0,
            (0.5 - params.handle_ratio) * params.width,
            params.height / 2 - params.handle_height,
        ],
        mass=params.mass,
    )
    return door


def _add_handle(door: mujoco.MjsBody, params: DoorParams, handle_shift: Shift) -> None:
    """A round bar on two standoffs, with a bend of two straight pieces at each end."""
    shift = np.array([0.0, *handle_shift])
    handle = door.add_body(name="handle", pos=params.handle_position + shift)
    handle.explicitinertial = True
    handle.mass, handle.ipos, handle.inertia = HANDLE_MASS, [0, 0, 0], [1e-3, 1e-3, 1e-3]
    depth, half, fillet = params.handle_depth, params.handle_half_length, params.handle_fillet
    across = fillet * np.sqrt(0.5)

    def add(name: str, start: tuple[float, float], end: tuple[float, float]) -> None:
        handle.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            size=[params.handle_diameter / 2, 0, 0],
            fromto=[start[0], 0, start[1], end[0], 0, end[1]],
            condim=4,  # with torsional friction: it decides whether the hook holds
        )

    add("handle_bar", (depth, fillet - half), (depth, half - fillet))
    for name, side in (("low", -1), ("high", 1)):
        corner = depth - fillet + across, side * (half - fillet + across)
        add(f"handle_standoff_{name}", (0.005, side * half), (depth - fillet, side * half))
        add(f"handle_bend_{name}_1", (depth - fillet, side * half), corner)
        add(f"handle_bend_{name}_2", corner, (depth, side * (half - fillet)))


# ------------------------------------------------------------- kinematics and reward, by formula


def hook_rotation(angles: np.ndarray) -> np.ndarray:
    """``R = Rz Ry Rx`` of the wrist: angles ``[..., 3]`` about z, y and x -> ``[..., 3, 3]``."""
    (cz, cy, cx), (sz, sy, sx) = _columns(np.cos(angles)), _columns(np.sin(angles))
    R = np.empty((*angles.shape, 3))
    R[..., 0, 0], R[..., 1, 0], R[..., 2, 0] = cz * cy, sz * cy, -sy
    R[..., 0, 1], R[..., 1, 1] = cz * sy * sx - sz * cx, sz * sy * sx + cz * cx
    R[..., 0, 2], R[..., 1, 2] = cz * sy * cx + sz * sx, sz * sy * cx - cz * sx
    R[..., 2, 1], R[..., 2, 2] = cy * sx, cy * cx
    return R


def _columns(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``[..., 3]`` -> three ``[...]``; ``np.moveaxis`` takes as long as the cosines."""
    return rows[..., 0], rows[..., 1], rows[..., 2]


def fingertip_position(qpos: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Of the middle of the hook's outer side: joints ``[..., 7]`` -> ``[..., 3]``."""
    return WRIST + ANCHOR + qpos[..., :3] + R @ (FINGERTIP - ANCHOR)


def target_position(door_angle: np.ndarray, hinge: np.ndarray, arm: np.ndarray) -> np.ndarray:
    """Where the handle is to be held: the hinge, and from there the arm ``[..., 3]``, turned."""
    c, s = np.cos(door_angle), np.sin(door_angle)
    x, y, z = _columns(arm)
    return hinge + np.stack([c * x - s * y, s * x + c * y, z], axis=-1)


def reward(door_angle: np.ndarray, distance: np.ndarray, R: np.ndarray) -> np.ndarray:
    """DoorGym's reward for a state::

        30 |theta| - d - ln(d^2 + 0.005) - 5 - || (e_y, e_z - theta) ||

    with theta the door's angle, d the distance from fingertip to target, and the hook's angles
    e_y = atan2(R_02, sqrt(R_12^2 + R_22^2)) and e_z = atan2(-R_01, R_00): it should be level and
    turn with the door. Moving costs nothing.
    """
    e_z = np.arctan2(-R[..., 0, 1], R[..., 0, 0])
    e_y = np.arctan2(R[..., 0, 2], np.hypot(R[..., 1, 2], R[..., 2, 2]))
    near = -distance - np.log(distance**2 + 0.005) - 5
    return 30 * np.abs(door_angle) + near - np.hypot(e_y, e_z - door_angle)


def observe(
    qpos: np.ndarray, qvel: np.ndarray, hinge: np.ndarray, arm: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Observations ``[..., 15]`` and rewards ``[...]`` of states, for one door or many.

    An observation is the wrist's 6 positions, its 6 velocities, and fingertip minus target. It
    says nothing about the door.

    Args:
        qpos, qvel: ``[..., 7]``, as in MuJoCo.
        hinge, arm: ``[..., 3]``, of :func:`lever`.
    """
    R = hook_rotation(qpos[..., 3:6])
    gap = fingertip_position(qpos, R) - target_position(qpos[..., 6], hinge, arm)
    distance = np.sqrt((gap**2).sum(-1))
    observation = np.concatenate([qpos[..., :6], qvel[..., :6], gap], axis=-1)
    return observation, reward(qpos[..., 6], distance, R)


def lever(params: DoorParams, handle_shift: Shift) -> tuple[np.ndarray, np.ndarray]:
    """The hinge's position at the handle's height, and the arm from there to the target."""
    to_hinge = np.array([0.0, params.lever_arm, 0.0])
    shift = np.array([0.0, *handle_shift])
    arm = params.handle_position + shift + params.target_position - to_hinge
    return params.position + to_hinge, arm


def draw_start(generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """How an episode begins: joints ``[7]`` at rest, and the handle's shift ``[2]``."""
    start = generator.uniform(START_LOW, START_HIGH)
    return np.append(start[:6], 0.0), start[6:]


def shift_handle(model: mujoco.MjModel, params: DoorParams, handle_shift: Shift) -> None:
    """Put a compiled door's handle in its place for an episode."""
    model.body("handle").pos = params.handle_position + np.array([0.0, *handle_shift])
