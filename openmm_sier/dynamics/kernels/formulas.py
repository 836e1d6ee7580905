"""Formulas for one body, of which most are inlined into kernels."""

import math

from openmm_sier.dynamics import vectors
from openmm_sier.dynamics.kernels.compilation import called, inlined

#: Largest angle of `small_sine_cosine`, up to which its truncation error is below 2e-17.
SMALL_ANGLE = 0.75

#: A determinant of moments of inertia below this share of the cube of half their sum is that of points on a line.
LINE = 1e-8

#: The axes of the lab.
LAB = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)

plus = inlined(vectors.plus)
combine = inlined(vectors.combine)
cross = inlined(vectors.cross)
rotation_matrix = inlined(vectors.rotation_matrix)


@inlined
def small_sine_cosine(x):
    """Return sine and cosine of an angle up to `SMALL_ANGLE`, from their series at half of it."""
    y = 0.5 * x
    u = y * y
    s = y * (
        1 + u * (-1 / 6 + u * (1 / 120 + u * (-1 / 5040 + u * (1 / 362880 + u * (-1 / 39916800 + u / 6227020800)))))
    )
    c = 1 + u * (-1 / 2 + u * (1 / 24 + u * (-1 / 720 + u * (1 / 40320 + u * (-1 / 3628800 + u / 479001600)))))
    return 2 * s * c, 1 - 2 * s * s


@inlined
def displacing_rotation(x, y, z, torque, inverses, shift):
    """Return rows of the rotation by `shift` times the angular acceleration of a body, in the body frame.

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


@inlined
def spin(moments, torque):
    """Return the angular acceleration of points as one body times a determinant, the determinant, and half the trace.

    By Cramer's rule. Of points on a line both moments about axes across it are half the trace. No moment of points is
    larger than the sum of the other two, so that the determinant over the cube of half the trace is a measure of the
    smallest moment.

    Args:
        moments: second moments xx, yy, zz, xy, yz, zx of the masses about their centre.
        torque: of all forces.
    """
    xx, yy, zz, xy, yz, zx = moments
    a, d, f = yy + zz, zz + xx, xx + yy
    b, c, e = -xy, -zx, -yz
    aa, bb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    dd, ee, ff = a * f - c * c, b * c - a * e, a * d - b * b
    acceleration = (
        aa * torque[0] + bb * torque[1] + cc * torque[2],
        bb * torque[0] + dd * torque[1] + ee * torque[2],
        cc * torque[0] + ee * torque[1] + ff * torque[2],
    )
    return acceleration, a * aa + b * bb + c * cc, xx + yy + zz


@called
def decay(rate, h):
    """Return the factor of a momentum in a time h, and the standard deviation of noise over the thermal one."""
    return math.exp(-rate * h), math.sqrt(-math.expm1(-2 * rate * h))


@called
def friction_directions(axes, rates, moves):
    """Return orthonormal directions along which momenta decay independently of each other, and their rates.

    For a body that moves along all axes of the lab these are its principal axes. For others they are the eigenvectors
    of the friction tensor in the plane, or on the line, along which the body moves, and a direction without friction.

    Args:
        axes: rows of the attitude.
        rates: of friction along the principal axes.
        moves: whether the body moves along x, y and z.
    """
    if moves[0] and moves[1] and moves[2]:
        return axes, rates
    held = 0
    while moves[held]:
        held += 1
    j, k = (held + 1) % 3, (held + 2) % 3
    jj, kk, jk = 0.0, 0.0, 0.0
    for i in range(3):
        along_j, along_k = axes[i][j] * moves[j], axes[i][k] * moves[k]
        jj += rates[i] * along_j * along_j
        kk += rates[i] * along_k * along_k
        jk += rates[i] * along_j * along_k
    angle = 0.5 * math.atan2(2 * jk, jj - kk)
    mean, half = 0.5 * (jj + kk), math.hypot(0.5 * (jj - kk), jk)
    c, s = math.cos(angle), math.sin(angle)
    e, f = LAB[j], LAB[k]
    first = c * e[0] + s * f[0], c * e[1] + s * f[1], c * e[2] + s * f[2]
    second = c * f[0] - s * e[0], c * f[1] - s * e[1], c * f[2] - s * e[2]
    return (first, second, LAB[held]), (mean + half, max(mean - half, 0.0), 0.0)
