"""The rules that decide claims of the paper: pure functions of rows of results.

A rule gets the cells of our results, the paper's numbers and the claim's settings, and returns a
``Finding``. It raises ``NoData`` where a cell that it needs is missing or incomplete. Verdicts and
the decision table are in ``verdicts``; ``comparisons`` has the rules of all chapters, the other
modules those of one.
"""

from rules import background, comparisons, door, keys, lqr
from rules.cells import Cells, NoData
from rules.verdicts import (
    CONTRADICTED,
    EXPLAINED,
    IN_PART,
    NO_DATA,
    REPRODUCED,
    UNDECIDED,
    Finding,
)

__all__ = [
    "CONTRADICTED",
    "EXPLAINED",
    "IN_PART",
    "NO_DATA",
    "REPRODUCED",
    "RULES",
    "UNDECIDED",
    "Cells",
    "Finding",
    "NoData",
]

RULES = {
    rule.__name__: rule
    for rule in (
        lqr.cells_come_back,
        lqr.significantly_lower,
        lqr.no_benefit,
        lqr.largely_similar,
        lqr.overfits,
        lqr.ignores,
        lqr.ahead_in_the_worst,
        lqr.tends_to_oracle,
        comparisons.means_come_back,
        comparisons.spreads_come_back,
        comparisons.better,
        comparisons.because_of_the_game,
        keys.smaller_spread,
        keys.not_better,
        keys.degrades,
        door.most_policies,
        door.more_often,
        door.viable,
        door.hooks_are_robust,
        background.game_beside,
        background.game_varies_less,
        background.equilibria_are_invariant,
        background.relu_equilibria,
    )
}
