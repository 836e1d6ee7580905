"""Constraint graphs executed by NumPy: conjugate gradients on all components at once, in place of sparse elimination.

Velocities that satisfy the constraints to first order are a least-squares problem, which conjugate gradients on the
normal equations (CGLS; Paige and Saunders, ACM Trans. Math. Softw. 8, 43 (1982), section 7.1) solve for redundant
constraints as well. Rows are scaled to length one; bonds of molecules then need some 20 to 40 iterations for 12 digits.

Vectors are component-first, (3, atoms) and (3, constraints).
"""

from __future__ import annotations

import numpy as np

from openmm_sier.dynamics.backend.graph_loops import GRAPH_CLOSE

#: Factor by which each solution of the linear equations reduces residuals. More would be useless, since these equations
#: neglect the motion.
REDUCTION = 1e-3

#: Linear and nonlinear iterations; reached only where there is no solution.
LINEAR, NONLINEAR = 400, 30


class GraphArrays:
    """The constraints of all graphs with the atoms that they join."""

    def __init__(self, ends: np.ndarray, squares: np.ndarray, inverse_masses: np.ndarray):
        """
        Args:
            ends: (constraints, 2), numbers of atoms.
            squares: (constraints,), squared lengths.
            inverse_masses: (atoms,).
        """
        self.i, self.j = np.ascontiguousarray(ends.T)
        self.squares, self.inverse_masses = squares, inverse_masses
        self.roots = np.sqrt(inverse_masses)

    def bonds(self, x: np.ndarray) -> np.ndarray:
        return x[:, self.i] - x[:, self.j]

    def constrain(self, x: np.ndarray, v: np.ndarray, d: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Velocities with which x + d v satisfies the constraints, changed along their gradients at x.

        Returns:
            (positions reached, velocities, relative residuals before the last update). Without a solution, the
            residuals are the last finite ones, which show the constraints that have none; they are infinite where
            even free motion is not finite.
        """
        before = self.bonds(x)
        residuals = np.zeros(0)
        for _ in range(NONLINEAR):
            reached = x + d * v
            after = self.bonds(reached)
            lacking = self.squares - np.einsum("ae,ae->e", after, after)
            found = np.abs(lacking) / self.squares
            if not np.isfinite(found).all():
                residuals = residuals if len(residuals) else np.where(np.isfinite(found), 0.0, np.inf)
                break
            residuals = found
            v = v + self._least_change(before, (0.5 / d) * lacking, REDUCTION)
            if residuals.max() < GRAPH_CLOSE:
                return x + d * v, v, residuals
        return reached, v, residuals

    def project(self, x: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Velocities without what changes the lengths of the constraints; the second pass removes rounding."""
        bonds = self.bonds(x)
        for _ in range(2):
            rates = np.einsum("ae,ae->e", bonds, self.bonds(v))
            v = v + self._least_change(bonds, -rates, 1e-10)
        return v

    def _least_change(self, bonds: np.ndarray, wanted: np.ndarray, reduction: float) -> np.ndarray:
        """Least velocities (3, atoms), in the metric of the masses, that change half the squared lengths as wanted."""
        scale = 1 / np.sqrt(
            np.einsum("ae,ae->e", bonds, bonds) * (self.inverse_masses[self.i] + self.inverse_masses[self.j])
        )
        rows = scale * bonds
        z = np.zeros((3, len(self.roots)))
        residual = scale * wanted
        gradient = self._transposed(rows, residual)
        direction, size = gradient, np.vdot(gradient, gradient)
        enough = reduction**2 * size
        for _ in range(LINEAR):
            if not size > enough:
                break
            change = np.einsum("ae,ae->e", rows, self.bonds(self.roots * direction))
            step = size / np.vdot(change, change)
            z += step * direction
            residual = residual - step * change
            gradient = self._transposed(rows, residual)
            size, last = np.vdot(gradient, gradient), size
            direction = gradient + (size / last) * direction
        return self.roots * z

    def _transposed(self, rows: np.ndarray, values: np.ndarray) -> np.ndarray:
        n = len(self.roots)
        along = rows * values
        sums = [np.bincount(self.i, row, n) - np.bincount(self.j, row, n) for row in along]
        return self.roots * np.array(sums)
