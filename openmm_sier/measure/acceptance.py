"""Acceptance of hybrid Monte Carlo from the spread of energy errors, and the largest box that it allows.

Where many molecules contribute, errors are normal. <exp(-error/kT)> = 1, which holds for every map that reverses and
keeps the volume of phase space, then makes their mean half their variance in kT, and the acceptance erfc(sd/sqrt(8)).
Molecules that are far from each other contribute independently, so that the variance grows as their number.

Source: S. Gupta, A. Irbaeck, F. Karsch and B. Petersson, Phys. Lett. B 242, 437 (1990).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import NamedTuple


class Spread(NamedTuple):
    """Standard deviation of the energy error for one molecule, kT, and its standard error.

    That of n molecules is sqrt(n) times as much.
    """

    value: float
    error: float


def acceptance(spread: float) -> float:
    """Mean of min(1, exp(-error)) of normal errors with this standard deviation in kT."""
    return math.erfc(spread / math.sqrt(8))


def spread_at(accepted: float) -> float:
    """The standard deviation of energy errors in kT at which a fraction of trials is accepted; inverse of `acceptance`.

    >>> round(spread_at(0.5), 3)
    1.349
    """
    return -2 * NormalDist().inv_cdf(accepted / 2)


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
    """Number of molecules of which this fraction of trials is accepted, and its standard error."""
    molecules = (spread_at(accepted) / spread.value) ** 2
    return molecules, 2 * molecules * spread.error / spread.value
