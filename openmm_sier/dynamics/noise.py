"""Random numbers that are a function of a seed and of counters alone, so that a restart draws the same ones."""

# Without this, annotations would import numpy.random, which is slow.
from __future__ import annotations

import numpy as np


def generator(seed: int, draw: int, stream: int = 0) -> np.random.Generator:
    """A fresh generator for one draw.

    Args:
        seed: of the run, 0 <= seed < 2^128.
        draw: number of earlier draws.
        stream: distinguishes users of one seed: 0 is the thermostat, 1 the volume move, 2 the decision on a trial,
            3 the momentum of the centre of mass, 4 velocities that users ask for.

    >>> bool(generator(1, 5).random() == generator(1, 5).random())
    True
    >>> bool(generator(1, 5).random() == generator(1, 6).random())
    False
    """
    return np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, draw, stream]))
