"""Exact free rotation of rigid bodies.

`exact` advances attitude matrices by the exact solution of torque-free motion (van Zon and Schofield 2007,
Eq. Pmatrix), for every body, state and step length.

The paper writes the rotation of the body frame over a step as R1(L~*) R2(psi) R1(L~)^T, where R1 carries a fixed
pole (a principal axis) to the direction of the body-frame angular momentum L~ and psi is an integral along its path.
Where the path comes near the pole that integral is ill-behaved. The decomposition holds for any pole, so here the
pole moves along: it is the direction m of L~ in the middle of the step, R1(m -> v) is the smallest rotation from m
to v, and the paper's factors become

    P = R1(m -> v) R2(m, -theta) R1(u -> m),     theta = h Int g dt,    g = omega . (m + v(t)) / (1 + m . v(t)),

with u and v the directions of L~ before and after. Nothing is singular before L~ has turned by half a circle within
one step, g is even in time about the middle to leading order, and no case distinction is left. As a quaternion P is a
rational function of u, m, v and of the sine and cosine of theta/2, so that it is orthogonal to rounding.

Notation: rows of A are the principal axes in the lab frame, L~ = A L, rates a >= b >= c are the inverse
moments, k = |L| h, and

    alpha = k (b - c),   beta = k (a - c),   gamma = k (a - b).

With p = (beta x^2 + alpha y^2) gamma and q = (gamma y^2 + beta z^2) alpha for the unit vector (x, y, z) along L~
and S, C, D from `elliptic.sn_increment`, the Euler equations are solved without an initial phase by

    G  = 1 - alpha gamma y^2 S^2
    x* = (x D - S C alpha y z)/G,   y* = (y C D + S beta x z)/G,   z* = (z C - S D gamma x y)/G.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from openmm_sier.elliptic import SERIES_LIMIT, complete_integrals, sn_coefficients, sn_increment

#: Bodies handled at a time, so that the temporaries of a block stay in cache.
BLOCK = 2048

#: Largest max(p, q) (squared phase of the nutation in one step) for each quadrature rule, and the rule's nodes inside
#: (0, 1) and weights: Gauss-Lobatto on [-1, 1] without the end points, whose weight is the first number, and
#: without the centre, where the integrand's deviation from its leading term vanishes.
#: The truncation error is below 1e-17 of a turn at each limit (tests/test_rotor.py measures it).
QUADRATURES = (
    (0.005, 0.1, ((np.sqrt(3 / 7), 49 / 90),)),
    (
        4 * SERIES_LIMIT,
        1 / 21,
        (
            (np.sqrt(5 / 11 - 2 / 11 * np.sqrt(5 / 3)), (124 + 7 * np.sqrt(15)) / 350),
            (np.sqrt(5 / 11 + 2 / 11 * np.sqrt(5 / 3)), (124 - 7 * np.sqrt(15)) / 350),
        ),
    ),
)
LONGEST = QUADRATURES[-1][0]

#: Beyond this many sub-steps between two passages of the separatrix's saddle the motion has left the range of doubles.
MOST_SUBSTEPS = 8192

#: Squares of angular momenta outside this range are rescaled, and phases above `PHASE_CAP` mean nothing in doubles.
SQUARE_RANGE = (1e-240, 1e240)
PHASE_CAP = 1e100


class Top(NamedTuple):
    """Inverse moments in descending order, and the way from principal axes in the user's order to that order."""

    rates: np.ndarray  # (3,) or (3, n)
    order: np.ndarray  # same shape: row i of the sorted frame is row order[i] of the user's
    parity: np.ndarray  # () or (n,): sign that the middle axis takes, so that the sorted frame stays right-handed

    def part(self, index) -> Top:
        return self if self.rates.ndim == 1 else Top(self.rates[:, index], self.order[:, index], self.parity[index])

    def sort(self, v):
        """Components (3, n) in the sorted frame."""
        x, y, z = v[self.order] if self.rates.ndim == 1 else np.take_along_axis(v, self.order, axis=0)
        return x, y * self.parity, z

    def unsort(self, x, y, z):
        """Components (3, n) in the user's frame."""
        v = np.empty((3, np.size(x)))
        sorted_v = np.stack([x, y * self.parity, z])
        if self.rates.ndim == 1:
            v[self.order] = sorted_v
        else:
            np.put_along_axis(v, self.order, sorted_v, axis=0)
        return v


