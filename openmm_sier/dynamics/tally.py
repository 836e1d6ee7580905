"""Bookkeeping of heat, random numbers and counts of a run."""

# Without this, annotations would import numpy.random, which is slow.
from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from openmm_sier.dynamics.noise import generator


class Mark(NamedTuple):
    """Heat, kJ/mol, and number of draws at a point of a run."""

    heat: float
    draws: int


class Tally:
    """Heat and random numbers of a run, and counts of its ensemble.

    Operators and ensembles update the tally as they act. Undoing their actions includes restoring an earlier mark.

    Attributes:
        heat: energy from baths and moves, as opposed to forces, kJ/mol.
        seed: determines all random numbers together with `draws`; 0 until a seed is chosen.
        draws: number of draws of random numbers.
        counts: counts of the ensemble, by name.
    """

    def __init__(self, seed: int = 0, counts: Iterable[str] = ()):
        self.seed = seed
        self.counts = dict.fromkeys(counts, 0.0)
        self.clear()

    def clear(self) -> None:
        """Reset heat, draws and counts; keep the seed."""
        self.heat = 0.0
        self.draws = 0
        self.counts = dict.fromkeys(self.counts, 0.0)

    def noise(self, stream: int = 0) -> np.random.Generator:
        """Return the generator of the present draw, see `noise.generator`; it is valid until the next call."""
        return generator(self.seed, self.draws, stream)

    def mark(self) -> Mark:
        """Return the present heat and draws."""
        return Mark(self.heat, self.draws)

    def restore(self, mark: Mark) -> None:
        """Restore heat and draws of a mark."""
        self.heat = mark.heat
        self.draws = mark.draws
