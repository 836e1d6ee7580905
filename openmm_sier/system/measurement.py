"""Measure the fastest motion that a Force causes at given positions, whatever its energy is a function of.

The largest second derivatives of the energy over masses are found by Lanczos' method, J. Res. Natl. Bur. Stand. 45, 255
(1950): each of its vectors costs two evaluations of this Force alone, of which there are 5 to 43. They are made in a
second Context, on the Reference platform, in double precision. So the Context of a run, its neighbour lists and its
random numbers stay as they are, also if the measurement is interrupted.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.bodies import BodySet, BodyState
from openmm_sier.dynamics.vectors import body_frame, combine
from openmm_sier.system import tables
from openmm_sier.system.bonded_terms import bonded_terms, do_work
from openmm_sier.system.forces import kind_of
from openmm_sier.system.second_context import cloned, follow_parameters, reference_context

#: Largest displacement of an atom, nm. In double precision it gives second derivatives to 1e-6 of those of a bond.
DISPLACEMENT = 1e-5

#: kJ/mol. A motion that is further from its minimum is no vibration, and its curvature gives no period: the repulsion
#: of two atoms that overlap in a start, or a restraint far from its minimum.
FAR = 25.0

#: Largest number of vectors. Bonds of three masses have a few different frequencies, and need some six vectors.
MOST_VECTORS = 20

#: Relative residual of an accepted direction. At 0.01 the two stretches of water, whose squares differ by 3 %, are not
#: distinguished.
ACCURACY = 0.001

#: Residual over the largest eigenvalue below which it is rounding.
ROUNDING = 1e-6

#: 1/ps^2. Motions with periods above 6 ps limit no step.
LEAST_SQUARE = 1.0

#: Smallest share of the largest velocity, and largest number, of atoms that are named.
NAMED, MOST_NAMED = 0.5, 4

_FORCE = unit.kilojoule_per_mole / unit.nanometer


class Vibration(NamedTuple):
    """The fastest motion that a Force causes.

    Attributes:
        square: of its angular frequency, 1/ps^2.
        atoms: particle indices of the term that changes most; without terms, of the atoms that move most.
    """

    square: float
    atoms: tuple[int, ...]


class HiddenError(Exception):
    """Overlaps of atoms hide the fastest motion that a Force causes."""


def fastest_motion(force: openmm.Force, context: openmm.Context, bodies: BodySet) -> Vibration | None:
    """Return the fastest motion that a Force causes at the positions of a Context; None if there is none.

    Motions are those of bodies under their constraints. Those far from their minimum, by `FAR`, are no vibrations.

    Args:
        force: of the Context's System, or within a Force of it.
        context: with positions, box and parameters.
        bodies: of that System, with the constraints between them.

    Raises:
        HiddenError: there are too many overlaps of atoms.
    """
    forces = _forces_of(force, context)
    x = openmm.Context.getState(context, positions=True).getPositions(asNumpy=True).value_in_unit(unit.nanometer)
    noise = DISPLACEMENT * np.random.default_rng(1).normal(size=x.shape)
    response = forces(x - noise) - forces(x + noise)
    owners = bodies.owners[np.any(response != 0, axis=1)]
    molecules = bodies.molecules[np.unique(owners[owners >= 0])]
    if not len(molecules):
        return None
    motions = _Motions(bodies.restricted(np.flatnonzero(np.isin(bodies.molecules, molecules))), x)

    def curvature(direction: np.ndarray) -> np.ndarray:
        velocities = motions.velocities(direction)
        step = DISPLACEMENT / max(np.abs(velocities).max(), np.finfo(float).tiny)
        return motions.projected(forces(x - step * velocities) - forces(x + step * velocities)) / (2 * step)

    fastest = _largest(curvature, -motions.projected(forces(x)), motions.projected(response))
    if fastest is None:
        return None
    square, direction = fastest
    return Vibration(square, _moved_most(force, bodies.owners, motions.velocities(direction)))


class _Motions:
    """The motions of bodies as directions (6, n): momenta over roots of masses, and likewise about principal axes.

    In these coordinates second derivatives over masses are a symmetric matrix.
    """

    def __init__(self, bodies: BodySet, positions: np.ndarray):
        self._bodies = bodies
        self._shape = positions.shape
        q, A = bodies.fit(positions)
        self._q = q
        self._A = A
        self._roots = np.sqrt(np.concatenate([np.broadcast_to(bodies.masses, (3, bodies.n)), bodies.moments]))
        self._inverse = np.divide(1.0, self._roots, out=np.zeros_like(self._roots), where=self._roots > 0)

    def velocities(self, direction: np.ndarray) -> np.ndarray:
        """Return velocities of all atoms, (N, 3)."""
        momenta = direction * self._roots
        L = combine(momenta[3:], *self._A)
        return self._bodies.move(BodyState(self._q, momenta[:3], self._A, L), np.zeros(self._shape))

    def projected(self, forces: np.ndarray) -> np.ndarray:
        """Return the projection of forces on atoms, (N, 3), onto the motions, as a direction."""
        F, tau = self._bodies.forces_and_torques(forces, self._A)
        return np.concatenate([self._bodies.constraints.project(self._q, F), body_frame(self._A, tau)]) * self._inverse


def _largest(
    curvature: Callable[[np.ndarray], np.ndarray], gradient: np.ndarray, start: np.ndarray
) -> tuple[float, np.ndarray] | None:
    """Return the largest eigenvalue of a matrix, 1/ps^2, and its direction (6, n); None if none is large.

    Directions in which the energy is far from its minimum are left out.

    Args:
        curvature: function that multiplies the matrix with a direction.
        gradient: of the energy.
        start: the first direction.

    Raises:
        HiddenError: there are more such directions than vectors.
    """
    size = np.linalg.norm(start)
    if size == 0:
        return None
    following = start / size
    basis = np.empty((0, *start.shape))
    matrix = np.zeros((MOST_VECTORS, MOST_VECTORS))
    for last in range(MOST_VECTORS):
        basis = np.concatenate([basis, following[None]])
        following = curvature(basis[-1])
        # Orthogonalized twice, since rounding would bring back components along earlier vectors.
        for _ in range(2):
            shares = np.tensordot(basis, following, 2)
            matrix[: last + 1, last] += shares
            following = following - np.tensordot(shares, basis, 1)
        squares, modes = np.linalg.eigh(matrix[: last + 1, : last + 1], UPLO="U")
        residual = np.linalg.norm(following)
        # These directions are an invariant subspace.
        is_complete = residual <= ROUNDING * np.abs(squares).max()
        is_last = is_complete or last + 1 == MOST_VECTORS
        for square, mode in zip(squares[::-1].tolist(), modes.T[::-1], strict=True):
            is_accurate = residual * abs(mode[-1]) <= ACCURACY * max(square, LEAST_SQUARE)
            if is_accurate and square < LEAST_SQUARE:
                return None
            if square < LEAST_SQUARE or not (is_accurate or is_last):
                break
            direction = np.tensordot(mode, basis, 1)
            if np.vdot(gradient, direction) ** 2 <= 2 * FAR * square:
                return square, direction
        if is_complete:
            return None
        following = following / residual
    if squares[-1] < LEAST_SQUARE:
        return None
    raise HiddenError


def _forces_of(force: openmm.Force, context: openmm.Context) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function of positions (N, 3) that returns the forces (N, 3) of one Force."""
    system = _without_forces(context.getSystem())
    system.addForce(openmm.XmlSerializer.clone(force))
    system.setDefaultPeriodicBoxVectors(*openmm.Context.getState(context).getPeriodicBoxVectors())
    second_context = reference_context(system)
    follow_parameters(context, second_context)

    def forces(positions: np.ndarray) -> np.ndarray:
        second_context.setPositions(positions)
        second_context.computeVirtualSites()
        return second_context.getState(forces=True).getForces(asNumpy=True).value_in_unit(_FORCE)

    return forces


