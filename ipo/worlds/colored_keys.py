"""The paper's coloured keys (Section 5.2): fetch the key, unlock the door, reach the goal.

A domain is the colour of key and door. The task is MiniGrid's own ``DoorKeyEnv`` with the
colour as an argument; grid, rules, view, reward and horizon are MiniGrid's.
"""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any

from minigrid.core.constants import COLOR_TO_IDX
from minigrid.core.world_object import Door
from minigrid.envs.doorkey import DoorKeyEnv

from ipo.checks import Count, check_count, checked, one_of

COLORS = tuple(COLOR_TO_IDX)  # red, green, blue, purple, yellow, grey: codes 0 to 5
SMALLEST = 5  # two rooms of one column each


class ColoredKeysEnv(DoorKeyEnv):
    """A room with a key, a locked door of the same colour, and a room with the goal.

    Registered as ``ipo/ColoredKeys-v0``. Observations are MiniGrid's: ``image [7, 7, 3]``, the
    view ahead of the agent with occlusion, as codes of object, colour and state. Note two
    coincidences of codes: walls are grey, and the goal is green.

    Args:
        size: rows and columns with the outer walls; the paper trains on 5 and draws 12.
        color: one of ``COLORS``; the paper trains on red and green and tests on grey.
        max_steps: horizon T; ``10 size^2`` by default, the paper's 250 for size 5. Reaching
            the goal in step t is worth ``1 - 0.9 t / T``.
        kwargs: of ``minigrid.MiniGridEnv``, such as ``render_mode="rgb_array"``.

    Raises:
        TypeError, ValueError: a size below 5 or not whole, an unknown colour.
    """

    @checked
    def __init__(
        self,
        size: Annotated[int, partial(check_count, minimum=SMALLEST)] = 5,
        color: Annotated[str, one_of(COLORS)] = "grey",
        max_steps: Count | None = None,
        **kwargs: Any,
    ) -> None:
        self.color = color
        super().__init__(size=size, max_steps=max_steps, **kwargs)

    def _gen_grid(self, width: int, height: int) -> None:
        super()._gen_grid(width, height)
        for thing in self.grid.grid:
            if thing is not None and thing.type in ("key", "door"):
                thing.color = self.color

    @property
    def progress(self) -> int:
        """1 with the key in hand, 2 once the door is unlocked, 0 before."""
        (door,) = (thing for thing in self.grid.grid if isinstance(thing, Door))
        return int(self.carrying is not None) if door.is_locked else 2
