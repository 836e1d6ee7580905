"""The free-rotation map SEJ4, with which van Zon and Schofield (2007) compare theirs."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from openmm_sier.dynamics.backend.elliptic import SERIES_LIMIT, sn_coefficients, sn_increment
from openmm_sier.dynamics.backend.formulas import body_frame, combine, cross, plus
from openmm_sier.dynamics.backend.short_steps import LARGEST_SQUARE, LEAST_SQUARE, euler_rates, euler_solution
from openmm_sier.dynamics.rotation.arguments import checked, demand_finite
from openmm_sier.dynamics.rotation.exact import exact

#: Where the two-point Gauss rule on (0, 1) has its first node; the second lies as far from the end.
GAUSS_NODE = 0.5 - math.sqrt(3) / 6

#: Largest squared phase of the nutation in one step for which the series reach from a Gauss node to the middle, and how
#: often this distance may be halved before L~ is better computed by `exact`.
_SERIES_REACH = SERIES_LIMIT / (0.5 - GAUSS_NODE) ** 2
_MOST_HALVINGS = 3


def sej4(A: np.ndarray, L: np.ndarray, moments: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
    """Free rotation by the scheme SEJ4 of Celledoni and Säfström: L~ exact, A by a fourth-order Magnus step.

    With the exact angular velocities w1 and w2 (body frame) at the two Gauss points of the step,

        Omega = h/2 (w1 + w2) + sqrt(3)/12 h^2 w1 x w2,     A* = exp(-[Omega]x) A,     L* = A*^T L~*.

    The sign of the commutator is that for dA/dt = -[w]x A. L~* is exact and A* is not, so that the energy is conserved
    but the angular momentum in the lab frame is not. The map is not symplectic.

    Arguments, result and errors are those of `exact`. Where L~ keeps its direction (linear bodies, spherical tops,
    rotation about a principal axis) the map is exact.

    Source: E. Celledoni and N. Säfström, J. Phys. A 39, 5463 (2006); van Zon and Schofield (2007), Sec. IV A.

    >>> A, L = np.eye(3)[:, :, None], np.array([[0.3], [0.2], [0.1]])
    >>> errors = [abs(sej4(A, L, (1, 2, 2.5), h)[0] - exact(A, L, (1, 2, 2.5), h)[0]).max() for h in (0.2, 0.1)]
    >>> round(errors[0] / errors[1])  # of one step: fifth order
    32
    """
    axes, A, L, h = checked(A, L, moments, h)
    demand_finite(L)
    rows = axes.sort(A)
    w1, w2, end = _gauss_velocities(axes.rates, rows, L, h)
    turn1, turn2 = h * w1, h * w2
    omega = 0.5 * (turn1 + turn2) + math.sqrt(3) / 12 * _cross(turn1, turn2)
    new = _rotated(omega, rows)
    return axes.unsort(new), combine(end, *new)


def _gauss_velocities(
    rates: np.ndarray, rows: np.ndarray, L: np.ndarray, h: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Exact angular velocities (body frame) at the two Gauss points of a step, and L~ at its end, each (3, n)."""
    body_L = body_frame(rows, L)
    rates = np.broadcast_to(rates.reshape(3, -1), body_L.shape)
    with np.errstate(over="ignore"):
        square = (body_L * body_L).sum(axis=0)
    far = ~((square >= LEAST_SQUARE) & (square <= LARGEST_SQUARE))
    norm = np.sqrt(np.where(far, 1.0, square))
    u, k = body_L / norm, norm * h
    motion = euler_rates(rates, u, k)
    far |= ~(np.maximum(motion.p, motion.q) <= _SERIES_REACH * 4**_MOST_HALVINGS)
    velocities = _velocities_by_series(rates, u, norm, np.where(far, 0.0, k))
    if far.any():
        for near, value in zip(velocities, _velocities_by_attitude(rates, rows, L, h, far), strict=True):
            near[:, far] = value
    return velocities


def _velocities_by_series(
    rates: np.ndarray, u: np.ndarray, norm: np.ndarray, k: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    motion = euler_rates(rates, u, k)
    p, q = motion.p, motion.q
    phase = np.maximum(p, q).max(initial=0.0)
    pieces = 1
    while phase > _SERIES_REACH * pieces**2:
        pieces *= 2
    series = sn_coefficients(p, q)
    to_node = sn_increment(series, p, q, GAUSS_NODE / pieces)
    to_middle = sn_increment(series, p, q, (0.5 - GAUSS_NODE) / pieces)

    def moved_on(direction: Any, increments: Any) -> Any:
        for _ in range(pieces):
            direction = plus(*euler_solution(motion, direction, increments))
        return direction

    first = moved_on(u, to_node)
    second = moved_on(moved_on(first, to_middle), to_middle)
    end = moved_on(second, to_node)
    scale = rates * norm
    return scale * np.stack(first), scale * np.stack(second), norm * np.stack(end)


def _velocities_by_attitude(
    rates: np.ndarray, rows: np.ndarray, L: np.ndarray, h: float, chosen: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What `_gauss_velocities` gives, for chosen bodies, from the exact attitude; for any state and step."""
    rates, rows, L = rates[:, chosen], rows[:, :, chosen], L[:, chosen]
    moments = np.divide(1.0, rates, out=np.zeros_like(rates), where=rates > 0)
    attitudes = (exact(rows, L, moments, t)[0] for t in (GAUSS_NODE * h, (1 - GAUSS_NODE) * h, h))
    first, second, end = (body_frame(A, L) for A in attitudes)
    return rates * first, rates * second, end


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.stack(cross(a, b))


def _rotated(omega: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """exp(-[Omega]x) A by Rodrigues' formula; regular at Omega = 0."""
    angle = np.sqrt((omega * omega).sum(axis=0))
    sine = np.sinc(angle / np.pi)  # sin(angle)/angle
    half = np.sinc(angle / (2 * np.pi))
    once = _cross(omega[:, None, :], rows)
    twice = _cross(omega[:, None, :], once)
    return rows - sine * once + (0.5 * half * half) * twice
