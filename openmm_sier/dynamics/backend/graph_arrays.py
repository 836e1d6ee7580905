"""Constraint graphs executed by NumPy: conjugate gradients on all components at once, in place of sparse elimination.

Velocities that satisfy the constraints to first order are a least-squares problem, which conjugate gradients on the
normal equations (CGLS; Paige and Saunders, ACM Trans. Math. Softw. 8, 43 (1982), section 7.1) solve for redundant
constraints as well. Rows are scaled to length one; bonds of molecules then need some 20 to 40 iterations for 12 digits.

Positions x, relative to the first atom of each component, and velocities v are (3, atoms), bonds (3, constraints).
"""

from __future__ import annotations

import numpy as np
from numpy import ndarray

from openmm_sier.dynamics.backend.constraint_tables import Graphs
from openmm_sier.dynamics.backend.graph_loops import GRAPH_CLOSE

#: Factor by which each solution of the linear equations reduces residuals. More would be useless, since these equations
#: neglect the motion.
REDUCTION = 1e-3

#: Linear and nonlinear iterations; reached only where there is no solution.
LINEAR, NONLINEAR = 400, 30


def taken(graphs: Graphs, q: ndarray, p: ndarray) -> tuple[ndarray, ndarray]:
    """Positions and velocities of the graphs' atoms from columns of positions and momenta, (3, n)."""
    return q[:, graphs.atoms] - q[:, graphs.first_atoms], p[:, graphs.atoms] * graphs.inverse_masses


def put_positions(graphs: Graphs, q: ndarray, x: ndarray, new_q: ndarray) -> None:
    """Write positions as columns of new_q."""
    new_q[:, graphs.atoms] = q[:, graphs.first_atoms] + x


def put_momenta(graphs: Graphs, p: ndarray, v: ndarray, new_p: ndarray) -> None:
    """Write momenta as columns of new_p; the first atom takes the remainder, which conserves the total to rounding."""
    new = v / graphs.inverse_masses
    low = graphs.starts[:, 0]
    new[:, low] += np.add.reduceat(p[:, graphs.atoms] - new, low, axis=1)
    new_p[:, graphs.atoms] = new


def constrain(graphs: Graphs, x: ndarray, v: ndarray, d: float) -> tuple[ndarray, ndarray, int]:
    """Velocities with which x + d v satisfies the constraints, changed along their gradients at x.

    Returns:
        (positions reached, velocities, the first component without a solution or -1).
    """
    before = _bonds(graphs, x)
    residuals = np.zeros(0)
    for _ in range(NONLINEAR):
        reached = x + d * v
        after = _bonds(graphs, reached)
        lacking = graphs.squares - np.einsum("ae,ae->e", after, after)
        found = np.abs(lacking) / graphs.squares
        if not np.isfinite(found).all():
            # The last finite residuals show the constraints that have no solution, unless free motion is not finite.
            residuals = residuals if len(residuals) else np.where(np.isfinite(found), 0.0, np.inf)
            break
        residuals = found
        v = v + _least_change(graphs, before, (0.5 / d) * lacking, REDUCTION)
        if residuals.max() < GRAPH_CLOSE:
            return x + d * v, v, -1
    return reached, v, int(np.searchsorted(graphs.starts[:, 3], residuals.argmax(), side="right"))


def project(graphs: Graphs, x: ndarray, v: ndarray) -> ndarray:
    """Velocities without what changes the lengths of the constraints; the second pass removes rounding."""
    bonds = _bonds(graphs, x)
    for _ in range(2):
        rates = np.einsum("ae,ae->e", bonds, _bonds(graphs, v))
        v = v + _least_change(graphs, bonds, -rates, 1e-10)
    return v


def _bonds(graphs: Graphs, x: ndarray) -> ndarray:
    i, j = graphs.columns_of_ends
    return x[:, i] - x[:, j]


def _least_change(graphs: Graphs, bonds: ndarray, wanted: ndarray, reduction: float) -> ndarray:
    """Least velocities (3, atoms), in the metric of the masses, that change half the squared lengths as wanted."""
    i, j = graphs.columns_of_ends
    roots = np.sqrt(graphs.inverse_masses)
    scale = 1 / np.sqrt(np.einsum("ae,ae->e", bonds, bonds) * (graphs.inverse_masses[i] + graphs.inverse_masses[j]))
    rows = scale * bonds

    def transposed(values: ndarray) -> ndarray:
        sums = [np.bincount(i, row, len(roots)) - np.bincount(j, row, len(roots)) for row in rows * values]
        return roots * np.array(sums)

    z = np.zeros((3, len(roots)))
    residual = scale * wanted
    gradient = transposed(residual)
    direction, size = gradient, np.vdot(gradient, gradient)
    enough = reduction**2 * size
    for _ in range(LINEAR):
        if not size > enough:
            break
        change = np.einsum("ae,ae->e", rows, _bonds(graphs, roots * direction))
        step = size / np.vdot(change, change)
        z += step * direction
        residual = residual - step * change
        gradient = transposed(residual)
        size, last = np.vdot(gradient, gradient), size
        direction = gradient + (size / last) * direction
    return roots * z