def top(moments) -> Top:
    """Prepare principal moments for the free-rotation maps.

    Args:
        moments: shape (3,), or (3, n) for a set of moments per body, in any order, dalton nm^2. A point body has three
            zeros, a linear one exactly one zero and two equal moments.

    Raises:
        ValueError: a moment is negative or not finite, or a body has two zeros, or one zero and unequal others.
    """
    moments = np.asarray(moments, dtype=float)
    if moments.ndim not in (1, 2) or moments.shape[0] != 3:
        raise ValueError(f"moments must have shape (3,) or (3, n), got {moments.shape}")
    if moments.ndim == 1:
        return _top_of_three(*moments.tolist())
    return _sorted_top(moments)


@lru_cache(maxsize=256)
def _top_of_three(x, y, z) -> Top:
    return _sorted_top(np.array([x, y, z]))


def _sorted_top(moments) -> Top:
    bad = ~(np.isfinite(moments) & (moments >= 0))
    if bad.any():
        raise ValueError(f"moments must be finite and not negative, got {moments[bad][0]}{_body(bad)}")
    order = np.argsort(moments, axis=0, kind="stable")
    low, mid, high = np.take_along_axis(moments, order, axis=0)
    linear = (low == 0) & (high > 0)
    unequal = linear & (high - mid > 1e-9 * high)
    if unequal.any():
        raise ValueError(
            "a body with one zero moment is linear and its other two must be equal, got "
            f"{moments.T[unequal].tolist() if moments.ndim == 2 else moments.tolist()}"
        )
    with np.errstate(divide="ignore"):
        rates = np.where(high > 0, 1 / np.stack([np.where(linear, mid, low), mid, high]), 0.0)
    if not np.isfinite(rates).all():
        raise ValueError(f"moments are too small to be inverted: {moments[:, ...].min()}")
    # A permutation is odd when its cyclic successor differences are -1 (mod 3).
    parity = np.where((order[1] - order[0]) % 3 == 1, 1.0, -1.0)
    return Top(rates, order, parity)


def _body(bad) -> str:
    return f" for body {int(np.argwhere(bad)[0][1])}" if bad.ndim == 2 else ""


def body_frame(A, L):
    """L~ = A L, both component-first: A (3, 3, n), L (3, n)."""
    return A[:, 0] * L[0] + A[:, 1] * L[1] + A[:, 2] * L[2]


def exact(A, L, moments, h):
    """Exact torque-free rotation of rigid bodies over a time of any length and either sign.

    Args:
        A: attitude matrices, shape (3, 3, n); rows are the principal axes in the lab frame.
        L: angular momenta in the lab frame, shape (3, n), dalton nm^2/ps.
        moments: principal moments, shape (3,) or (3, n), dalton nm^2, in any order; see `top`.
        h: time in ps, a float.

    Returns:
        (A, L) after the time h, new arrays; free rotation conserves L.

    Raises:
        ValueError: shapes do not fit, moments are impossible, or a value is not finite.

    Source: van Zon and Schofield (2007), Eqs. (U1) and (Pmatrix); see the module's docstring.
    """
    bodies, h = top(moments), float(h)
    A, L = np.asarray(A, dtype=float), np.asarray(L, dtype=float)
    if A.ndim != 3 or A.shape[:2] != (3, 3) or L.shape != (3, A.shape[2]):
        raise ValueError(f"A must have shape (3, 3, n) and L (3, n), got {A.shape} and {L.shape}")
    if not np.isfinite(h):
        raise ValueError(f"h must be finite, got {h}")
    n = A.shape[2]
    if bodies.rates.ndim == 2 and bodies.rates.shape[1] != n:
        raise ValueError(f"moments are given for {bodies.rates.shape[1]} bodies, A and L for {n}")
    new = np.empty((3, 3, n))
    for start in range(0, n, BLOCK):
        block = slice(start, min(start + BLOCK, n))
        here = bodies.part(block)
        w, *vector = _turn(here, here.sort(body_frame(A[:, :, block], L[:, block])), h)
        _rotate(A[:, :, block], w, here.unsort(*vector), new[:, :, block])
    return new, L.copy()


def _turn(bodies: Top, body_L, h):
    """Quaternion (w, i, j, k) of the body frame's rotation over h, in the sorted frame, of any norm."""
    x, y, z = body_L
    square = x * x + y * y + z * z
    low, high = SQUARE_RANGE
    if not (square.min() >= low and square.max() <= high):
        return _turn_scaled(bodies, body_L, h)
    norm = np.sqrt(square)
    return _turn_unit(bodies.rates, (x / norm, y / norm, z / norm), norm * h)


