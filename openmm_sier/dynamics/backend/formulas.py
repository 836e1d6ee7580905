"""The algebra of vectors, rotations and quaternions, elementwise.

Every function takes and returns scalars or arrays, component by component, and has no branches. NumPy executes them on
arrays of bodies; Numba compiles the very same functions for one body. Vectors are tuples of their components,
rotations are quaternions (w, i, j, k) of any norm.
"""

import numpy as np

#: Largest angle of `small_sine_cosine`, up to which its truncation error is below 2e-17.
SMALL_ANGLE = 0.75

#: A determinant of moments of inertia below this share of the cube of half their sum is that of points on a line.
LINE = 1e-8


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


def body_frame(A, L):
    """Return L~ = A L in the principal frame, of arrays A (3, 3, n) and L (3, n)."""
    return combine(L, A[:, 0], A[:, 1], A[:, 2])


def angular_velocity(A, L, inverse_moments):
    """Return angular velocities in the lab frame, (3, n); zero about the axis of a line and for a point."""
    return combine(body_frame(A, L) * inverse_moments, A[0], A[1], A[2])


def turned(rows, A):
    """Return attitudes A (3, 3, n) after rotations in the body frames, given by rows; a new array."""
    return np.stack([combine(row, *A) for row in rows])


def small_sine_cosine(x):
    """Return sine and cosine of an angle up to `SMALL_ANGLE`, from their series at half of it."""
    y = 0.5 * x
    u = y * y
    s = y * (
        1 + u * (-1 / 6 + u * (1 / 120 + u * (-1 / 5040 + u * (1 / 362880 + u * (-1 / 39916800 + u / 6227020800)))))
    )
    c = 1 + u * (-1 / 2 + u * (1 / 24 + u * (-1 / 720 + u * (1 / 40320 + u * (-1 / 3628800 + u / 479001600)))))
    return 2 * s * c, 1 - 2 * s * s


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


def displacing_rotation(x, y, z, torque, inverses, shift):
    """Return rows of the rotation by `shift` times the angular accelerations of bodies, in the body frame.

    The Cayley form differs from the rotation by a third of the cube of the angle.

    Args:
        x, y, z: rows of the attitude.
        torque: in the lab frame.
        inverses: inverse principal moments.
        shift: half the square of a time.
    """
    half = -0.5 * shift
    i = half * inverses[0] * combine(torque, x[0], x[1], x[2])
    j = half * inverses[1] * combine(torque, y[0], y[1], y[2])
    k = half * inverses[2] * combine(torque, z[0], z[1], z[2])
    return rotation_matrix(1.0, i, j, k)


def spin(moments, torque):
    """Return the angular acceleration of points as one body times a determinant, by Cramer's rule, and that.

    The third result is half the trace: about axes across a line both moments have that value. No moment of points is
    larger than the other two together, so that the determinant over the cube of this tells how small the smallest is.

    Args:
        moments: second moments xx, yy, zz, xy, yz, zx of the masses about their centre.
        torque: of all forces.
    """
    xx, yy, zz, xy, yz, zx = moments
    a, d, f = yy + zz, zz + xx, xx + yy
    b, c, e = -xy, -zx, -yz
    aa, bb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    dd, ee, ff = a * f - c * c, b * c - a * e, a * d - b * b
    turned = (
        aa * torque[0] + bb * torque[1] + cc * torque[2],
        bb * torque[0] + dd * torque[1] + ee * torque[2],
        cc * torque[0] + ee * torque[1] + ff * torque[2],
    )
    return turned, a * aa + b * bb + c * cc, xx + yy + zz
