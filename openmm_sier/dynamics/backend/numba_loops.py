"""Loops for Numba to compile. Nothing else executes them."""

from __future__ import annotations

import numpy as np

from openmm_sier.dynamics.backend.elliptic import long_series
from openmm_sier.dynamics.backend.formulas import SMALL_ANGLE, combine, rotation_matrix, small_sine_cosine
from openmm_sier.dynamics.backend.short_steps import free_rotation

#: Bodies that are rotated together, and numbers that each needs for it, 22 kB in all, for the nearest cache.
TILE, ROWS = 128, 22


def copy(target, source):
    """Write some numbers to as many others."""
    for n in range(len(target)):
        target[n] = source[n]


def rotate(start, stop, A, L, h, rates, out, far):
    """Free rotation of bodies with equal moments; returns how many are beyond the formula, and sets `far` for those.

    Args:
        start, stop: range of the bodies.
        A, L: (3, 3, n) and (3, n).
        h: time.
        rates: inverse moments, descending, (3,).
        out: (3, 3, n), valid where `far` is not set.
        far: (n,), bool.
    """
    left = 0
    tile = np.ones(ROWS * TILE)
    for first in range(start, stop, TILE):
        end = min(first + TILE, stop)
        size = end - first
        for i in range(3):
            for j in range(3):
                row = (3 * i + j) * TILE
                copy(tile[row : row + size], A[i, j, first:end])
            row = (9 + i) * TILE
            copy(tile[row : row + size], L[i, first:end])
        rotate_tile(tile, (rates[0], rates[1], rates[2]), h)
        for i in range(3):
            for j in range(3):
                row = (12 + 3 * i + j) * TILE
                copy(out[i, j, first:end], tile[row : row + size])
        for n in range(size):
            far[first + n] = tile[21 * TILE + n] == 0
            left += far[first + n]
    return left


def rotate_tile(tile, rates, h):
    """Free rotation of a tile of bodies, from rows of it to others: A (9 rows), L (3), new A (9), whether it is valid.

    There is one array with constant distances between its rows, and no branch or call that is not inlined. So the
    compiler sees that bodies are independent, and handles several with each instruction.
    """
    for n in range(TILE):
        x = tile[n], tile[TILE + n], tile[2 * TILE + n]
        y = tile[3 * TILE + n], tile[4 * TILE + n], tile[5 * TILE + n]
        z = tile[6 * TILE + n], tile[7 * TILE + n], tile[8 * TILE + n]
        L = tile[9 * TILE + n], tile[10 * TILE + n], tile[11 * TILE + n]
        body_L = combine(L, x[0], x[1], x[2]), combine(L, y[0], y[1], y[2]), combine(L, z[0], z[1], z[2])
        turn, _, reached = free_rotation(body_L, rates, h, long_series, small_sine_cosine, SMALL_ANGLE)
        rows = rotation_matrix(turn[0], turn[1], turn[2], turn[3])
        for column in range(3):
            tile[(12 + column) * TILE + n] = combine(rows[0], x[column], y[column], z[column])
            tile[(15 + column) * TILE + n] = combine(rows[1], x[column], y[column], z[column])
            tile[(18 + column) * TILE + n] = combine(rows[2], x[column], y[column], z[column])
        tile[21 * TILE + n] = reached


def differences(ends, x):
    """As `constraint_solver.differences`."""
    out = np.empty((3, ends.shape[1]))
    for axis in range(3):
        for c in range(ends.shape[1]):
            out[axis, c] = x[axis, np.uint64(ends[0, c])] - x[axis, np.uint64(ends[1, c])]
    return out


def scattered(ends, vectors, atoms):
    """As `constraint_solver.scattered`."""
    out = np.zeros((3, atoms))
    for axis in range(3):
        for c in range(ends.shape[1]):
            out[axis, np.uint64(ends[0, c])] += vectors[axis, c]
            out[axis, np.uint64(ends[1, c])] -= vectors[axis, c]
    return out


def multiplied(rows, columns, matrix, x):
    """As `constraint_solver.multiplied`."""
    out = np.zeros(len(x))
    for k in range(len(rows)):
        out[np.uint64(rows[k])] += matrix[k] * x[np.uint64(columns[k])]
    return out
