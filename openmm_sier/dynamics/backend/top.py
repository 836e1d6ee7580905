"""Principal moments in the form that the free rotation takes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

#: Relative difference of the two moments of a linear body that is taken for rounding.
EQUAL_MOMENTS = 1e-9


@dataclass(frozen=True, eq=False)
class Top:
    """Inverse moments in descending order, and the permutation to it from the user's order of principal axes.

    Attributes:
        rates: (3,) for bodies with equal moments, or (3, n); zeros for a point, three equal rates for a line.
        order: of the same shape; row i of the sorted frame is row order[i] of the user's.
        parity: () or (n,), the sign that the middle axis takes, so that the sorted frame stays right-handed.
    """

    rates: np.ndarray
    order: np.ndarray
    parity: np.ndarray

    @cached_property
    def shared(self) -> bool:
        """Whether all bodies have the same moments."""
        return self.rates.ndim == 1

    @cached_property
    def turns(self) -> bool:
        """Whether any body can turn, that is, whether not all are points."""
        return bool(self.rates.any())

    @cached_property
    def frame(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Equal moments for compiled loops."""
        return self.rates, self.order, float(self.parity)

    def part(self, index: slice | np.ndarray) -> Top:
        """The moments of some of the bodies."""
        return self if self.shared else Top(self.rates[:, index], self.order[:, index], self.parity[index])

    def sort(self, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Components (x, y, z) in the sorted frame of vectors (3, n), or rows of matrices (3, 3, n)."""
        if self.shared:
            x, y, z = (v[row] for row in self.order)
        else:
            x, y, z = np.take_along_axis(v, self._order_like(v), axis=0)
        return x, y * self.parity, z

    def unsort(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The inverse of `sort`: components in the user's frame."""
        v = x, y * self.parity, z
        if self.shared:
            rows = dict(zip(self.order.tolist(), v, strict=True))
            return rows[0], rows[1], rows[2]
        unsorted = np.empty((3, *x.shape))
        np.put_along_axis(unsorted, self._order_like(unsorted), np.stack(v), axis=0)
        return tuple(unsorted)

    def _order_like(self, v: np.ndarray) -> np.ndarray:
        return self.order if v.ndim == 2 else self.order[:, None]


def top(moments: np.ndarray) -> Top:
    """Prepare principal moments for the free-rotation maps.

    Args:
        moments: (3,), or (3, n) for a set of moments per body, in any order, dalton nm^2. A point has three zeros, a
            line exactly one zero and two equal moments.

    Raises:
        ValueError: a moment is negative or not finite, or a body has two zeros, or one zero and unequal others.

    >>> top((2.0, 4.0, 1.0)).rates.tolist()
    [1.0, 0.5, 0.25]
    """
    moments = np.asarray(moments, dtype=float)
    if moments.ndim not in (1, 2) or moments.shape[0] != 3:
        raise ValueError(f"moments must have shape (3,) or (3, n), got {moments.shape}")
    return _shared_by_all(*moments.tolist()) if moments.ndim == 1 else _sorted(moments)


@lru_cache(maxsize=256)
def _shared_by_all(x: float, y: float, z: float) -> Top:
    return _sorted(np.array([x, y, z]))


def _sorted(moments: np.ndarray) -> Top:
    bad = ~(np.isfinite(moments) & (moments >= 0))
    if bad.any():
        body = f" for body {np.argwhere(bad)[0][1]}" if bad.ndim == 2 else ""
        raise ValueError(f"moments must be finite and not negative, got {moments[bad][0]}{body}")
    order = np.argsort(moments, axis=0, kind="stable")
    low, mid, high = np.take_along_axis(moments, order, axis=0)
    linear = (low == 0) & (high > 0)
    unequal = linear & (high - mid > EQUAL_MOMENTS * high)
    if unequal.any():
        raise ValueError(
            "a body with one zero moment is linear and its other two must be equal, got "
            f"{moments.T[unequal].tolist() if moments.ndim == 2 else moments.tolist()}"
        )
    # A line does not turn about itself, so that any rate about its axis will do.
    with np.errstate(divide="ignore"):
        rates = np.where(high > 0, 1 / np.stack([np.where(linear, mid, low), mid, high]), 0.0)
    if not np.isfinite(rates).all():
        raise ValueError(f"moments are too small to be inverted: {moments.min()}")
    # A permutation is odd when its cyclic successor differences are -1 (mod 3).
    parity = np.where((order[1] - order[0]) % 3 == 1, 1.0, -1.0)
    return Top(rates, order, parity)
