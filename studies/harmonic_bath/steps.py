"""A step of SIER2 in a bath as an affine map, with its stationary distribution."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from studies.harmonic_bath.surfaces import Gaussian, Surface

#: ps. Modes of the fast forces with shorter periods are stretched by slow ones.
STIFF = 0.2

#: Doublings of the number of steps after which the distribution is stationary.
DOUBLINGS = 12


class Case(NamedTuple):
    """A step of SIER2 in a bath.

    Attributes:
        step: fs.
        inner: number of inner steps.
        friction: 1/ps.
        hydrogens: dalton; those of solutes have at most 3.
        solute: factor of the masses of the solute.
        has_neighbours: whether the neighbours move.
    """

    step: float = 9.0
    inner: int = 3
    friction: float = 5.0
    hydrogens: float = 4.0
    solute: float = 1.0
    has_neighbours: bool = True


def stationary(slow: Surface, fast: Surface, case: Case, thermal: float) -> Gaussian:
    """Return the distribution of positions at the end of steps, see `constrained.steps_around_bath`.

    Args:
        slow, fast: surfaces in mass-weighted coordinates.
        case: the step.
        thermal: k_B T, kJ/mol.
    """
    n, h = len(slow.gradient), 1e-3 * case.step
    inner, keeps = h / case.inner, math.exp(-case.friction * h)

    def kick(columns: np.ndarray, surface: Surface, time: float) -> None:
        force = surface.curvature @ columns[:n] + np.outer(surface.gradient, columns[-1])
        columns[n:-1] -= time * force

    def drift(columns: np.ndarray, time: float) -> None:
        columns[:n] += time * columns[n:-1]

    def from_bath(columns: np.ndarray) -> np.ndarray:
        drift(columns, inner / 2)
        for _ in range(case.inner // 2):
            kick(columns, fast, inner)
            drift(columns, inner)
        return columns

    # Positions, velocities, and a constant.
    step = np.eye(2 * n + 1)
    kick(step, slow, h)
    for _ in range(case.inner // 2):
        kick(step, fast, inner)
        drift(step, inner)
    kick(step, fast, inner)
    drift(step, inner / 2)
    step[n:-1] *= keeps
    step = from_bath(step)
    matrix, shift = step[:-1, :-1], step[:-1, -1]

    drawn = from_bath(np.eye(2 * n + 1)[:, n:-1])[:-1]
    covariance = thermal * (1 - keeps**2) * drawn @ drawn.T
    mean = np.linalg.solve(np.eye(2 * n) - matrix, shift)
    for _ in range(DOUBLINGS):
        covariance = covariance + matrix @ covariance @ matrix.T
        matrix = matrix @ matrix
    return Gaussian(mean[:n], covariance[:n, :n])


def stretched(slow: Surface, fast: Surface, case: Case, thermal: float) -> Gaussian:
    """Return a Boltzmann distribution with slow forces that are x/tan(x) times as large on stiff modes.

    Alone in a slow force f - s q, a mode of stiffness k has the mean c f / (k + c s) and the variance kT / (k + c s),
    c = x/tan(x), at any step. Several stiff modes follow the others at once, as they follow them at rest.
    """
    stiffness, modes = np.linalg.eigh(fast.curvature)
    is_stiff = stiffness > (2 * math.pi / STIFF) ** 2
    x = 0.5e-3 * case.step * np.sqrt(stiffness[is_stiff])
    share = np.ones(len(stiffness))
    share[is_stiff] = x / np.tan(x)
    gradient, curvature = modes.T @ slow.gradient, modes.T @ slow.curvature @ modes
    whole = np.diag(stiffness) + share[:, None] * curvature
    mean = np.linalg.solve(whole, (1 - share) * gradient)

    stiff, others = np.ix_(is_stiff, is_stiff), np.ix_(~is_stiff, ~is_stiff)
    alone = np.linalg.inv(whole[stiff])
    response = -alone @ whole[np.ix_(is_stiff, ~is_stiff)]
    softened = whole[others] + whole[np.ix_(~is_stiff, is_stiff)] @ response
    covariance = np.empty_like(whole)
    covariance[others] = thermal * np.linalg.inv((softened + softened.T) / 2)
    covariance[np.ix_(is_stiff, ~is_stiff)] = response @ covariance[others]
    covariance[np.ix_(~is_stiff, is_stiff)] = (response @ covariance[others]).T
    covariance[stiff] = thermal * (alone + alone.T) / 2 + response @ covariance[others] @ response.T
    return Gaussian(modes @ mean, modes @ covariance @ modes.T)
