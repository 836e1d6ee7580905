"""The free-rotation maps that van Zon and Schofield (2007) compare theirs with.

Both have the signature of `rotor.exact`, (A, L, moments, h) -> (A, L), and take its place in every scheme:
`propagation.drift(bodies, baselines.mrdl)`, `SIERIntegrator(h, rotation=baselines.sej4)`. With the scheme SIER2 they
give the integrators that the paper calls MRDL and SEJ4.

Notation as in `rotor`: rows of A are the principal axes in the lab frame, L~ = A L, omega~ = I~^-1 L~.
"""

from __future__ import annotations

import math

import numpy as np

from openmm_sier.dynamics.backend import kernels
from openmm_sier.dynamics.backend.elliptic import SERIES_LIMIT, sn_coefficients, sn_increment
from openmm_sier.dynamics.rotation import rotor

#: Factors of MRDL: principal axis (0 has the smallest moment, 2 the largest) and fraction of the step.
MRDL_FACTORS = ((0, 0.5), (1, 0.5), (2, 1.0), (1, 0.5), (0, 0.5))

#: Where the two-point Gauss rule on (0, 1) has its first node; the second lies as far from the end.
GAUSS_NODE = 0.5 - math.sqrt(3) / 6

#: Largest squared phase of the nutation in one step for which the series reach from a Gauss node to the middle, and how
#: often this way may be halved before `rotor.exact` is the better way to L~.
_SERIES_REACH = SERIES_LIMIT / (0.5 - GAUSS_NODE) ** 2
_MOST_HALVINGS = 3

#: Squares of angular momenta outside this range go through `rotor.exact`, which rescales them.
_SQUARE_RANGE = (1e-240, 1e240)


def mrdl(A, L, moments, h):
    """Free rotation by the splitting of McLachlan, Reich, Dullweber and Leimkuhler: second order, symplectic, L exact.

    The kinetic energy is split into those of the principal axes; each part turns the body about its axis by the
    angle h L~_k / I_k. The order of the factors makes a difference: here the axis of the smallest moment is outermost
    and that of the largest in the middle, which is the order whose errors are nearest to those in the paper.

    Args:
        A: attitude matrices, shape (3, 3, n); rows are the principal axes in the lab frame.
        L: angular momenta in the lab frame, shape (3, n), dalton nm^2/ps.
        moments: principal moments, shape (3,) or (3, n), dalton nm^2, in any order. Linear bodies have only one moment
            and nothing to split: they turn exactly, and so do bodies at rest and points.
        h: time in ps, a float of either sign.

    Returns:
        (A, L) after the time h, new arrays; L is conserved.

    Raises:
        ValueError: as `rotor.exact`.

    Source: A. Dullweber, B. Leimkuhler and R. McLachlan, J. Chem. Phys. 107, 5840 (1997); S. Reich, Fields Inst.
    Commun. 10, 181 (1996).
    """
    moments, A, L, h = _checked(A, L, moments, h)
    linear = (moments == 0).any(axis=0) & (moments > 0).any(axis=0)
    if linear.all():
        return rotor.exact(A, L, moments, h)
    new = np.empty_like(A)
    for block, bodies in _blocks(moments, A.shape[2]):
        rows = _sorted_rows(bodies, A[:, :, block])
        body_L = np.stack(rotor.body_frame(rows, L[:, block]))
        for axis, fraction in MRDL_FACTORS:
            _turn_about_axis(axis, fraction * h * bodies.rates[axis] * body_L[axis], rows, body_L)
        new[:, :, block] = _unsorted_rows(bodies, rows)
    if linear.any():
        new[:, :, linear], _ = rotor.exact(A[:, :, linear], L[:, linear], moments[:, linear], h)
    return new, L.copy()


def sej4(A, L, moments, h):
    """Free rotation by the scheme SEJ4 of Celledoni and Säfström: L~ exact, A by a fourth-order Magnus step.

    With the exact angular velocities w1 and w2 (body frame) at the two Gauss points of the step,

        Omega = h/2 (w1 + w2) + sqrt(3)/12 h^2 w1 x w2,     A* = exp(-[Omega]x) A,     L* = A*^T L~*.

    The sign of the commutator belongs to dA/dt = -[w]x A. L~* is exact and A* is not, so that the energy is conserved
    but the angular momentum in the lab frame is not. The map is not symplectic.

    Args:
        A: attitude matrices, shape (3, 3, n); rows are the principal axes in the lab frame.
        L: angular momenta in the lab frame, shape (3, n), dalton nm^2/ps.
        moments: principal moments, shape (3,) or (3, n), dalton nm^2, in any order. Where L~ keeps its direction
            (linear bodies, spherical tops, rotation about a principal axis) the map is exact.
        h: time in ps, a float of either sign.

    Returns:
        (A, L) after the time h, new arrays.

    Raises:
        ValueError: as `rotor.exact`.

    Source: E. Celledoni and N. Säfström, J. Phys. A 39, 5463 (2006); van Zon and Schofield (2007), Sec. IV A.
    """
    moments, A, L, h = _checked(A, L, moments, h)
    new_A, new_L = np.empty_like(A), np.empty_like(L)
    for block, bodies in _blocks(moments, A.shape[2]):
        rows = _sorted_rows(bodies, A[:, :, block])
        w1, w2, end = _gauss_velocities(bodies.rates, rows, L[:, block], h)
        turn1, turn2 = h * w1, h * w2
        omega = 0.5 * (turn1 + turn2) + math.sqrt(3) / 12 * _cross(turn1, turn2)
        rows = _rotated(omega, rows)
        new_L[:, block] = kernels.combine(end, *rows)
        new_A[:, :, block] = _unsorted_rows(bodies, rows)
    return new_A, new_L


