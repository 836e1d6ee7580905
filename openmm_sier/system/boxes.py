"""Periodic boxes and images of points."""

from collections.abc import Callable

import numpy as np

#: Rounding of coordinates in files, as a fraction of an edge.
ROUNDING = 1e-4


def wrapped(points: np.ndarray, box: np.ndarray, rounded: Callable = np.floor) -> np.ndarray:
    """Return points (n, 3) translated into the box by box vectors.

    Args:
        points: (n, 3), nm.
        box: box vectors as rows, in OpenMM's reduced form, (3, 3), nm.
        rounded: numpy.round moves points to the images nearest the origin instead.
    """
    moved, box = np.array(points, dtype=float), np.asarray(box, dtype=float)
    for axis in (2, 1, 0):
        moved -= np.outer(rounded(moved[:, axis] / box[axis, axis]), box[axis])
    return moved


def reduced(box: np.ndarray) -> np.ndarray:
    """Return box vectors in OpenMM's reduced form, in which shifts by half an edge are negative, (3, 3), nm.

    In a dodecahedron or an octahedron an edge is shifted by half of another one. The sign of such a shift changes
    nothing in the lattice, and follows from rounding where a program reduces the vectors.

    Args:
        box: box vectors as rows, lower triangular, (3, 3), nm.
    """
    a, b, c = np.array(box, dtype=float)
    b -= a * _periods(b[0] / a[0])
    c -= b * _periods(c[1] / b[1])
    c -= a * _periods(c[0] / a[0])
    return np.array([a, b, c])


def _periods(shift: float) -> float:
    """Return the integer nearest to a shift; half an edge, up to `ROUNDING`, is rounded up."""
    return float(np.floor(shift + 0.5 + ROUNDING))
