"""How a door is pulled: with the inside of the hook, as one would expect, or with its outside.

The paper tells the strategies apart by eye (Fig. 2b, 2c). Here it is a rule on forces: of all that
the robot does to the handle in the direction of opening, which part does the inside of the hook?
The part gives an episode its strategy, and the episodes' parts give one to a policy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import mujoco
import numpy as np

from ipo.checks import Probability, checked
from ipo.worlds.door import FINGER, TUBES
from ipo.worlds.one_door import DoorEnv

# Where the inside of the hook lies, seen from a tube's axis, in the wrist's frame. The hook hangs
# on the wrist, which is at +x, and its mouth is at -y.
INSIDE = {
    "hook_0": (0, -1, 0),  # the bow
    "hook_1": (1, 0, 0),  # the side away from the wrist, which holds what is hooked
    "hook_2": (1, 1, 0),  # the tip, whose end holds, too
    "hook_3": (-1, 0, 0),  # the shank, in two pieces
    "hook_4": (-1, 0, 0),
}
HOOK, OUTSIDE = 0.8, 0.2  # from which and up to which part of the impulse a strategy is named
MOST = 2 / 3  # of its doors a policy opens in a way that is called its own


def pulling_forces(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[float, float]:
    """Forces on the handle along its opening, in N: by the inside of the hook, and by all else.

    Only contacts that help to open count.
    """
    wrist, handle = model.body("wrist").id, model.body("handle").id
    R, origin = data.xmat[wrist].reshape(3, 3), data.xpos[wrist]
    inside = other = 0.0
    for number, contact in enumerate(data.contact):
        bodies = model.geom_bodyid[contact.geom]
        if set(bodies) != {wrist, handle}:
            continue
        wrench = np.zeros(6)
        mujoco.mj_contactForce(model, data, number, wrench)
        # It acts on the second geom, in the frame of the contact, whose axes are rows.
        force = contact.frame.reshape(3, 3).T @ wrench[:3]
        on_handle = force if bodies[1] == handle else -force
        from_hinge = contact.pos - data.xanchor[-1]
        opening = np.array([-from_hinge[1], from_hinge[0], 0.0])
        pull = float(on_handle @ opening / np.linalg.norm(opening))
        if pull <= 0:
            continue
        geom = model.geom(contact.geom[list(bodies).index(wrist)]).name
        if is_inside(geom, R.T @ (contact.pos - origin)):
            inside += pull
        else:
            other += pull
    return inside, other


def is_inside(geom: str, point: np.ndarray) -> bool:
    """Whether a point on the surface of a geom, in the wrist's frame, faces the hook's inside."""
    if geom not in INSIDE:
        return False
    start, end = (FINGER + corner for corner in TUBES[int(geom.removeprefix("hook_"))])
    along = np.clip((point - start) @ (end - start) / ((end - start) @ (end - start)), 0, 1)
    center = start + along * (end - start)
    return bool((point - center) @ INSIDE[geom] > 0)


@checked
def strategy(
    env: DoorEnv, act: Callable[[np.ndarray], np.ndarray], observation: np.ndarray
) -> tuple[str, float]:
    """The strategy of an episode, from its beginning until the door is open.

    Args:
        env: the door, after ``reset``.
        act: from an observation to an action.
        observation: what ``reset`` returned.

    Returns:
        ``hook``, ``outside`` or ``mixed``, and the part of the pulling impulse that the inside of
        the hook had; ``failed`` and NaN where the door was not opened.
    """
    impulse = np.zeros(2)
    while True:
        observation, _, _, truncated, info = env.step(act(observation))
        impulse += pulling_forces(env.model, env.data)
        if info["opened"]:
            break
        if truncated:
            return "failed", float("nan")
    part = float(impulse[0] / impulse.sum()) if impulse.any() else 0.0
    return strategy_of_part(part), part


@checked
def strategy_of_part(part: Probability) -> str:
    """The name for an episode in which the inside of the hook did so much of the pull."""
    if part >= HOOK:
        return "hook"
    return "outside" if part <= OUTSIDE else "mixed"


@checked
def strategy_of_policy(parts: Sequence[Probability]) -> str:
    """The name for a policy, from the ``parts`` of the doors that it opened."""
    names = [strategy_of_part(part) for part in parts]
    for name in ("hook", "outside"):
        if names and names.count(name) >= MOST * len(names):
            return name
    return "mixed"
