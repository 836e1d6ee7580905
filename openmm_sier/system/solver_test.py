"""Find constraints that OpenMM's solvers cannot satisfy, by a trial on copies of the constrained atoms.

OpenMM has two solvers. SETTLE handles isolated triangles of constraints with two equal lengths, and assumes equal
masses of the two outer atoms. CCMA (Eastman and Pande, J. Chem. Theory Comput. 6, 434 (2010)) solves all other
constraints by iterations with one matrix, which is computed and inverted once. The matrix is singular if constraints
are redundant. It is inaccurate, and iterations diverge, if it lacks angles: an angle between two constraints is known
only if a third constraint or a HarmonicAngleForce joins their outer atoms.
"""

from collections.abc import Callable

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.constraints.graph import joined
from openmm_sier.system import tables
from openmm_sier.system.second_context import reference_context

#: Standard deviation in nm of random displacements that solvers have to undo; a step of some fs moves hydrogens this
#: far off their constraints.
DISPLACEMENT = 1e-3

#: Relative tolerance requested from solvers, and largest error of satisfied constraints, in nm, or in nm/ps for
#: velocities of 1 nm/ps. Converging iterations reduce the displacement a thousandfold.
TOLERANCE, SATISFIED = 1e-7, 1e-6

#: Error of distances in nm above which positions do not belong to the constraints.
NOT_THERE = 0.01

#: Maximum number of atoms named in a message.
NAMED = 8


def may_not_converge(system: openmm.System) -> bool:
    """Return whether OpenMM solves some constraints by iterations, which may end anywhere. SETTLE leaves NaN there.

    Args:
        system: openmm.System.
    """
    n, (pairs, lengths) = system.getNumParticles(), tables.constraints(system)
    component = joined(n, pairs)
    sizes, of_pairs = np.bincount(component, minlength=n), component[pairs[:, 0]]
    is_triangle = (sizes == 3) & (np.bincount(of_pairs, minlength=n) == 3)
    if not is_triangle[of_pairs].all():
        return True
    # As OpenMM compares them.
    edges = lengths[np.argsort(of_pairs, kind="stable")].astype(np.float32).reshape(-1, 3)
    return not (edges == np.roll(edges, 1, axis=1)).any(axis=1).all()


class SolverTest:
    """Trial of the constraints of a System."""

    def __init__(self, system: openmm.System):
        """
        Args:
            system: openmm.System. Later changes are ignored.
        """
        self._system = system
        self._masses = tables.masses(system)
        constraints = tables.constraints(system)
        self._pairs = constraints.pairs
        self._lengths = constraints.lengths
        self._is_tried = not len(self._pairs)
        self._unsolved: tuple[int, ...] = ()

    def unsolved(self, positions: Callable[[], np.ndarray]) -> tuple[int, ...]:
        """Return the atoms of a cluster of constraints that OpenMM cannot satisfy; empty if there is none.

        Args:
            positions: returns positions, (N, 3), nm. If these are not set yet, or far from satisfying the constraints,
                the trial is postponed to the next call.
        """
        if not self._is_tried:
            places = positions()
            if self._errors(places).max() <= NOT_THERE:
                self._unsolved = self._tried(places)
                self._is_tried = True
        return self._unsolved

    def refuse(self, positions: Callable[[], np.ndarray]) -> None:
        """Refuse constraints that OpenMM cannot satisfy.

        Raises:
            openmm.OpenMMException: such constraints exist at these positions, see `unsolved`.
        """
        if atoms := self.unsolved(positions):
            names = ", ".join(map(str, atoms[:NAMED])) + (", …" if len(atoms) > NAMED else "")
            raise openmm.OpenMMException(
                f"OpenMM cannot satisfy the constraints of atoms {names}. Take a SIER integrator with engine='exact', "
                "which any platform runs"
            )

    def _errors(self, places: np.ndarray) -> np.ndarray:
        """Return errors of the distances of places (k, 3), (c,), nm."""
        first, second = self._pairs.T
        return np.abs(np.linalg.norm(places[second] - places[first], axis=1) - self._lengths)

    def _tried(self, places: np.ndarray) -> tuple[int, ...]:
        """Return the atoms of a cluster whose displaced positions or random velocities OpenMM cannot constrain."""
        context = self._context()
        random = np.random.default_rng(0)
        displaced = places + DISPLACEMENT * random.standard_normal(places.shape)
        context.setPositions(displaced)
        context.applyConstraints(TOLERANCE)
        x = context.getState(positions=True).getPositions(asNumpy=True).value_in_unit(unit.nanometer)
        context.setPositions(places)
        context.setVelocities(random.standard_normal(places.shape))
        context.applyVelocityConstraints(TOLERANCE)
        state = context.getState(velocities=True)
        velocities = state.getVelocities(asNumpy=True).value_in_unit(unit.nanometer / unit.picosecond)
        first, second = self._pairs.T
        component = joined(len(places), self._pairs)
        along = (places[second] - places[first]) * (velocities[second] - velocities[first])
        speeds = np.abs(along.sum(axis=1)) / self._lengths
        # SETTLE moves the centre of mass of a triangle if the outer masses differ.
        drift = np.zeros_like(places)
        np.add.at(drift, component, self._masses[:, None] * (x - displaced))
        shifts = np.linalg.norm(drift, axis=1) / np.bincount(component, self._masses, len(places)).clip(1e-300)
        errors = np.maximum(np.maximum(self._errors(x), speeds), shifts[component[first]])
        # This comparison is false for NaN.
        wrong = np.flatnonzero(~(errors <= SATISFIED))
        if not wrong.size:
            return ()
        return tuple(np.flatnonzero(component == component[first[wrong[0]]]).tolist())

    def _context(self) -> openmm.Context:
        """Return a Context of the constraints, with the angles from which OpenMM computes its matrix."""
        copy = openmm.System()
        for mass in self._masses.tolist():
            copy.addParticle(mass)
        for (i, j), length in zip(self._pairs.tolist(), self._lengths.tolist(), strict=True):
            copy.addConstraint(i, j, length)
        for force in self._system.getForces():
            if isinstance(force, openmm.HarmonicAngleForce):
                copy.addForce(openmm.XmlSerializer.clone(force))
        return reference_context(copy)