def _turn_scaled(bodies: Top, body_L, h):
    """`_turn` for angular momenta that vanish or whose squares leave the range of doubles."""
    scale = np.max(np.abs(body_L), axis=0)
    if not np.isfinite(scale).all():
        raise ValueError(f"the angular momentum of body {int(np.argmin(np.isfinite(scale)))} is not finite")
    x, y, z = np.stack(body_L) / np.where(scale > 0, scale, 1.0)
    norm = np.sqrt(x * x + y * y + z * z)
    unit = np.where(norm > 0, norm, 1.0)
    with np.errstate(over="ignore", under="ignore"):
        k = np.clip(norm * (scale * h), -1e300, 1e300)
    return _turn_unit(bodies.rates, (x / unit, y / unit, z / unit), k)


def _turn_unit(rates, u, k):
    """`_turn` for directions u and k = |L| h; the few bodies that the series do not reach go their own way."""
    motion = _motion(rates, u, k)
    phases = np.maximum(motion.p, motion.q)
    largest = phases.max()
    if largest <= LONGEST and np.abs(k).max() * np.max(rates[0]) <= PHASE_CAP:
        return _short_turn(motion, u, k, _quadrature(largest))[0]
    far = ~((phases <= LONGEST) & (np.abs(k) * rates[0] <= PHASE_CAP))
    near_k = np.where(far, 0.0, k)
    turns = np.stack(_short_turn(_motion(rates, u, near_k), u, near_k, _quadrature(LONGEST))[0])
    rates_far = np.broadcast_to(np.reshape(rates, (3, -1)), (3, k.size))[:, far]
    turns[:, far] = _long_turn(rates_far, np.stack(u)[:, far], k[far])
    return turns


class Motion(NamedTuple):
    """What the free motion of bodies over one step depends on besides the direction of L~."""

    rates: np.ndarray
    alpha: np.ndarray
    beta: np.ndarray
    gamma: np.ndarray
    p: np.ndarray
    q: np.ndarray


def _motion(rates, u, k) -> Motion:
    """Rates scaled to the step, and p and q as sums of terms of one sign."""
    a, b, c = rates
    x, y, z = u
    alpha, beta, gamma = k * (b - c), k * (a - c), k * (a - b)
    y2 = y * y
    p = (beta * (x * x) + alpha * y2) * gamma
    q = (gamma * y2 + beta * (z * z)) * alpha
    return Motion(rates, alpha, beta, gamma, p, q)


def _quadrature(largest):
    for limit, end_weight, nodes in QUADRATURES:
        if largest <= limit:
            return end_weight, nodes
    raise ValueError(f"a step of squared phase {largest} is too long for the quadrature")


def _advance(motion, u, increments):
    """The direction of L~ a time t later; `increments` are those of t."""
    _, alpha, beta, gamma, _, _ = motion
    x, y, z = u
    S, _, C, D = increments
    yS = y * S
    f = 1 / (1 - (alpha * gamma) * (yS * yS))
    return (
        (x * D - (alpha * C) * (yS * z)) * f,
        (y * (C * D) + (beta * S) * (x * z)) * f,
        (z * C - (gamma * D) * (yS * x)) * f,
    )


def _short_turn(motion, u, k, quadrature):
    """Quaternion of the rotation over one step that the series reach, and the direction of L~ after it."""
    a, b, c = motion.rates
    p, q = motion.p, motion.q
    series = sn_coefficients(p, q)
    half = sn_increment(series, p, q, 0.5)
    m = _advance(motion, u, half)
    v = _advance(motion, m, half)

    end_weight, nodes = quadrature
    squares = X, Y, Z = m[0] * m[0], m[1] * m[1], m[2] * m[2]
    leading = a * X + b * Y + c * Z  # 2E/L^2
    excess = end_weight * _rate_excess(motion, squares, leading, half)
    for node, weight in nodes:
        inside = sn_increment(series, p, q, 0.5 * node)
        excess = excess + weight * _rate_excess(motion, squares, leading, inside)
    return _compose_minimal(u, m, v, 0.5 * k * (leading + excess)), v


def _rate_excess(motion, squares, leading, increments):
    """Mean over the times +-t of g/|L| - 2E/L^2, with g = omega.(m + v)/(1 + m.v).

    Numerator and denominator share the factor 1/G of `_advance` and split into parts even and odd in t.
    """
    (a, b, c), alpha, _, gamma, _, _ = motion
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