def _checked(A, L, moments, h):
    moments, h = np.asarray(moments, dtype=float), float(h)
    A, L = np.asarray(A, dtype=float), np.asarray(L, dtype=float)
    if A.ndim != 3 or A.shape[:2] != (3, 3) or L.shape != (3, A.shape[2]):
        raise ValueError(f"A must have shape (3, 3, n) and L (3, n), got {A.shape} and {L.shape}")
    if not math.isfinite(h):
        raise ValueError(f"h must be finite, got {h}")
    if moments.ndim == 2 and moments.shape[1] != A.shape[2]:
        raise ValueError(f"moments are given for {moments.shape[1]} bodies, A and L for {A.shape[2]}")
    if not np.isfinite(L).all():
        body = int(np.argmin(np.isfinite(L).all(axis=0)))
        raise ValueError(f"the angular momentum of body {body} is not finite")
    return moments, A, L, h


def _blocks(moments, n):
    """Slices of bodies whose arrays stay in cache, and their prepared moments."""
    bodies = rotor.top(moments)
    for start in range(0, n, rotor.BLOCK):
        block = slice(start, min(start + rotor.BLOCK, n))
        yield block, bodies.part(block)


def _sorted_rows(bodies, A):
    """A copy of A with the axes in ascending order of their moments, right-handed."""
    rows = A[bodies.order] if bodies.order.ndim == 1 else np.take_along_axis(A, bodies.order[:, None, :], axis=0)
    rows[1] *= bodies.parity
    return rows


def _unsorted_rows(bodies, rows):
    """The inverse of `_sorted_rows`."""
    rows = np.stack([rows[0], bodies.parity * rows[1], rows[2]])
    A = np.empty_like(rows)
    if bodies.order.ndim == 1:
        A[bodies.order] = rows
    else:
        np.put_along_axis(A, bodies.order[:, None, :], rows, axis=0)
    return A


def _turn_about_axis(axis, angle, rows, body_L):
    """Turn bodies about a principal axis, in place: the other two axes in the lab, and L~, which stays in the lab."""
    j, k = (axis + 1) % 3, (axis + 2) % 3
    c, s = np.cos(angle), np.sin(angle)
    for v in (rows, body_L):
        vj = c * v[j] + s * v[k]
        v[k] = c * v[k] - s * v[j]
        v[j] = vj


def _gauss_velocities(rates, rows, L, h):
    """Exact angular velocities (body frame) at the two Gauss points of a step, and L~ at its end, each (3, n)."""
    body_L = np.stack(rotor.body_frame(rows, L))
    rates = np.broadcast_to(rates.reshape(3, -1), body_L.shape)
    with np.errstate(over="ignore"):
        square = (body_L * body_L).sum(axis=0)
    far = ~((square >= _SQUARE_RANGE[0]) & (square <= _SQUARE_RANGE[1]))
    norm = np.sqrt(np.where(far, 1.0, square))
    u, k = body_L / norm, norm * h
    _, _, _, p, q = kernels.motion(rates, u, k)
    far |= ~(np.maximum(p, q) <= _SERIES_REACH * 4**_MOST_HALVINGS)
    velocities = _velocities_by_series(rates, u, norm, np.where(far, 0.0, k))
    if far.any():
        for near, value in zip(velocities, _velocities_by_attitude(rates, rows, L, h, far), strict=True):
            near[:, far] = value
    return velocities


def _velocities_by_series(rates, u, norm, k):
    moved = kernels.motion(rates, u, k)
    _, _, _, p, q = moved
    phase = np.maximum(p, q).max(initial=0.0)
    pieces = 1
    while phase > _SERIES_REACH * pieces**2:
        pieces *= 2
    series = sn_coefficients(p, q)
    to_node = sn_increment(series, p, q, GAUSS_NODE / pieces)
    to_middle = sn_increment(series, p, q, (0.5 - GAUSS_NODE) / pieces)

    def moved_on(direction, increments):
        for _ in range(pieces):
            direction = kernels.plus(*kernels.even_and_odd(moved, direction, increments))
        return direction

    first = moved_on(u, to_node)
    second = moved_on(moved_on(first, to_middle), to_middle)
    end = moved_on(second, to_node)
    scale = rates * norm
    return scale * np.stack(first), scale * np.stack(second), norm * np.stack(end)


def _velocities_by_attitude(rates, rows, L, h, chosen):
    """What `_gauss_velocities` gives, for chosen bodies, from the exact attitude; for any state and step."""
    rates, rows, L = rates[:, chosen], rows[:, :, chosen], L[:, chosen]
    moments = np.divide(1.0, rates, out=np.zeros_like(rates), where=rates > 0)
    attitudes = (rotor.exact(rows, L, moments, t)[0] for t in (GAUSS_NODE * h, (1 - GAUSS_NODE) * h, h))
    first, second, end = (np.stack(rotor.body_frame(A, L)) for A in attitudes)
    return rates * first, rates * second, end


def _cross(a, b):
    return np.stack(kernels.cross(a, b))


def _rotated(omega, rows):
    """exp(-[Omega]x) A by Rodrigues' formula; regular at Omega = 0."""
    angle = np.sqrt((omega * omega).sum(axis=0))
    sine = np.sinc(angle / np.pi)  # sin(angle)/angle
    half = np.sinc(angle / (2 * np.pi))
    once = _cross(omega[:, None, :], rows)
    twice = _cross(omega[:, None, :], once)
    return rows - sine * once + (0.5 * half * half) * twice
