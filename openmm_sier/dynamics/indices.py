"""Indices of bodies as slices and runs."""

import numpy as np


def as_slice(indices: np.ndarray) -> slice | np.ndarray:
    """Return indices, (k,), as a slice if their spacing is even, since a slice of an array is no copy."""
    if indices.size == 1:
        return slice(int(indices[0]), int(indices[0]) + 1)
    step = int(indices[1] - indices[0]) if indices.size else 0
    if step > 0 and np.all(np.diff(indices) == step):
        return slice(int(indices[0]), int(indices[-1]) + 1, step)
    return indices


def runs(chosen: np.ndarray) -> np.ndarray:
    """Return the start and the end of each run of true elements, (m, 2).

    >>> runs(np.array([True, True, False, True])).tolist()
    [[0, 2], [3, 4]]
    """
    edges = np.diff(np.concatenate([[0], chosen.astype(np.int64), [0]]))
    return np.column_stack([np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)])
