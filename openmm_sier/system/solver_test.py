"""Find constraints that OpenMM's solvers cannot satisfy, by a trial on copies of constrained atoms of each kind.

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
from openmm_sier.system.bonded_terms import harmonic_angles
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
    n, constraints = system.getNumParticles(), tables.constraints(system)
    in_triangles = _triangles(n, constraints.pairs)
    if in_triangles.size < len(constraints.pairs):
        return True
    # As OpenMM compares them.
    edges = constraints.lengths[in_triangles].astype(np.float32)
    return not (edges == np.roll(edges, 1, axis=1)).any(axis=1).all()


def _triangles(n: int, pairs: np.ndarray) -> np.ndarray:
    """Return the constraints of each triangle, (t, 3), in the order of their pairs.

    A triangle is three particles of n with all three constraints, and no other ones.

    Args:
        n: number of particles.
        pairs: of all constraints, (c, 2), the smaller particle first.
    """
    component = joined(n, pairs)
    of_pairs = component[pairs[:, 0]]
    is_triangle = (np.bincount(component, minlength=n) == 3) & (np.bincount(of_pairs, minlength=n) == 3)
    order = np.lexsort((pairs[:, 1], pairs[:, 0], of_pairs))
    return order[is_triangle[of_pairs[order]]].reshape(-1, 3)


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
            if _errors(self._pairs, self._lengths, places).max() <= NOT_THERE:
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

    def _tried(self, places: np.ndarray) -> tuple[int, ...]:
        """Return the atoms of a cluster whose displaced positions or random velocities OpenMM cannot constrain."""
        chosen = self._distinct()
        atoms, ends = np.unique(self._pairs[chosen], return_inverse=True)
        pairs, lengths, masses, places = ends.reshape(-1, 2), self._lengths[chosen], self._masses[atoms], places[atoms]
        context = self._context(atoms, pairs, lengths)
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
        first, second = pairs.T
        component = joined(len(places), pairs)
        along = (places[second] - places[first]) * (velocities[second] - velocities[first])
        speeds = np.abs(along.sum(axis=1)) / lengths
        # SETTLE moves the centre of mass of a triangle if the outer masses differ.
        drift = np.zeros_like(places)
        np.add.at(drift, component, masses[:, None] * (x - displaced))
        shifts = np.linalg.norm(drift, axis=1) / np.bincount(component, masses, len(places)).clip(1e-300)
        errors = np.maximum(np.maximum(_errors(pairs, lengths, x), speeds), shifts[component[first]])
        # This comparison is false for NaN.
        wrong = np.flatnonzero(~(errors <= SATISFIED))
        if not wrong.size:
            return ()
        return tuple(atoms[component == component[first[wrong[0]]]].tolist())

    def _distinct(self) -> np.ndarray:
        """Return the constraints that are tried, ascending: of triangles of one kind, such as water, those of one."""
        triangles = _triangles(len(self._masses), self._pairs)
        masses = self._masses[self._pairs[triangles].reshape(-1, 6)]
        _, first = np.unique(np.column_stack([masses, self._lengths[triangles]]), axis=0, return_index=True)
        is_tried = np.ones(len(self._pairs), dtype=bool)
        is_tried[triangles] = False
        is_tried[triangles[first]] = True
        return np.flatnonzero(is_tried)

    def _context(self, atoms: np.ndarray, pairs: np.ndarray, lengths: np.ndarray) -> openmm.Context:
        """Return a Context of some atoms and constraints, with the angles from which OpenMM computes its matrix.

        Args:
            atoms: particles of the System, ascending.
            pairs, lengths: constraints between them, by their places in `atoms`.
        """
        copy = openmm.System()
        for mass in self._masses[atoms].tolist():
            copy.addParticle(mass)
        for (i, j), length in zip(pairs.tolist(), lengths.tolist(), strict=True):
            copy.addConstraint(i, j, length)
        place = np.full(len(self._masses), -1)
        place[atoms] = np.arange(len(atoms))
        for force in self._system.getForces():
            if isinstance(force, openmm.HarmonicAngleForce):
                copy.addForce(_angles_between(force, place))
        return reference_context(copy)


def _errors(pairs: np.ndarray, lengths: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return errors of the distances of places (k, 3), (c,), nm."""
    first, second = pairs.T
    return np.abs(np.linalg.norm(places[second] - places[first], axis=1) - lengths)


def _angles_between(force: openmm.HarmonicAngleForce, place: np.ndarray) -> openmm.HarmonicAngleForce:
    """Return the angles of a Force between particles that have a place, (N,); those without one have -1."""
    particles, angles, strengths = harmonic_angles(force)
    places = place[particles]
    inside = (places >= 0).all(axis=1)
    between = openmm.HarmonicAngleForce()
    for ends, angle, strength in zip(places[inside].tolist(), angles[inside], strengths[inside], strict=True):
        between.addAngle(*ends, angle, strength)
    return between
