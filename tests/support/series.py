"""Correlated series of known statistics."""

import math

import numpy as np


def correlated(rng, n, kept, *shape):
    """Series (n, *shape) of normal values of variance 1 with correlation kept^t."""
    values = rng.normal(size=(n, *shape))
    values[1:] *= math.sqrt(1 - kept**2)
    for i in range(1, n):
        values[i] += kept * values[i - 1]
    return values


def stresses(rng, n, kept):
    """Pressure tensors (n, 6) whose shear stresses are independent, of variance 1 and with correlation kept^t."""
    shear = correlated(rng, n, kept, 5)
    # Two orthogonal directions in the space of traces of zero.
    diagonal = shear[:, 3:4] * [1, -1, 0] + shear[:, 4:] * np.array([1, 1, -2]) / math.sqrt(3)
    return np.concatenate([diagonal, shear[:, :3]], axis=1)
