"""Compare the work of each Force of a Context with its energy change along short motions of bodies.

Bodies move on straight lines and turn about fixed axes, each in a random direction. If forces are the gradient of an
energy, work and energy loss agree within the rounding of the platform.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.system.forces import kind_of
from openmm_sier.system.second_context import second_context

#: Typical displacement of atoms to either side, nm: large enough for energy differences in single precision, and small
#: enough for Simpson's rule to follow the steepest repulsion to 1e-5.
REACH = 5e-3

#: Number of segments of a motion. Rounding, or a pair that crosses a cut-off, differs between them.
SEGMENTS = 5

#: Number of Forces examined in one Context: OpenMM has 32 force groups, and one is for all other Forces.
BATCH = 31

_FORCE = unit.kilojoule_per_mole / unit.nanometer


class Mismatch(NamedTuple):
    """Work of forces minus loss of energy, per nm of a motion in given directions.

    Attributes:
        mean: mean over the segments of the motion, kJ/mol/nm.
        error: standard error of the mean, from the scatter of the segments.
        force: norm of the forces on the bodies, or torques over radii, kJ/mol/nm.
    """

    mean: float
    error: float
    force: float


class Directions(NamedTuple):
    """Velocities, (n, 3), and angular velocities, (n, 3), of bodies along a motion."""

    velocity: np.ndarray
    spin: np.ndarray


class Motions:
    """Random motions of bodies, with work and energies of Forces along them.

    Attributes:
        forces: indices of the Forces of the System that exert forces.
        radii: radii of gyration of the bodies, not weighted by mass, (n,), nm; 0 for points.
    """

    def __init__(self, context: openmm.Context, bodies: BodySet, seed: int):
        """
        Args:
            context: a Context with positions; it is not changed.
            bodies: its bodies.
            seed: seed of the random directions.
        """
        self._random = np.random.default_rng(seed)
        self._n = bodies.n
        state = context.getState(positions=True)
        self._positions = state.getPositions(asNumpy=True).value_in_unit(unit.nanometer)
        self._moved = np.flatnonzero(bodies.owners >= 0)
        self._owners = bodies.owners[self._moved]
        count = np.bincount(self._owners, minlength=bodies.n)
        self._centres = self._sums(self._positions[self._moved]) / count[:, None]
        self._arms = self._positions[self._moved] - self._centres[self._owners]
        self.radii = np.sqrt(self._sums(self._arms**2).sum(axis=1) / count)
        system = context.getSystem()
        kinds = enumerate(system.getForces())
        self.forces = [number for number, force in kinds if kind_of(force).exerts_forces]
        batches = [self.forces[i : i + BATCH] for i in range(0, len(self.forces), BATCH)]
        self._contexts = [(batch, _by_groups(context, batch)) for batch in batches]

    def along(self, members: np.ndarray, numbers: Sequence[int], turns: bool) -> dict[int, Mismatch]:
        """Move bodies in random directions, and return the mismatch of each Force.

        Args:
            members: indices of the moving bodies, (m,).
            numbers: indices of the Forces.
            turns: whether the bodies turn about their centres or are shifted.

        Raises:
            openmm.OpenMMException: an energy or a force is not finite.
        """
        directions = self._directions(members, turns)
        times = REACH * np.linspace(-1, 1, 2 * SEGMENTS + 1)
        mismatches = {}
        for batch, context in self._contexts:
            groups = {number: 1 << group for group, number in enumerate(batch) if number in numbers}
            points = [self._evaluate(context, groups, directions, time) for time in times] if groups else []
            for number in groups:
                energies, powers, forces = np.array([point[number] for point in points]).T
                mismatches[number] = _mismatch(energies, powers, forces[SEGMENTS], times[1] - times[0])
        return mismatches

    def _directions(self, members: np.ndarray, turns: bool) -> Directions:
        moves = Directions(*np.zeros((2, self._n, 3)))
        random = self._random.standard_normal((len(members), 3))
        if turns:
            # Atoms move as far as by shifts.
            radii = self.radii[members, None]
            moves.spin[members] = np.divide(random, radii, out=np.zeros_like(random), where=radii > 0)
        else:
            moves.velocity[members] = random
        return moves

    def _evaluate(
        self, context: openmm.Context, groups: dict[int, int], moves: Directions, time: float
    ) -> dict[int, tuple[float, float, float]]:
        """Return energy, power along the motion, and norm of forces or torques over radii, for each Force."""
        velocity, spin = moves.velocity[self._owners], moves.spin[self._owners]
        arms = _turned(self._arms, spin * time)
        positions = self._positions.copy()
        positions[self._moved] = self._centres[self._owners] + velocity * time + arms
        context.setPositions(positions)
        context.computeVirtualSites()
        speeds = velocity + np.cross(spin, arms)
        results = {}
        for number, group in groups.items():
            state = context.getState(energy=True, forces=True, groups=group)
            energy = state.getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole)
            forces = state.getForces(asNumpy=True).value_in_unit(_FORCE)[self._moved]
            if not (math.isfinite(energy) and np.isfinite(forces).all()):
                name = context.getSystem().getForce(number).getName()
                raise openmm.OpenMMException(
                    f"The energy of {name} is {energy}, or its forces are not finite, at the positions of the atoms or "
                    "close to them. Set positions first; if atoms overlap, minimize the energy"
                )
            acting = self._acting(forces, arms, moves)
            results[number] = energy, float((forces * speeds).sum()), float(np.linalg.norm(acting))
        return results

    def _acting(self, forces: np.ndarray, arms: np.ndarray, moves: Directions) -> np.ndarray:
        """Return forces on shifted bodies, and torques over radii on turning bodies."""
        shifted, rotated = (moves.velocity != 0).any(axis=1), (moves.spin != 0).any(axis=1)
        torques = self._sums(np.cross(arms, forces))[rotated] / self.radii[rotated, None]
        return np.concatenate([self._sums(forces)[shifted], torques])

    def _sums(self, values: np.ndarray) -> np.ndarray:
        """Return sums (n, 3) of values (m, 3) over the atoms of each body."""
        return np.stack([np.bincount(self._owners, column, self._n) for column in values.T], axis=1)


def _mismatch(energies: np.ndarray, powers: np.ndarray, force: float, interval: float) -> Mismatch:
    """Return the mismatch from energies and powers at equally spaced points, two per segment and one more."""
    work = interval / 3 * (powers[:-2:2] + 4 * powers[1:-1:2] + powers[2::2])
    errors = (work + np.diff(energies[::2])) / (2 * interval)
    return Mismatch(float(errors.mean()), float(errors.std(ddof=1) / np.sqrt(len(errors))), float(force))


def _by_groups(context: openmm.Context, batch: Sequence[int]) -> openmm.Context:
    """Return a Context of the same System in which each Force of a batch has a separate group, in order."""
    system = openmm.XmlSerializer.clone(context.getSystem())
    for number, force in enumerate(system.getForces()):
        force.setForceGroup(batch.index(number) if number in batch else BATCH)
        if isinstance(force, openmm.NonbondedForce):
            force.setReciprocalSpaceForceGroup(-1)
    return second_context(context, system)


def _turned(arms: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Turn vectors (m, 3) by rotation vectors (m, 3), by Rodrigues' formula."""
    angle = np.linalg.norm(angles, axis=1, keepdims=True)
    axis = np.divide(angles, angle, out=np.zeros_like(angles), where=angle > 0)
    along = (axis * arms).sum(axis=1, keepdims=True) * axis
    return along + np.cos(angle) * (arms - along) + np.sin(angle) * np.cross(axis, arms)
