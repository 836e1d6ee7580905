"""The largest box in which hybrid Monte Carlo accepts a fraction of its trials.

Molecules that are far from each other contribute to the energy error independently, so its variance is proportional to
their number; `openmm_sier.dynamics.metropolis` computes the acceptance that follows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from openmm_sier.dynamics.metropolis import spread_at


class Spread(NamedTuple):
    """Standard deviation of the energy error for one molecule, kT, and its standard error.

    For n molecules it is sqrt(n) times as large.
    """

    value: float
    error: float


def pooled(molecules: Sequence[int], trials: Sequence[int], spreads: Sequence[float]) -> Spread:
    """The spread for one molecule from those of boxes of several sizes, weighted by their numbers of trials.

    Args:
        molecules: of each box.
        trials: of each box, at least 2.
        spreads: standard deviation of the energy error in each box, kT.
    """
    freedom = [n - 1 for n in trials]
    squares = math.fsum(f * s * s / n for f, s, n in zip(freedom, spreads, molecules, strict=True))
    value = math.sqrt(squares / sum(freedom))
    return Spread(value, value / math.sqrt(2 * sum(freedom)))


def largest_box(spread: Spread, accepted: float = 0.5) -> tuple[float, float]:
    """Number of molecules at which this fraction of trials is accepted, and its standard error."""
    molecules = (spread_at(accepted) / spread.value) ** 2
    return molecules, 2 * molecules * spread.error / spread.value
