"""Invariant Policy Optimization: the algorithms behind the reproducibility book.

Import the module that you need (``from ipo import lqr``); nothing heavy is imported here. The
environments are registered with gymnasium: ``gymnasium.make("ipo/ColoredKeys-v0", color="grey")``.
"""

from gymnasium import register

__version__ = "0.1.0"

register("ipo/ColoredKeys-v0", entry_point="ipo.worlds.colored_keys:ColoredKeysEnv")
register("ipo/Door-v0", entry_point="ipo.worlds.door:DoorEnv")