def _without_forces(system: openmm.System) -> openmm.System:
    """Return a System of the particles of another, without its Forces."""
    masses = tables.masses(system)
    if any(system.isVirtualSite(i) for i in np.flatnonzero(masses == 0).tolist()):
        # OpenMM copies virtual sites only with their System.
        without_forces = cloned(system)
        while without_forces.getNumForces():
            without_forces.removeForce(0)
        return without_forces
    without_forces = openmm.System()
    for mass in masses.tolist():
        without_forces.addParticle(mass)
    return without_forces


def _moved_most(force: openmm.Force, owners: np.ndarray, velocities: np.ndarray) -> tuple[int, ...]:
    """Return particles of the term of a Force that changes most; without terms, those that move most."""
    kind = kind_of(force)
    if kind.terms is not None:
        terms = bonded_terms(force)
        terms = terms[do_work(terms, owners)]
        relative = velocities[terms] - velocities[terms].mean(axis=1, keepdims=True)
        return tuple(terms[np.argmax((relative**2).sum(axis=(1, 2)))].tolist())
    speeds = np.linalg.norm(velocities, axis=1)
    if kind.acts_on == "particles":
        return (int(speeds.argmax()),)
    movers = np.flatnonzero(speeds >= NAMED * speeds.max())
    return tuple(movers[:MOST_NAMED].tolist())
