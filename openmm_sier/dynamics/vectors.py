"""The algebra of vectors and rotations, component by component.

Every function takes and returns scalars or arrays, and has no branches: NumPy executes it on arrays of bodies, and
`kernels.formulas` compiles it for one body. Vectors are tuples of their components, rotations are quaternions
(w, i, j, k) of any norm.
"""

import numpy as np


def plus(a, b):
    """Return the sum of two vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def combine(weights, x, y, z):
    """Return the sum of x, y and z with weights."""
    return weights[0] * x + weights[1] * y + weights[2] * z


def cross(a, b):
    """Return the vector product.

    >>> cross((1, 0, 0), (0, 1, 0))
    (0, 0, 1)
    """
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def rotation_matrix(w, i, j, k):
    """Return rows of the matrix of a quaternion.

    >>> rotation_matrix(1.0, 0.0, 0.0, 1.0)[0]
    (0.0, -1.0, 0.0)
    """
    f = 2 / (w * w + i * i + j * j + k * k)
    fi, fj, fk = f * i, f * j, f * k
    ij, ik, jk = fi * j, fi * k, fj * k
    ii, jj, kk = fi * i, fj * j, fk * k
    wi, wj, wk = fi * w, fj * w, fk * w
    return (
        (1 - (jj + kk), ij - wk, ik + wj),
        (ij + wk, 1 - (ii + kk), jk - wi),
        (ik - wj, jk + wi, 1 - (ii + jj)),
    )


def body_frame(A, L):
    """Return L~ = A L in the principal frame, of arrays A (3, 3, n) and L (3, n)."""
    return combine(L, A[:, 0], A[:, 1], A[:, 2])


def turned(rows, A):
    """Return attitudes A (3, 3, n) after rotations in the body frames, given by rows; a new array."""
    return np.stack([combine(row, *A) for row in rows])
