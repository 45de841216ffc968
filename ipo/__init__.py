"""Invariant Policy Optimization: the algorithms behind the reproducibility book.

Import the module that you need (``from ipo import lqr``); nothing heavy is imported here.
"""

from gymnasium import register

__version__ = "0.1.0"

register("ipo/Door-v0", entry_point="ipo.door:DoorEnv")
