"""Trajectories of Systems by an ODE solver, which shares nothing with the package's dynamics.

Named bodies move by Newton's and Euler's equations, and all other atoms with constraints whose multipliers follow from
the second derivatives of the squared lengths. So atoms in line and in a plane are no exception, to which solvers of
constraints are. Forces are those of a Context on the Reference platform whose virtual sites are placed each time.
SciPy's DOP853 keeps errors below `ACCURACY`, as velocity Verlet at 0.02 fs does not.
"""

from __future__ import annotations

import numpy as np
import openmm
from scipy.integrate import solve_ivp

from tests.laws.mixtures import Built, angular_velocity, constrained_pairs, gradients, masses_of, multipliers

#: Error of a step relative to positions and velocities, and absolutely.
ACCURACY = 1e-11


class Oracle:
    """The equations of motion of a System with named bodies."""

    def __init__(self, built: Built):
        self._masses = masses_of(built.system)
        self._bodies = [np.array(body) for body in built.named]
        in_bodies = np.isin(np.arange(len(self._masses)), np.concatenate([*self._bodies, []]))
        self._points = np.flatnonzero((self._masses > 0) & ~in_bodies)
        pairs, _ = constrained_pairs(built.system)
        place = np.full(len(self._masses), -1)
        place[self._points] = np.arange(len(self._points))
        self._pairs = place[pairs]
        self._x = built.positions
        self._v = built.velocities
        self._centres = [self._masses[body] @ self._x[body] / self._masses[body].sum() for body in self._bodies]
        self._shapes = [self._x[body] - centre for body, centre in zip(self._bodies, self._centres, strict=True)]
        reference = openmm.Platform.getPlatform("Reference")
        self._context = openmm.Context(built.system, openmm.VerletIntegrator(0.001), reference)

    def positions(self, time: float) -> np.ndarray:
        """Return positions (N, 3) in nm after a time in ps; those of virtual sites are in their places."""
        solution = solve_ivp(
            self._derivative, (0, time), self._start(), method="DOP853", rtol=ACCURACY, atol=ACCURACY, first_step=1e-4
        )
        assert solution.success, solution.message
        self._context.setPositions(self._atoms(solution.y[:, -1]))
        self._context.computeVirtualSites()
        return self._context.getState(positions=True).getPositions(asNumpy=True)._value.copy()

    def _start(self) -> np.ndarray:
        parts = [self._x[self._points], self._v[self._points]]
        for body, centre, shape in zip(self._bodies, self._centres, self._shapes, strict=True):
            masses, v = self._masses[body], self._v[body]
            momentum = (masses[:, None] * np.cross(shape, v)).sum(axis=0)
            parts += [centre[None], (masses @ v / masses.sum())[None], np.eye(3), momentum[None]]
        return np.concatenate([part.ravel() for part in parts])

    def _split(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[tuple[np.ndarray, ...]]]:
        """Return positions and velocities of points, and centre, velocity, turn and angular momentum of bodies."""
        n = len(self._points)
        x, v = y[: 6 * n].reshape(2, n, 3)
        rows = y[6 * n :].reshape(-1, 6, 3)
        return x, v, [(row[0], row[1], row[2:5], row[5]) for row in rows]

    def _atoms(self, y: np.ndarray) -> np.ndarray:
        points, _, states = self._split(y)
        x = self._x.copy()
        x[self._points] = points
        for body, shape, (centre, _, turn, _) in zip(self._bodies, self._shapes, states, strict=True):
            x[body] = centre + shape @ turn.T
        return x

    def _derivative(self, _time: float, y: np.ndarray) -> np.ndarray:
        x = self._atoms(y)
        self._context.setPositions(x)
        self._context.computeVirtualSites()
        forces = self._context.getState(forces=True).getForces(asNumpy=True)._value
        points, v, states = self._split(y)
        parts = [v, self._accelerations(points, v, forces[self._points])]
        for body, (centre, velocity, turn, momentum) in zip(self._bodies, states, strict=True):
            masses, r = self._masses[body], x[body] - centre
            spin = angular_velocity(masses, r, momentum)
            turning = np.cross(spin, turn.T).T
            torque = np.cross(r, forces[body]).sum(axis=0)
            parts += [velocity[None], (forces[body].sum(axis=0) / masses.sum())[None], turning, torque[None]]
        return np.concatenate([part.ravel() for part in parts])

    def _accelerations(self, x: np.ndarray, v: np.ndarray, forces: np.ndarray) -> np.ndarray:
        masses = self._masses[self._points][:, None]
        if not len(self._pairs):
            return forces / masses
        rows = gradients(self._pairs, x)
        weighted = rows / masses
        bending = ((v[self._pairs[:, 0]] - v[self._pairs[:, 1]]) ** 2).sum(axis=1)
        right = weighted.reshape(len(rows), -1) @ forces.ravel() + bending
        return forces / masses - np.tensordot(multipliers(rows, weighted, right), weighted, 1)
