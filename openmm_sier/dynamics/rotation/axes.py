"""Order of principal axes in free-rotation maps, and checks of their arguments."""

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

#: Largest relative difference of the two moments of a linear body.
EQUAL_MOMENTS = 1e-9


@dataclass(frozen=True, eq=False)
class Axes:
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
    def _is_sorted(self) -> bool:
        return bool((np.arange(3) == self.order.T).all())

    def sort(self, A: np.ndarray) -> np.ndarray:
        """Return attitudes (3, 3, n) with rows in the sorted frame; the same array if they are sorted."""
        if self._is_sorted:
            return A
        rows = np.take_along_axis(A, self.order.reshape(3, 1, -1), axis=0)
        rows[1] *= self.parity
        return rows

    def unsort(self, rows: np.ndarray) -> np.ndarray:
        """Return the inverse of `sort`."""
        if self._is_sorted:
            return rows
        right_handed = np.stack([rows[0], rows[1] * self.parity, rows[2]])
        return np.take_along_axis(right_handed, np.argsort(self.order, axis=0).reshape(3, 1, -1), axis=0)


def axes_of(moments: np.ndarray) -> Axes:
    """Prepare principal moments for the free-rotation maps.

    Args:
        moments: (3,), or (3, n) for a set of moments per body, in any order, dalton nm^2. A point has three zeros, a
            line exactly one zero and two equal moments.

    Raises:
        ValueError: a moment is negative or not finite, or a body has two zeros, or one zero and unequal others.

    >>> axes_of((2.0, 4.0, 1.0)).rates.tolist()
    [1.0, 0.5, 0.25]
    """
    moments = np.asarray(moments, dtype=float)
    if moments.ndim not in (1, 2) or moments.shape[0] != 3:
        raise ValueError(f"moments must have shape (3,) or (3, n), got {moments.shape}")
    return _shared_by_all(*moments.tolist()) if moments.ndim == 1 else _sorted(moments)


@lru_cache(maxsize=256)
def _shared_by_all(x: float, y: float, z: float) -> Axes:
    return _sorted(np.array([x, y, z]))


def _sorted(moments: np.ndarray) -> Axes:
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
    # A line does not turn about its axis, so that the rate about it is arbitrary.
    with np.errstate(divide="ignore"):
        rates = np.where(high > 0, 1 / np.stack([np.where(linear, mid, low), mid, high]), 0.0)
    if not np.isfinite(rates).all():
        raise ValueError(f"moments are too small to be inverted: {moments.min()}")
    # A permutation is odd when its cyclic successor differences are -1 (mod 3).
    parity = np.where((order[1] - order[0]) % 3 == 1, 1.0, -1.0)
    return Axes(rates, order, parity)


def checked(A: np.ndarray, L: np.ndarray, moments: np.ndarray, h: float) -> tuple[Axes, np.ndarray, np.ndarray, float]:
    """Return the arguments of a free-rotation map as arrays, the moments prepared.

    Raises:
        ValueError: shapes do not fit, moments are impossible, or h or an angular momentum is not finite.
    """
    axes, h = axes_of(moments), float(h)
    A, L = np.ascontiguousarray(A, dtype=float), np.ascontiguousarray(L, dtype=float)
    if A.ndim != 3 or A.shape[:2] != (3, 3) or L.shape != (3, A.shape[2]):
        raise ValueError(f"A must have shape (3, 3, n) and L (3, n), got {A.shape} and {L.shape}")
    if not math.isfinite(h):
        raise ValueError(f"h must be finite, got {h}")
    if axes.rates.ndim == 2 and axes.rates.shape[1] != A.shape[2]:
        raise ValueError(f"moments are given for {axes.rates.shape[1]} bodies, but A and L for {A.shape[2]}")
    if not np.isfinite(L).all():
        raise not_finite(A, L)
    return axes, A, L, h


def not_finite(A: np.ndarray, L: np.ndarray) -> ValueError:
    """Return an error that names the first body whose angular momentum, or attitude, is not finite."""
    finite, quantity = np.isfinite(L).all(axis=0), "angular momentum"
    if finite.all():
        finite, quantity = np.isfinite(A).all(axis=(0, 1)), "attitude"
    return ValueError(f"the {quantity} of body {finite.argmin()} is not finite")
