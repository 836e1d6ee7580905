"""Count the heat, the random numbers and the moves of a run."""

# Without this, annotations would import numpy.random, which is slow.
from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from openmm_sier.dynamics.noise import generator


class Mark(NamedTuple):
    """Heat, kJ/mol, and number of draws at one moment."""

    heat: float
    draws: int


class Ledger:
    """Heat and random numbers of one run, and what its ensemble counts.

    Operators and ensembles write here as they act. Whoever undoes what they did also brings the ledger back to its mark
    of before.

    Attributes:
        heat: energy that baths and moves have given to the bodies, and forces have not, kJ/mol.
        seed: fixes, with the number of draws, all random numbers; 0 before one was chosen.
        draws: how often random numbers were drawn.
        counts: what the ensemble counts, by name.
    """

    def __init__(self, seed: int = 0, counts: Iterable[str] = ()):
        self.seed = seed
        self.counts = dict.fromkeys(counts, 0.0)
        self.clear()

    def clear(self) -> None:
        """Begin to count anew; the seed stays."""
        self.heat, self.draws = 0.0, 0
        self.counts = dict.fromkeys(self.counts, 0.0)

    def noise(self, stream: int = 0) -> np.random.Generator:
        """Return the random numbers of the present draw, see `noise.generator`; they are valid until the next call."""
        return generator(self.seed, self.draws, stream)

    def mark(self) -> Mark:
        """Return heat and draws of now."""
        return Mark(self.heat, self.draws)

    def go_back(self, mark: Mark) -> None:
        """Bring heat and draws back to a mark."""
        self.heat, self.draws = mark
