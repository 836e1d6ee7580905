"""Find Forces that are not the gradient of their energy, with which no step conserves it."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import openmm
from openmm import unit

from openmm_sier.system import tables
from openmm_sier.system.forces import kind_of
from openmm_sier.system.second_context import cloned, second_context

#: Typical displacement of atoms to either side, nm: large enough for energy differences in single precision, and small
#: enough for Simpson's rule to follow the steepest repulsion to 1e-5.
REACH = 5e-3

#: Number of segments of a motion. Rounding, or a pair that crosses a cut-off, differs between them.
SEGMENTS = 5

#: Number of random motions.
MOTIONS = 8

#: Number of Forces examined in one Context: OpenMM has 32 force groups, and one is for all other Forces.
BATCH = 31

#: Ratio of a mismatch to its standard error above which it is significant.
SIGNIFICANT = 5.0

#: Mismatch in kJ/mol/nm below which it does not count, such as rounding of terms at their minimum.
LEAST = 1e-6

_FORCE = unit.kilojoule_per_mole / unit.nanometer


class ForceFault(NamedTuple):
    """Force that is not the gradient of its energy.

    Attributes:
        force: name and class of the Force.
        number: index of the Force in the System.
        size: error of its forces on all atoms, as a norm, kJ/mol/nm.
        of: norm of its forces on all atoms, kJ/mol/nm.
    """

    force: str
    number: int
    size: float
    of: float

    def __str__(self) -> str:
        return (
            f"{self.force}, Force {self.number} of the System, is not the gradient of its energy: its forces on all "
            f"atoms have a norm of {self.of:.2g} kJ/mol/nm, and are wrong by about {self.size:.2g}. With such a Force "
            "no step conserves the energy. Try another platform or precision, or other parameters of this Force"
        )


class ForceCheck(NamedTuple):
    """Result of `check_forces`. Print it for a summary.

    Attributes:
        faults: Forces that are not the gradient of their energy.
        checked: names of all Forces examined.
        tolerance: tolerated relative error of the forces on all atoms.
    """

    faults: tuple[ForceFault, ...]
    checked: tuple[str, ...]
    tolerance: float

    def __str__(self) -> str:
        if self.faults:
            return "\n".join(f"{fault}." for fault in self.faults)
        names = ", ".join(self.checked) or "none"
        return f"All Forces are the gradients of their energies within {100 * self.tolerance:g} %: {names}."


def check_forces(context: openmm.Context, tolerance: float = 0.01, seed: int = 1) -> ForceCheck:
    """Find Forces that are not the gradient of their energy. Use it if the energy drifts for no known reason.

    >>> print(check_forces(simulation.context))
    All Forces are the gradients of their energies within 1 %: HarmonicBondForce, NonbondedForce...

    Atoms are moved by some hundredths of an Angstrom in random directions, and the work of each Force is compared with
    the change of its energy, on the Context's platform and in its precision. This takes some 90 evaluations of all
    forces. The Context is not changed.

    Faults smaller than the rounding of energies in single precision cannot be detected, nor can jumps of the energy at
    a cut-off. `prepare_system` names NonbondedForces with such a jump.

    Args:
        context: a Context with positions and any integrator.
        tolerance: tolerated relative error of the forces on all atoms, between 0 and 1.
        seed: seed of the random directions.

    Returns:
        The faults; print it.

    Raises:
        ValueError: the tolerance is not between 0 and 1.
        openmm.OpenMMException: an energy or force is not finite: positions are not set, or atoms overlap.
    """
    if not 0 < tolerance < 1:
        raise ValueError(f"tolerance must be between 0 and 1, got {tolerance!r}")
    system = context.getSystem()
    forces = {number: _name(force) for number, force in enumerate(system.getForces()) if kind_of(force).exerts_forces}
    positions = context.getState(positions=True).getPositions(asNumpy=True).value_in_unit(unit.nanometer)
    is_mobile = tables.masses(system) > 0
    directions = np.random.default_rng(seed).standard_normal((MOTIONS, *positions.shape)) * is_mobile[:, None]
    faults = []
    numbers = list(forces)
    for batch in (numbers[i : i + BATCH] for i in range(0, len(numbers), BATCH)):
        separated = _by_groups(context, batch)
        mismatches = np.array([_mismatches(separated, batch, positions, direction) for direction in directions])
        for number, (means, errors, norms) in zip(batch, mismatches.transpose(1, 2, 0), strict=True):
            size, of = _significant(means, errors), math.sqrt((norms**2).mean())
            if size > tolerance * of:
                faults.append(ForceFault(forces[number], number, size, of))
    return ForceCheck(tuple(faults), tuple(forces.values()), tolerance)


def _name(force: openmm.Force) -> str:
    kind = type(force).__name__
    return kind if force.getName() == kind else f"{force.getName()} ({kind})"


def _by_groups(context: openmm.Context, batch: Sequence[int]) -> openmm.Context:
    """Return a Context of the same System in which each Force of a batch has a separate group, in order."""
    system = cloned(context.getSystem())
    for number, force in enumerate(system.getForces()):
        force.setForceGroup(batch.index(number) if number in batch else BATCH)
        if isinstance(force, openmm.NonbondedForce):
            force.setReciprocalSpaceForceGroup(-1)
    return second_context(context, system)


def _mismatches(
    context: openmm.Context, batch: Sequence[int], positions: np.ndarray, direction: np.ndarray
) -> np.ndarray:
    """Move atoms on straight lines, and compare the work of each Force with the loss of its energy.

    Returns:
        (Forces, 3): the mean mismatch over the segments of the motion and its standard error, for a displacement of
        1 nm, and the norm of the forces in the middle; kJ/mol/nm.
    """
    times, interval = np.linspace(-REACH, REACH, 2 * SEGMENTS + 1, retstep=True)
    points = []
    for time in times:
        context.setPositions(positions + time * direction)
        context.computeVirtualSites()
        points.append([_evaluate(context, group, number, direction) for group, number in enumerate(batch)])
    energies, powers, norms = np.array(points).transpose(2, 1, 0)
    work = interval / 3 * (powers[:, :-2:2] + 4 * powers[:, 1:-1:2] + powers[:, 2::2])
    mismatches = (work + np.diff(energies[:, ::2])) / (2 * interval)
    errors = mismatches.std(axis=1, ddof=1) / math.sqrt(SEGMENTS)
    return np.stack([mismatches.mean(axis=1), errors, norms[:, SEGMENTS]], axis=1)


def _evaluate(context: openmm.Context, group: int, number: int, direction: np.ndarray) -> tuple[float, float, float]:
    """Return the energy of a group, its power along a direction, and the norm of its forces on atoms that move."""
    state = context.getState(energy=True, forces=True, groups=1 << group)
    energy = state.getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole)
    forces = state.getForces(asNumpy=True).value_in_unit(_FORCE)
    if not (math.isfinite(energy) and np.isfinite(forces).all()):
        name = context.getSystem().getForce(number).getName()
        raise openmm.OpenMMException(
            f"The energy of {name} is {energy}, or its forces are not finite, at the positions of the atoms or close "
            "to them. Set positions first; if atoms overlap, minimize the energy"
        )
    return energy, float((forces * direction).sum()), float(np.linalg.norm(forces[direction.any(axis=1)]))


def _significant(means: np.ndarray, errors: np.ndarray) -> float:
    """Return the error of forces as a norm, from mismatches along several directions; zero if it is insignificant."""
    square, noise = (means**2).mean(), (errors**2).mean()
    is_significant = square > SIGNIFICANT**2 * noise + LEAST**2
    return math.sqrt(square - noise) if is_significant else 0.0
