"""The formulas of the step, elementwise.

Every function takes and returns scalars or arrays, component by component, and has no branches. NumPy executes them on
arrays of bodies; `compiled` compiles the very same functions for one body at a time. Vectors are tuples
of their components, rotations are quaternions (w, i, j, k) of any norm.

`rotor` has the derivation of the free rotation and the notation.
"""

from __future__ import annotations

from openmm_sier.dynamics.backend.elliptic import short_sn_coefficients, sn_coefficients, sn_increment

#: Largest angle of `small_sine_cosine`: its truncation error is below 2e-17 there.
SMALL_ANGLE = 0.75


def motion(rates, u, k):
    """Rates over one step, and p and q as sums of terms of one sign.

    Args:
        rates: inverse moments a >= b >= c.
        u: direction of L~ in the principal frame of that order.
        k: |L| h.

    Returns:
        (alpha, beta, gamma, p, q).
    """
    a, b, c = rates
    x, y, z = u
    alpha, beta, gamma = k * (b - c), k * (a - c), k * (a - b)
    y2 = y * y
    p = (beta * (x * x) + alpha * y2) * gamma
    q = (gamma * y2 + beta * (z * z)) * alpha
    return alpha, beta, gamma, p, q


def even_and_odd(moved, u, increments):
    """The parts of the direction of L~ a time t later that are even and odd in t, at right angles to each other.

    Args:
        moved: what `motion` gave.
        u: direction of L~.
        increments: what `sn_increment` gave for t.
    """
    alpha, beta, gamma, _, _ = moved
    x, y, z = u
    S, S2, C, D = increments
    f = 1 / (1 - (alpha * gamma) * (y * y * S2))
    fS = f * S
    Cf, Df = C * f, D * f
    even = (x * Df, y * (C * Df), z * Cf)
    odd = (-(alpha * C) * (fS * y * z), (beta * fS) * (x * z), -(gamma * D) * (fS * x * y))
    return even, odd


def plus(a, b):
    """The sum of two vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def excess_weights(rates, moved, m):
    """What `rate_excess` needs of L~ in the middle of the step, with 2E/L^2 at the first place."""
    a, b, c = rates
    alpha, _, gamma, _, _ = moved
    X, Y, Z = m[0] * m[0], m[1] * m[1], m[2] * m[2]
    leading = a * X + b * Y + c * Z
    above, below = a - leading, c - leading
    return (
        leading,
        (X, Y, Z),
        (above * X, (b - leading) * Y, below * Z),
        (alpha, gamma, above * alpha, below * gamma),
        (alpha * gamma) * Y,
        X * (Y * Z),
    )


def rate_excess(weights, increments):
    """Mean over the times +-t of g/|L| - 2E/L^2, with g = omega.(m + v)/(1 + m.v).

    Numerator and denominator share the factor 1/G of `even_and_odd` and split into parts even and odd in t.
    """
    _, (X, Y, Z), (aX, bY, cZ), (alpha, gamma, a_alpha, c_gamma), twist, product = weights
    _, S2, C, D = increments
    CD = C * D
    numerator = aX * D + bY * CD + cZ * C
    denominator = (1 - twist * S2) + (X * D + Y * CD + Z * C)
    less_C, less_D = 1 - C, 1 - D
    odd = alpha * less_C + gamma * less_D  # of the denominator, over S x y z
    odd_product = S2 * product * odd
    return (numerator * denominator - odd_product * (a_alpha * less_C + c_gamma * less_D)) / (
        denominator * denominator - odd_product * odd
    )


def join(m, e, o, sine, cosine):
    """Quaternion of R1(m -> v) R2(m, -theta) R1(u -> m), with u = e - o, v = e + o and sine and cosine of theta/2.

    R1(m -> v) R1(u -> m) is R1(u -> v) after a turn about u by the area of the triangle u m v.
    """
    ex, ey, ez = e
    nx, ny, nz = ey * o[2] - ez * o[1], ez * o[0] - ex * o[2], ex * o[1] - ey * o[0]
    ee = ex * ex + ey * ey + ez * ez
    volume = m[0] * nx + m[1] * ny + m[2] * nz
    cosines = m[0] * ex + m[1] * ey + m[2] * ez + ee
    c = cosines * cosine - volume * sine
    s = volume * cosine + cosines * sine
    return ee * c, c * nx - s * ex, c * ny - s * ey, c * nz - s * ez


def small_sine_cosine(x):
    """Sine and cosine of an angle up to `SMALL_ANGLE`, from their series at half of it."""
    y = 0.5 * x
    u = y * y
    s = y * (
        1 + u * (-1 / 6 + u * (1 / 120 + u * (-1 / 5040 + u * (1 / 362880 + u * (-1 / 39916800 + u / 6227020800)))))
    )
    c = 1 + u * (-1 / 2 + u * (1 / 24 + u * (-1 / 720 + u * (1 / 40320 + u * (-1 / 3628800 + u / 479001600)))))
    return 2 * s * c, 1 - 2 * s * s


def rotation_matrix(w, i, j, k):
    """Rows of the matrix of a quaternion."""
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
    """Rows of the rotation that displaces bodies by `shift` times their angular accelerations, in the body frame.

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


def combine(weights, x, y, z):
    """The sum of x, y and z with weights."""
    return weights[0] * x + weights[1] * y + weights[2] * z


def cross(a, b):
    """The vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


#: In the order in which they call each other.
ELEMENTWISE = (
    short_sn_coefficients,
    sn_coefficients,
    sn_increment,
    motion,
    even_and_odd,
    plus,
    excess_weights,
    rate_excess,
    join,
    small_sine_cosine,
    rotation_matrix,
    combine,
    displacing_rotation,
    cross,
)
