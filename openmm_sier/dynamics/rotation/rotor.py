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
one step, and no case distinction is left. As a quaternion P is a rational function of u, m, v and of the sine and
cosine of theta/2, so that it is orthogonal to rounding. Where the paper integrates by Hermite interpolation at the ends
of the step (Eq. psiapprox), the part of g that is even about the middle is integrated here by Gauss-Lobatto quadrature,
of an order at which it has converged to rounding; longer steps are composed of shorter ones and of whole periods of L~.
tests/dynamics/test_paper_formulas.py has the paper's own form, which agrees.

Notation: rows of A are the principal axes in the lab frame, L~ = A L, rates a >= b >= c are the inverse
moments, k = |L| h, and

    alpha = k (b - c),   beta = k (a - c),   gamma = k (a - b).

With p = (beta x^2 + alpha y^2) gamma and q = (gamma y^2 + beta z^2) alpha for the unit vector (x, y, z) along L~
and S, C, D from `elliptic.sn_increment`, the Euler equations are solved without an initial phase by

    G  = 1 - alpha gamma y^2 S^2
    x* = (x D - S C alpha y z)/G,   y* = (y C D + S beta x z)/G,   z* = (z C - S D gamma x y)/G.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from openmm_sier.dynamics.backend import kernels
from openmm_sier.dynamics.backend.compiled import executor
from openmm_sier.dynamics.backend.elliptic import (
    SERIES_LIMIT,
    SHORT_SERIES_LIMIT,
    complete_integrals,
    short_sn_coefficients,
    sn_coefficients,
    sn_increment,
)

#: Bodies handled at a time, so that the temporaries of a block stay in cache.
BLOCK = 4096

#: Largest max(p, q) (squared phase of the nutation in one step) for each quadrature rule, and the rule's nodes inside
#: (0, 1) and weights: Gauss-Lobatto on [-1, 1] without the end points, whose weight is the first number, and
#: without the centre, where the integrand's deviation from its leading term vanishes.
#: The truncation error is below 1e-17 of a turn at each limit (tests/dynamics/test_rotor.py measures it).
QUADRATURES = (
    (4 * SHORT_SERIES_LIMIT, 0.1, ((math.sqrt(3 / 7), 49 / 90),)),
    (
        4 * SERIES_LIMIT,
        1 / 21,
        (
            (math.sqrt(5 / 11 - 2 / 11 * math.sqrt(5 / 3)), (124 + 7 * math.sqrt(15)) / 350),
            (math.sqrt(5 / 11 + 2 / 11 * math.sqrt(5 / 3)), (124 - 7 * math.sqrt(15)) / 350),
        ),
    ),
)
LONGEST = QUADRATURES[-1][0]

#: Beyond this many sub-steps between two passages of the separatrix's saddle the motion has left the range of doubles.
MOST_SUBSTEPS = 8192

#: Squares of angular momenta outside this range are rescaled, and phases above `PHASE_CAP` mean nothing in doubles.
SQUARE_RANGE = (1e-240, 1e240)
PHASE_CAP = 1e100


class Rule(NamedTuple):
    """A quadrature rule over the half steps on both sides of the middle, for the series that reach as far."""

    series: Callable
    times: tuple[float, ...]  # of the step, from the middle; the first is its end
    weights: tuple[float, ...]

    @classmethod
    def of(cls, series, end_weight, nodes) -> Rule:
        return cls(series, (0.5, *(0.5 * node for node, _ in nodes)), (end_weight, *(weight for _, weight in nodes)))


SHORT_RULE = Rule.of(short_sn_coefficients, *QUADRATURES[0][1:])
RULE = Rule.of(sn_coefficients, *QUADRATURES[1][1:])
#: For the compiled loops: of `RULE`, and the limits beyond which a body is left to `rotate_far`.
COMPILED_RULE = (RULE.times, RULE.weights, (LONGEST, *SQUARE_RANGE))


