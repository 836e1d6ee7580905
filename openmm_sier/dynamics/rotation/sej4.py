"""The free-rotation map SEJ4, to which van Zon and Schofield (2007) compare theirs."""

import math

import numpy as np

from openmm_sier.dynamics.rotation.axes import checked
from openmm_sier.dynamics.rotation.exact import exact
from openmm_sier.dynamics.vectors import body_frame, combine, cross, rotation_matrix, turned

#: First node of the two-point Gauss rule on (0, 1); the second is as far from the end.
GAUSS_NODE = 0.5 - math.sqrt(3) / 6


def sej4(A: np.ndarray, L: np.ndarray, moments: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
    """Rotate freely by the scheme SEJ4 of Celledoni and Säfström: L~ exact, A by a fourth-order Magnus step.

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
    rows = axes.sort(A)
    rates = axes.rates.reshape(3, -1)
    times = GAUSS_NODE * h, (1 - GAUSS_NODE) * h, h
    first, second, end = (body_frame(axes.sort(exact(A, L, moments, time)[0]), L) for time in times)
    turn1, turn2 = h * rates * first, h * rates * second
    omega = 0.5 * (turn1 + turn2) + math.sqrt(3) / 12 * np.stack(cross(turn1, turn2))
    half = 0.5 * np.sqrt((omega * omega).sum(axis=0))
    # The lab, seen from the body, turns back. NumPy's sinc(x) is sin(pi x)/(pi x), regular at 0.
    new = turned(rotation_matrix(np.cos(half), *(-0.5 * np.sinc(half / np.pi) * omega)), rows)
    return axes.unsort(new), combine(end, *new)
