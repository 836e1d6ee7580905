"""The longest step of a splitting scheme for a harmonic mode, from the matrix by which it propagates the mode.

In x = (omega h)^2 all entries of that matrix are polynomials: with (q, h p/m) as coordinates a kick of fraction t is
[[1, 0], [-t x, 1]], a gradient kick of shift s is [[1, 0], [-t x (1 - s x), 1]], and a drift [[1, t], [0, 1]].
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from openmm_sier.dynamics.stages import DRIFT, KICK, Stage

#: The mean kinetic energy of a mode may differ from its potential energy by this fraction at `accuracy_limit`. For
#: velocity Verlet that is at ten steps a period, a common rule of thumb.
INEQUALITY = 0.1

#: Two roots nearer than this fraction are one where a curve touches a limit, parted by the rounding of coefficients: a
#: mode between them would grow by less than this in a step.
TOUCHING = 1e-5


def stability_limit(stages: Sequence[Stage]) -> float:
    """Largest omega h below which the amplitude of a harmonic mode stays bounded.

    The matrix has the determinant 1, so that its eigenvalues are on the unit circle where |trace| < 2. Where the trace
    touches 2 or -2 and turns back, the matrix is 1 or -1, and the mode is bounded there too.
    """
    (a, _), (_, d) = _propagation(stages)
    x = _polynomial(0.0, 1.0)
    trace = a + d
    # The trace is 2 at x = 0, which is no limit.
    roots = sorted([*_positive_roots((trace - 2) // x), *_positive_roots(trace + 2)])
    return _first(roots, lambda at: abs(trace(at)) > 2)


def accuracy_limit(stages: Sequence[Stage]) -> float:
    """Largest omega h below which the mean kinetic and potential energies of a mode agree within `INEQUALITY`.

    The matrix [[a, b], [c, d]] conserves b (h p/m)^2 + (a - d) q (h p/m) - c q^2. So the mean of the potential energy
    over that of the kinetic one is -x b / c. Where both are zero the matrix is 1 or -1, which has no such ratio.
    """
    (_, b), (c, _) = _propagation(stages)
    c = c // _polynomial(0.0, 1.0)
    roots = sorted(root for factor in (1 - INEQUALITY, 1 + INEQUALITY) for root in _positive_roots(b + factor * c))
    return min(stability_limit(stages), _first(roots, lambda at: abs(b(at) / c(at) + 1) > INEQUALITY))


def _first(roots: Sequence[float], is_beyond: Callable[[float], bool]) -> float:
    """Square root of the first of the sorted roots beyond which a limit is exceeded; infinity if there is none."""
    for root, after in pairwise([*roots, math.inf]):
        # Whether it is exceeded cannot change between two roots.
        if after > root * (1 + TOUCHING) and is_beyond(0.5 * (root + min(after, 2 * root))):
            return math.sqrt(root)
    return math.inf


def _propagation(stages: Sequence[Stage]) -> tuple[Any, Any]:
    """Rows of the matrix. Stages that are neither kick nor drift, such as a heat bath, are left out."""
    one, zero, x = _polynomial(1.0), _polynomial(0.0), _polynomial(0.0, 1.0)
    q, p = (one, zero), (zero, one)
    for stage in stages:
        if stage.operator == DRIFT:
            q = q[0] + stage.fraction * p[0], q[1] + stage.fraction * p[1]
        elif stage.flow == KICK:
            pull = stage.fraction * x * (1 - stage.shift * x)
            p = p[0] - pull * q[0], p[1] - pull * q[1]
    return q, p


def _polynomial(*coefficients: float) -> Any:
    # NumPy imports its polynomials when they are asked for, which takes a tenth of the time that this package does.
    return np.polynomial.Polynomial(coefficients)


def _positive_roots(polynomial: Any) -> list[float]:
    roots = polynomial.roots()
    # Roots of simple polynomials come with imaginary parts of rounding.
    real = roots.real[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 1e-9)]
    return real.tolist()
