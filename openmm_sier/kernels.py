"""The formulas of the step, elementwise.

Every function takes and returns scalars or arrays, component by component, and has no branches. NumPy executes them on
arrays of bodies; `openmm_sier.compiled` compiles the very same functions for one body at a time. Vectors are tuples
of their components, rotations are quaternions (w, i, j, k) of any norm.

`openmm_sier.rotor` has the derivation of the free rotation and the notation.
"""

from __future__ import annotations

import numpy as np

from openmm_sier.elliptic import sn_coefficients, sn_increment


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


def advance(moved, u, increments):
    """The direction of L~ a time t later; `moved` is from `motion`, `increments` are those of t."""
    alpha, beta, gamma, _, _ = moved
    x, y, z = u
    S, _, C, D = increments
    yS = y * S
    f = 1 / (1 - (alpha * gamma) * (yS * yS))
    return (
        (x * D - (alpha * C) * (yS * z)) * f,
        (y * (C * D) + (beta * S) * (x * z)) * f,
        (z * C - (gamma * D) * (yS * x)) * f,
    )


def short_turn(rates, moved, u, k, end_weight, nodes):
    """The free rotation over one step that the series reach.

    Args:
        rates: inverse moments.
        moved: what `motion` gave.
        u: direction of L~.
        k: |L| h.
        end_weight, nodes: quadrature, see `openmm_sier.rotor.QUADRATURES`.

    Returns:
        The quaternion of the body frame's rotation, and the direction of L~ after it.
    """
    a, b, c = rates
    _, _, _, p, q = moved
    series = sn_coefficients(p, q)
    half = sn_increment(series, p, q, 0.5)
    m = advance(moved, u, half)
    v = advance(moved, m, half)

    squares = (m[0] * m[0], m[1] * m[1], m[2] * m[2])
    leading = a * squares[0] + b * squares[1] + c * squares[2]  # 2E/L^2
    excess = end_weight * rate_excess(rates, moved, squares, leading, half)
    for node, weight in nodes:
        inside = sn_increment(series, p, q, 0.5 * node)
        excess = excess + weight * rate_excess(rates, moved, squares, leading, inside)
    return join(u, m, v, 0.5 * k * (leading + excess)), v


def rate_excess(rates, moved, squares, leading, increments):
    """Mean over the times +-t of g/|L| - 2E/L^2, with g = omega.(m + v)/(1 + m.v).

    Numerator and denominator share the factor 1/G of `advance` and split into parts even and odd in t.
    """
    a, b, c = rates
    alpha, _, gamma, _, _ = moved
    X, Y, Z = squares
    _, S2, C, D = increments
    XD, YCD, ZC = X * D, Y * (C * D), Z * C
    even = XD + YCD + ZC
    numerator = (a * XD + b * YCD + c * ZC) - leading * even
    denominator = (1 - (alpha * gamma) * (Y * S2)) + even
    turn_C, turn_D = alpha * (1 - C), gamma * (1 - D)
    odd = turn_C + turn_D  # of the denominator, over S x y z
    odd_product = S2 * (X * Y * Z) * odd
    return (numerator * denominator - odd_product * (a * turn_C + c * turn_D - leading * odd)) / (
        denominator * denominator - odd_product * odd
    )


def join(u, m, v, half_theta):
    """Quaternion of R1(m -> v) R2(m, -theta) R1(u -> m).

    R1(m -> v) R1(u -> m) is R1(u -> v) after a turn about u by the area of the triangle u m v.
    """
    ux, uy, uz = u
    mx, my, mz = m
    vx, vy, vz = v
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    uv = ux * vx + uy * vy + uz * vz
    volume = -(mx * nx + my * ny + mz * nz)
    cosines = 1 + (ux * mx + uy * my + uz * mz) + (mx * vx + my * vy + mz * vz) + uv
    sine, cosine = np.sin(half_theta), np.cos(half_theta)
    c = cosines * cosine + volume * sine
    s = volume * cosine - cosines * sine
    return (1 + uv) * c, s * (ux + vx) + c * nx, s * (uy + vy) + c * ny, s * (uz + vz) + c * nz


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


def combine(weights, x, y, z):
    """The sum of x, y and z with weights."""
    return weights[0] * x + weights[1] * y + weights[2] * z


def cross(a, b):
    """The vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


#: In the order in which they call each other.
ELEMENTWISE = (
    sn_coefficients,
    sn_increment,
    motion,
    advance,
    rate_excess,
    join,
    short_turn,
    rotation_matrix,
    combine,
    cross,
)
