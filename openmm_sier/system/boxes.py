"""Periodic boxes: points and their images."""

from collections.abc import Callable

import numpy as np


def wrapped(points: np.ndarray, box: np.ndarray, rounded: Callable = np.floor) -> np.ndarray:
    """Points (n, 3) moved by box vectors into the box.

    Args:
        points: (n, 3), nm.
        box: box vectors as rows, in OpenMM's reduced form, (3, 3), nm.
        rounded: numpy.round moves them next to the origin instead.
    """
    moved, box = np.array(points, dtype=float), np.asarray(box, dtype=float)
    for axis in (2, 1, 0):
        moved -= np.outer(rounded(moved[:, axis] / box[axis, axis]), box[axis])
    return moved