def _compose_minimal(u, m, v, half_theta):
    """Quaternion of R1(m -> v) R2(m, -theta) R1(u -> m), of any norm.

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


def _rotate(A, w, vector, out):
    """A* = P A for the quaternion (w, vector) of any norm."""
    i, j, k = vector
    f = 2 / (w * w + i * i + j * j + k * k)
    fi, fj, fk = f * i, f * j, f * k
    ij, ik, jk = fi * j, fi * k, fj * k
    ii, jj, kk = fi * i, fj * j, fk * k
    wi, wj, wk = fi * w, fj * w, fk * w
    out[0] = (1 - (jj + kk)) * A[0] + (ij - wk) * A[1] + (ik + wj) * A[2]
    out[1] = (ij + wk) * A[0] + (1 - (ii + kk)) * A[1] + (jk - wi) * A[2]
    out[2] = (ik - wj) * A[0] + (jk + wi) * A[1] + (1 - (ii + jj)) * A[2]


# --- steps that the series do not reach -------------------------------------------------------------------------


def _long_turn(rates, u, k):
    """Quaternion of the rotation over a step in which some body nutates further than the series reach.

    Whole periods of L~ are turns about L; the rest is cut into sub-steps, composed exactly.
    """
    cap = PHASE_CAP / np.maximum(rates[0], 1e-200)
    k = np.clip(k, -cap, cap)
    phase, rest, whole = _whole_periods(rates, u, k)
    turns = np.stack(_about(u, whole))

    pieces = np.maximum(np.ceil(phase * np.abs(rest) / np.sqrt(LONGEST)), 1)
    short = np.minimum(pieces, MOST_SUBSTEPS) / pieces
    pieces = np.minimum(pieces, MOST_SUBSTEPS).astype(int)
    k_piece = k * (rest * short) / pieces

    active = np.arange(k.size)
    for done in range(pieces.max()):
        active = active[pieces[active] > done]
        motion = _motion(rates[:, active], u[:, active], k_piece[active])
        step, v = _short_turn(motion, u[:, active], k_piece[active], _quadrature(LONGEST))
        turns[:, active] = _normalized(_product(step, turns[:, active]))
        u[:, active] = _normalized(v)
    # What is left over belongs to a state on the separatrix to its last bit. Nothing in the state says when it leaves
    # the saddle, the middle axis, so it is left there.
    return _product(_about(u, k * (rest * (1 - short)) * rates[1]), turns)


def _whole_periods(rates, u, k):
    """Nutation phase of the whole step, the fraction of it left after whole periods of L~, and the turn in those."""
    (a, b, c), alpha, beta, gamma, p, q = _motion(rates, u, k)
    larger = np.maximum(p, q)
    moving = larger > 0
    # p - q without the term that both have.
    kc2 = np.abs(beta * (u[0] * u[0] * gamma - u[2] * u[2] * alpha)) / np.where(moving, larger, 1.0)
    periodic = moving & (kc2 > 0)
    around_x = p >= q
    divisor = np.where(around_x, gamma, alpha)
    nu = np.where(periodic, beta / np.where(periodic, divisor, 1.0), 1.0)
    K, Q = complete_integrals(np.sqrt(np.where(periodic, np.minimum(kc2, 1.0), 1.0)), nu)
    period = np.where(periodic, 4 * K / np.sqrt(np.where(moving, larger, 1.0)), np.inf)
    count = np.rint(1 / period)
    spent = np.where(count > 0, count * np.where(periodic, period, 0.0), 0.0)
    pole = np.where(around_x, c, a)
    return np.sqrt(larger), 1 - spent, k * spent * (pole + 0.5 * (b - pole) * Q)


def _about(u, angle):
    """Quaternion of the body frame's rotation when the body turns about L~ by an angle."""
    s = -np.sin(0.5 * angle)
    return np.cos(0.5 * angle), s * u[0], s * u[1], s * u[2]


def _product(p, q):
    """Quaternion product: the rotation q followed by p."""
    (a, b, c, d), (e, f, g, h) = p, q
    return np.stack(
        [
            a * e - b * f - c * g - d * h,
            a * f + b * e + c * h - d * g,
            a * g - b * h + c * e + d * f,
            a * h + b * g - c * f + d * e,
        ]
    )


def _normalized(v):
    v = np.stack(v)
    return v / np.sqrt((v * v).sum(axis=0))
