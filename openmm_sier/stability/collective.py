"""Measure how fast Forces move their atoms whose energy is no sum of terms of a few atoms, as a CustomCVForce.

The largest second derivative over masses is found by Lanczos' method, J. Res. Natl. Bur. Stand. 45, 255 (1950), on the
Reference platform: each of its vectors costs two evaluations of this Force alone.
"""

from collections.abc import Sequence

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.bodies import BodySet, BodyState
from openmm_sier.dynamics.vectors import body_frame
from openmm_sier.stability.curvature import FAR, Vibration
from openmm_sier.system.forces import kind_of
from openmm_sier.system.second_context import follow_parameters, reference_context

#: Largest displacement of an atom, nm.
DISPLACEMENT = 1e-5

#: Vectors after which the search ends. A function of one variable has one direction that is stiff, and needs two.
VECTORS = 20

#: A direction that is shorter than this share of the first one is rounding.
ROUNDING = 1e-6

#: Atoms that move at least this share of the one that moves most are named, of these the first few.
NAMED, MOST_NAMED = 0.5, 4

_FORCE = unit.kilojoule_per_mole / unit.nanometer

#: Momenta and angular momenta of all bodies, each (3, n).
Direction = tuple[np.ndarray, np.ndarray]


def is_collective(force: openmm.Force) -> bool:
    """Tell whether a Force can be measured here: it acts on few atoms, or is cheap for all of them.

    A CustomCVForce can if all its variables can, or are terms or fields.
    """
    if isinstance(force, openmm.CustomCVForce):
        variables = [force.getCollectiveVariable(i) for i in range(force.getNumCollectiveVariables())]
        return all(
            kind_of(each).terms or kind_of(each).stiffness == "expression" or is_collective(each) for each in variables
        )
    return kind_of(force).stiffness == "collective"


def fastest_motion(force: openmm.Force, context: openmm.Context, bodies: BodySet) -> Vibration | None:
    """Return the fastest motion that a Force causes where the atoms are; None if there is none.

    As with `curvature.fastest_vibration`, what is far from its minimum is no vibration. Motions are those that bodies
    and constraints leave.

    Args:
        force: of the Context's System, for which `is_collective` holds.
        context: with positions, box and parameters.
        bodies: of that System.
    """
    alone = _Alone(force, context, bodies)
    square, direction = alone.stiffest()
    if square <= 0 or alone.slope(direction) ** 2 > 2 * FAR * square:
        return None
    speeds = np.linalg.norm(alone.velocities(direction), axis=1)
    moved = np.flatnonzero(speeds >= NAMED * speeds.max())
    return Vibration(square, tuple(moved[:MOST_NAMED].tolist()))


class _Alone:
    """A Force in a Context of its own, as a function of the motion of bodies.

    Directions are momenta. They are multiplied with inverse masses between them.
    """

    def __init__(self, force: openmm.Force, context: openmm.Context, bodies: BodySet):
        system = openmm.XmlSerializer.clone(context.getSystem())
        while system.getNumForces():
            system.removeForce(0)
        system.addForce(openmm.XmlSerializer.clone(force))
        state = openmm.Context.getState(context, positions=True)
        system.setDefaultPeriodicBoxVectors(*state.getPeriodicBoxVectors())
        self._context = reference_context(system)
        self._bodies = bodies
        follow_parameters(context, self._context)
        self._x = state.getPositions(asNumpy=True).value_in_unit(unit.nanometer)
        self._q, self._A = bodies.fit(self._x)

    def stiffest(self) -> tuple[float, Direction]:
        """Return the largest eigenvalue of the second derivatives over masses, 1/ps^2, and its direction."""
        rng = np.random.default_rng(1)
        shape = self._q.shape
        start = self._curved(self._allowed((rng.normal(size=shape), np.zeros(shape))))
        found: list[Direction] = []
        matrix = np.zeros((VECTORS, VECTORS))
        length = first = self._length(start)
        following = start
        while len(found) < VECTORS and length > ROUNDING * first:
            found.append(_sum([following], [1 / length]))
            following = self._curved(found[-1])
            # Against all earlier ones, twice, since rounding would bring them back.
            for _ in range(2):
                shares = [self._product(each, following) for each in found]
                matrix[: len(found), len(found) - 1] += shares
                following = _sum([following, *found], [1.0, *(-share for share in shares)])
            length = self._length(following)
        if not found:
            return 0.0, start
        squares, modes = np.linalg.eigh(matrix[: len(found), : len(found)], UPLO="U")
        return float(squares[-1]), _sum(found, modes[:, -1])

    def slope(self, direction: Direction) -> float:
        """Return the first derivative of the energy along a direction."""
        return -self._product(self._generalized(self._forces(self._x)), direction)

    def velocities(self, direction: Direction) -> np.ndarray:
        """Return velocities of all atoms, (N, 3)."""
        p, L = direction
        return self._bodies.move(BodyState(self._q, p, self._A, L), np.zeros_like(self._x))

    def _curved(self, direction: Direction) -> Direction:
        """Return second derivatives of the energy times a direction over masses."""
        velocities = self.velocities(direction)
        largest = np.abs(velocities).max(initial=0)
        if largest == 0:
            return direction
        step = DISPLACEMENT / largest
        change = self._forces(self._x - step * velocities) - self._forces(self._x + step * velocities)
        return self._generalized(change / (2 * step))

    def _forces(self, x: np.ndarray) -> np.ndarray:
        self._context.setPositions(x)
        self._context.computeVirtualSites()
        return self._context.getState(forces=True).getForces(asNumpy=True).value_in_unit(_FORCE)

    def _generalized(self, forces: np.ndarray) -> Direction:
        return self._allowed(self._bodies.forces_and_torques(forces, self._A))

    def _allowed(self, direction: Direction) -> Direction:
        """Return the part that constraints between points leave."""
        return self._bodies.constraints.project(self._q, direction[0]), direction[1]

    def _product(self, one: Direction, other: Direction) -> float:
        bodies = self._bodies
        turning = body_frame(self._A, one[1]) * body_frame(self._A, other[1]) * bodies.inverse_moments
        return float((one[0] * other[0] * bodies.inverse_masses).sum() + turning.sum())

    def _length(self, direction: Direction) -> float:
        return float(np.sqrt(self._product(direction, direction)))


def _sum(directions: Sequence[Direction], weights: Sequence[float] | np.ndarray) -> Direction:
    p, L = (np.tensordot(weights, parts, axes=1) for parts in zip(*directions, strict=True))
    return p, L