class Top(NamedTuple):
    """Inverse moments in descending order, and the way from principal axes in the user's order to that order."""

    rates: np.ndarray  # (3,) or (3, n)
    order: np.ndarray  # same shape: row i of the sorted frame is row order[i] of the user's
    parity: np.ndarray  # () or (n,): sign that the middle axis takes, so that the sorted frame stays right-handed

    @property
    def frame(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Bodies with equal moments, for the compiled loops."""
        return self.rates, self.order, float(self.parity)

    def part(self, index) -> Top:
        return self if self.rates.ndim == 1 else Top(self.rates[:, index], self.order[:, index], self.parity[index])

    def sort(self, v):
        """Components (x, y, z) in the sorted frame of vectors (3, n)."""
        if self.rates.ndim == 1:
            x, y, z = (v[row] for row in self.order)
        else:
            x, y, z = np.take_along_axis(v, self.order, axis=0)
        return x, y * self.parity, z

    def unsort(self, x, y, z):
        """Components in the user's frame."""
        if self.rates.ndim == 1:
            rows = dict(zip(self.order.tolist(), (x, y * self.parity, z), strict=True))
            return rows[0], rows[1], rows[2]
        v = np.empty((3, x.size))
        np.put_along_axis(v, self.order, np.stack([x, y * self.parity, z]), axis=0)
        return v[0], v[1], v[2]


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
    return kernels.combine(L, A[:, 0], A[:, 1], A[:, 2])


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
    if bodies.rates.ndim == 1 and (loops := executor()) is not None:
        far = np.empty(n, dtype=bool)
        everyone = slice(0, n)
        if loops.rotate(everyone, A, L, h, bodies.frame, COMPILED_RULE, new, far):
            rotate_far(bodies, everyone, A, L, h, new, far)
    else:
        _demand_finite(A, L)
        for start in range(0, n, BLOCK):
            block = slice(start, min(start + BLOCK, n))
            new[:, :, block] = _rotate_block(bodies.part(block), A[:, :, block], L[:, block], h)
    return new, L.copy()


def rotate_far(bodies: Top, part: slice, A, L, h, new, far) -> None:
    """Write the new attitudes of those in a slice of the bodies that the compiled loops left aside.

    Args:
        bodies: their moments.
        part: the slice.
        A, L, h: as for `exact`, of all bodies.
        new: (3, 3, n), written.
        far: (n,), bool, of those left aside.
    """
    left = part.start + np.flatnonzero(far[part])
    _demand_finite(A[:, :, left], L[:, left], left)
    new[:, :, left] = _rotate_block(bodies, A[:, :, left], L[:, left], h)


def _demand_finite(A, L, numbers=None) -> None:
    for name, values in (("angular momentum", L[None]), ("attitude", A)):
        if not np.isfinite(values).all():
            body = int(np.isfinite(values).all(axis=(0, 1)).argmin())
            raise ValueError(f"the {name} of body {body if numbers is None else numbers[body]} is not finite")


def _rotate_block(bodies: Top, A, L, h):
    """The new attitudes, executed by NumPy."""
    w, x, y, z = _turn(bodies, bodies.sort(body_frame(A, L)), h)
    rows = kernels.rotation_matrix(w, *bodies.unsort(x, y, z))
    new = np.empty_like(A)
    for i, row in enumerate(rows):
        new[i] = kernels.combine(row, A[0], A[1], A[2])
    return new


def _turn(bodies: Top, body_L, h):
    """Quaternion (w, i, j, k) of the body frame's rotation over h, in the sorted frame, of any norm."""
    x, y, z = body_L
    with np.errstate(over="ignore"):
        square = x * x + y * y + z * z
    low, high = SQUARE_RANGE
    if not (square.min() >= low and square.max() <= high):
        return _turn_scaled(bodies, body_L, h)
    norm = np.sqrt(square)
    return _turn_unit(bodies.rates, (x / norm, y / norm, z / norm), norm * h)


def _turn_scaled(bodies: Top, body_L, h):
    """`_turn` for angular momenta that vanish or whose squares leave the range of doubles."""
    scale = np.max(np.abs(body_L), axis=0)
    x, y, z = np.stack(body_L) / np.where(scale > 0, scale, 1.0)
    norm = np.sqrt(x * x + y * y + z * z)
    x, unit = np.where(norm > 0, (x, norm), 1.0)  # A body at rest does not turn about any axis.
    with np.errstate(over="ignore", under="ignore"):
        k = np.clip(norm * (scale * h), -1e300, 1e300)
    return _turn_unit(bodies.rates, (x / unit, y / unit, z / unit), k)


def _turn_unit(rates, u, k):
    """`_turn` for directions u and k = |L| h; the few bodies that the series do not reach go their own way."""
    with np.errstate(over="ignore", invalid="ignore"):
        moved = kernels.motion(rates, u, k)
    phases = np.maximum(moved[3], moved[4])
    largest = phases.max()
    if largest <= LONGEST and np.abs(k).max() * np.max(rates[0]) <= PHASE_CAP:
        return _short_turn(rates, moved, u, k, SHORT_RULE if largest <= QUADRATURES[0][0] else RULE)[0]
    far = ~((phases <= LONGEST) & (np.abs(k) * rates[0] <= PHASE_CAP))
    near_k = np.where(far, 0.0, k)
    near = kernels.motion(rates, u, near_k)
    turns = np.stack(_short_turn(rates, near, u, near_k, RULE)[0])
    rates_far = np.broadcast_to(np.reshape(rates, (3, -1)), (3, k.size))[:, far]
    turns[:, far] = _long_turn(rates_far, np.stack(u)[:, far], k[far])
    return turns


def _short_turn(rates, moved, u, k, rule: Rule):
    """The free rotation over one step that the series reach.

    Args:
        rates: inverse moments, (3,) or (3, n).
        moved: what `kernels.motion` gave.
        u: direction of L~.
        k: |L| h, (n,).
        rule: for the largest of the squared phases.

    Returns:
        The quaternion of the body frame's rotation, and the direction of L~ after it.
    """
    _, _, _, p, q = moved
    times, weights = np.array(rule.times)[:, None], np.array(rule.weights)[:, None]
    # All times at once: small sets of bodies pay for every call of a function.
    increments = sn_increment(rule.series(p, q), p, q, times)
    end = tuple(values[0] for values in increments)
    m = kernels.plus(*kernels.even_and_odd(moved, u, end))
    excess_weights = kernels.excess_weights(rates, moved, m)
    excess = (weights * kernels.rate_excess(excess_weights, increments)).sum(axis=0)
    half_theta = 0.5 * k * (excess_weights[0] + excess)
    e, o = kernels.even_and_odd(moved, m, end)
    return kernels.join(m, e, o, np.sin(half_theta), np.cos(half_theta)), kernels.plus(e, o)


# --- steps that the series do not reach -------------------------------------------------------------------------


def _long_turn(rates, u, k):
    """Quaternion of the rotation over a step in which some body nutates further than the series reach.

    Whole periods of L~ are turns about L; the rest is cut into sub-steps, composed exactly.
    """
    cap = PHASE_CAP / np.maximum(rates[0], 1e-200)
    k = np.clip(k, -cap, cap)
    _, _, _, p, q = kernels.motion(rates, u, k)
    phase = np.sqrt(np.maximum(p, q))
    rest, whole = np.ones_like(k), np.zeros_like(k)
    # No period of L~ is shorter than 2 pi in phase.
    if (long := phase > 3).any():
        rest[long], whole[long] = _whole_periods(rates[:, long], u[:, long], k[long])
    turns = np.stack(_about(u, whole))

    pieces = np.maximum(np.ceil(phase * np.abs(rest) / np.sqrt(LONGEST)), 1)
    short = np.minimum(pieces, MOST_SUBSTEPS) / pieces
    pieces = np.minimum(pieces, MOST_SUBSTEPS).astype(int)
    k_piece = k * (rest * short) / pieces

    active = np.arange(k.size)
    for done in range(pieces.max()):
        active = active[pieces[active] > done]
        part = (rates[:, active], u[:, active], k_piece[active])
        step, v = _short_turn(part[0], kernels.motion(*part), *part[1:], RULE)
        turns[:, active] = _normalized(_product(step, turns[:, active]))
        u[:, active] = _normalized(v)
    # What is left over belongs to a state on the separatrix to its last bit. Nothing in the state says when it leaves
    # the saddle, the middle axis, so it is left there.
    return _product(_about(u, k * (rest * (1 - short)) * rates[1]), turns)


def _whole_periods(rates, u, k):
    """The fraction of a step that is left after whole periods of L~, and the turn in those."""
    a, b, c = rates
    alpha, beta, gamma, p, q = kernels.motion(rates, u, k)
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
    return 1 - spent, k * spent * (pole + 0.5 * (b - pole) * Q)


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
