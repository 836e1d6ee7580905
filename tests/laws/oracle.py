"""Trajectories of Systems by an ODE solver, which shares nothing with the package's dynamics.

Named bodies move by Newton's and Euler's equations, and all other atoms with constraints whose multipliers follow from
the second derivatives of the squared lengths. So atoms in line and in a plane are no exception, to which solvers of
constraints are. Forces are those of a Context on the Reference platform whose virtual sites are placed each time.
SciPy's DOP853 keeps errors below `ACCURACY`, as velocity Verlet at 0.02 fs does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from tests.laws.mechanics import (
    angular_momentum,
    centre_of,
    constrained_pairs,
    cross,
    gradients,
    inverse_inertia,
    masses_of,
    multipliers,
    virtual_sites,
)
from tests.laws.mixtures import Built, harden
from tests.support.waters import phase_point, plain_context

#: Error of a step relative to positions and velocities, and absolutely.
ACCURACY = 1e-11


class End(NamedTuple):
    """Where a trajectory ends.

    Attributes:
        positions: (N, 3), nm; those of virtual sites are in their places.
        heat: that friction has taken, below zero, kJ/mol.
    """

    positions: np.ndarray
    heat: float


class Oracle:
    """The equations of motion of a System with named bodies, and with friction."""

    def __init__(
        self, built: Built, friction: float = 0.0, turning: float = 0.0, bodies: Sequence[Sequence[int]] | None = None
    ):
        """
        Args:
            built: the System and its start.
            friction: of atoms and centres of bodies, 1/ps.
            turning: friction of angular momenta of bodies, 1/ps.
            bodies: atoms with mass of each; None: those of the named ones.
        """
        self._friction = friction
        self._turning = turning
        self._masses = masses_of(built.system)
        self._bodies = [np.array(body) for body in (built.named if bodies is None else bodies)]
        in_bodies = np.isin(np.arange(len(self._masses)), np.concatenate([*self._bodies, []]))
        self._points = np.flatnonzero((self._masses > 0) & ~in_bodies)
        pairs, _ = constrained_pairs(built.system)
        place = np.full(len(self._masses), -1)
        place[self._points] = np.arange(len(self._points))
        self._pairs = place[pairs[~in_bodies[pairs].any(axis=1)]]
        self._x = built.positions
        self._v = built.velocities
        self._centres = [centre_of(self._masses[body], self._x[body]) for body in self._bodies]
        self._shapes = [self._x[body] - centre for body, centre in zip(self._bodies, self._centres, strict=True)]
        self._mobilities = [
            inverse_inertia(self._masses[body], shape) for body, shape in zip(self._bodies, self._shapes, strict=True)
        ]
        self._context = plain_context(built.system, built.positions)
        harden(self._context)
        self._has_sites = bool(virtual_sites(built.system))

    def kicked(self, time: float) -> np.ndarray:
        """Return the velocities (N, 3) of the start after its forces have acted for a time in ps, nm/ps."""
        self._place(self._x)
        forces = self._context.getState(forces=True).getForces(asNumpy=True)._value
        v = self._v.copy()
        resting = np.zeros((len(self._points), 3))
        v[self._points] += time * self._accelerations(self._x[self._points], resting, forces[self._points])
        for body, shape, mobility in zip(self._bodies, self._shapes, self._mobilities, strict=True):
            spin = mobility @ cross(shape, forces[body]).sum(axis=0)
            v[body] += time * (forces[body].sum(axis=0) / self._masses[body].sum() + cross(spin, shape))
        return v

    def end(self, time: float) -> End:
        """Return the end of a trajectory of a length in ps."""
        solution = solve_ivp(
            self._derivative, (0, time), self._start(), method="DOP853", rtol=ACCURACY, atol=ACCURACY, first_step=1e-4
        )
        assert solution.success, solution.message
        self._place(self._atoms(solution.y[:, -1]))
        return End(phase_point(self._context)[0], float(solution.y[-1, -1]))

    def _place(self, x: np.ndarray) -> None:
        self._context.setPositions(x)
        if self._has_sites:
            self._context.computeVirtualSites()

    def _start(self) -> np.ndarray:
        parts = [self._x[self._points], self._v[self._points]]
        for body, centre, shape in zip(self._bodies, self._centres, self._shapes, strict=True):
            masses, v = self._masses[body], self._v[body]
            momentum = angular_momentum(masses, shape, v)
            parts += [centre[None], centre_of(masses, v)[None], np.eye(3), momentum[None]]
        return np.concatenate([*(part.ravel() for part in parts), [0.0]])

    def _split(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[tuple[np.ndarray, ...]]]:
        """Return positions and velocities of points, and centre, velocity, turn and angular momentum of bodies."""
        n = len(self._points)
        x, v = y[: 6 * n].reshape(2, n, 3)
        rows = y[6 * n : -1].reshape(-1, 6, 3)
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
        self._place(x)
        forces = self._context.getState(forces=True).getForces(asNumpy=True)._value
        points, v, states = self._split(y)
        parts = [v, self._accelerations(points, v, forces[self._points]) - self._friction * v]
        power = self._friction * float((self._masses[self._points] * (v * v).sum(axis=1)).sum())
        for body, mobility, (centre, velocity, turn, momentum) in zip(
            self._bodies, self._mobilities, states, strict=True
        ):
            spin = turn @ (mobility @ (momentum @ turn))
            turning = cross(spin, turn.T).T
            mass = self._masses[body].sum()
            torque = cross(x[body] - centre, forces[body]).sum(axis=0) - self._turning * momentum
            acceleration = forces[body].sum(axis=0) / mass - self._friction * velocity
            parts += [velocity[None], acceleration[None], turning, torque[None]]
            power += self._friction * mass * float(velocity @ velocity) + self._turning * float(momentum @ spin)
        return np.concatenate([*(part.ravel() for part in parts), [-power]])

    def _accelerations(self, x: np.ndarray, v: np.ndarray, forces: np.ndarray) -> np.ndarray:
        masses = self._masses[self._points][:, None]
        if not len(self._pairs):
            return forces / masses
        rows = gradients(self._pairs, x)
        weighted = rows / masses
        bending = ((v[self._pairs[:, 0]] - v[self._pairs[:, 1]]) ** 2).sum(axis=1)
        right = weighted.reshape(len(rows), -1) @ forces.ravel() + bending
        return forces / masses - np.tensordot(multipliers(rows, weighted, right), weighted, 1)
