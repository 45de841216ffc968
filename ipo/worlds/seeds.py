"""One seed for many environments."""

from __future__ import annotations

import numpy as np


def seeds_of(stream: np.random.SeedSequence, number: int) -> list[int]:
    """The next ``number`` seeds of a stream.

    Gymnasium's own s, s + 1, ... would give neighbouring runs the same environments.
    """
    return [int(own.generate_state(1)[0]) for own in stream.spawn(number)]
