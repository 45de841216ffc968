"""Invariant Policy Optimization: the algorithms behind the reproducibility book.

Import the module that you need (``from ipo import lqr``); nothing heavy is imported here.
"""

__version__ = "0.1.0"
