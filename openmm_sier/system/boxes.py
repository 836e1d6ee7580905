"""Periodic boxes: points and their images."""

from collections.abc import Callable

import numpy as np


def wrapped(points: np.ndarray, box: np.ndarray, rounded: Callable = np.floor) -> np.ndarray:
    """Return points (n, 3) moved by box vectors into the box.

    Args:
        points: (n, 3), nm.
        box: box vectors as rows, in OpenMM's reduced form, (3, 3), nm.
        rounded: numpy.round moves them next to the origin instead.
    """
    moved, box = np.array(points, dtype=float), np.asarray(box, dtype=float)
    for axis in (2, 1, 0):
        moved -= np.outer(rounded(moved[:, axis] / box[axis, axis]), box[axis])
    return moved


def widths(box: np.ndarray) -> np.ndarray:
    """Return the distances between opposite faces of a box, (3,), nm.

    Args:
        box: box vectors as rows, (3, 3), nm.
    """
    faces = np.cross(np.roll(box, -1, axis=0), np.roll(box, -2, axis=0))
    return np.abs(np.linalg.det(box)) / np.linalg.norm(faces, axis=1)
