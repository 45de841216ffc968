"""Invariant Policy Optimization: the algorithms behind the reproducibility book.

An evening's reading, in this order:

    game            who owns which domains, a round of Algorithm 1, linear players, the Nash gap
    optimizers      how a player takes a step
    lqr             linear quadratic control with distractors: the problem and its exact cost
    lqr_learners    the four methods of the paper's LQR tables, as that game
    distributions   what a network's outputs say of actions
    networks        policies and critics, and the average of several players' outputs
    network_players players whose outputs are averaged: how each takes a step
    rollouts        experience in many environments at once, and advantages
    ppo             PPO, IPO and the ensemble: that game between networks

Then, as you need them:

    own_domains     the same for environments of your own
    stats           intervals and comparisons over runs
    causality       causal models, invariant predictors, IRM-Games, ICP, games of two numbers
    worlds          coloured keys, a maze, doors, and networks for tables of what is seen
    dense_in_numpy  a network again, written out for speed
    checks          errors that name the parameter, its value and the rule
    notebooks       misspelt parameters of a notebook

Import what you need (``from ipo import lqr``); nothing heavy is imported here. The environments
are registered with gymnasium: ``gymnasium.make("ipo/ColoredKeys-v0", color="grey")``.
"""

from gymnasium import register

__version__ = "0.1.0"

__all__ = [
    "causality",
    "checks",
    "distributions",
    "game",
    "lqr",
    "lqr_learners",
    "network_players",
    "networks",
    "notebooks",
    "optimizers",
    "own_domains",
    "ppo",
    "rollouts",
    "stats",
    "worlds",
]

register("ipo/ColoredKeys-v0", entry_point="ipo.worlds:ColoredKeysEnv")
register("ipo/Door-v0", entry_point="ipo.worlds:DoorEnv")
