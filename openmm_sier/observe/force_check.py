"""Find Forces that are not the gradient of their energy, with which no step conserves it."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import openmm
from openmm import unit

from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.system import tables
from openmm_sier.system.forces import kind_of
from openmm_sier.system.second_context import cloned, second_context

#: Typical displacement of atoms to either side, nm: large enough for energy differences in single precision, and small
#: enough for Simpson's rule to follow the steepest repulsion to 1e-5.
REACH = 5e-3

#: Number of segments of a motion, an even number.
SEGMENTS = 6

#: Degree of the polynomial by which a faulty force may vary along a motion. Other variation between segments is noise:
#: rounding, or a pair that crosses a cut-off.
DEGREE = 3

#: Number of random motions.
MOTIONS = 16

#: Smallest likely ratio of the mismatch of `MOTIONS` random motions to the error of forces, of which it is an estimate:
#: the root of chi-squared over the number of motions is above this with a probability of 99 %.
SMALLEST_RATIO = 0.60

#: Number of Forces examined in one Context: OpenMM has 32 force groups, and one is for all other Forces.
BATCH = 31

#: Ratio of a mismatch to its standard error above which it is significant. Both are from all motions, so that noise
#: alone reaches this ratio once in 10^9 checks.
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


class ForceDoubt(NamedTuple):
    """Force whose energy is too noisy to judge it within the tolerance.

    Attributes:
        force: name and class of the Force.
        number: index of the Force in the System.
        hidden: largest likely error of its forces on all atoms, as a norm, kJ/mol/nm.
        of: norm of its forces on all atoms, kJ/mol/nm.
    """

    force: str
    number: int
    hidden: float
    of: float

    def __str__(self) -> str:
        return (
            f"{self.force}, Force {self.number} of the System, cannot be judged: its forces on all atoms have a norm "
            f"of {self.of:.2g} kJ/mol/nm, and rounding of its energy, or jumps, hide errors up to {self.hidden:.2g}. "
            "Check it in double precision, or with a larger tolerance"
        )


class ForceCheck(NamedTuple):
    """Result of `check_forces`. Print it for a summary.

    Attributes:
        faults: Forces that are not the gradient of their energy.
        doubts: Forces that cannot be judged within the tolerance.
        checked: names of all Forces examined.
        tolerance: tolerated relative error of the forces on all atoms.
    """

    faults: tuple[ForceFault, ...]
    doubts: tuple[ForceDoubt, ...]
    checked: tuple[str, ...]
    tolerance: float

    def __str__(self) -> str:
        if self.faults or self.doubts:
            return "\n".join(f"{line}." for line in (*self.faults, *self.doubts))
        names = ", ".join(self.checked) or "none"
        return f"All Forces are the gradients of their energies within {100 * self.tolerance:g} %: {names}."


def check_forces(context: openmm.Context, tolerance: float = 0.01, seed: int = 1) -> ForceCheck:
    """Find Forces that are not the gradient of their energy. Use it if the energy drifts for no known reason.

    >>> print(check_forces(simulation.context))
    All Forces are the gradients of their energies within 1 %: HarmonicBondForce, NonbondedForce...

    Atoms are moved by some hundredths of an Angstrom in random directions, and the work of each Force is compared with
    the change of its energy, on the Context's platform and in its precision. This takes some 200 evaluations of
    all forces. The Context is not changed.

    The variation of the energy along each motion gives its noise, such as rounding in single precision, or jumps at a
    cut-off. A Force whose mismatch may be noise, but also an error above the tolerance, is a doubt. `prepare_system`
    names NonbondedForces with such a jump.

    Args:
        context: a Context with positions and any integrator.
        tolerance: tolerated relative error of the forces on all atoms, between 0 and 1.
        seed: seed of the random directions.

    Returns:
        Faults and doubts; print it.

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
    if isinstance(integrator := context.getIntegrator(), SIERIntegrator):
        # Bodies move massless atoms too.
        is_mobile |= integrator.bodies.owners >= 0
    directions = np.random.default_rng(seed).standard_normal((MOTIONS, *positions.shape)) * is_mobile[:, None]
    faults, doubts = [], []
    numbers = list(forces)
    for batch in (numbers[i : i + BATCH] for i in range(0, len(numbers), BATCH)):
        separated = _by_groups(context, batch)
        motions = np.array([_mismatches(separated, batch, positions, direction) for direction in directions])
        for number, each in zip(batch, np.sqrt((motions**2).mean(axis=0)).tolist(), strict=True):
            mismatch, noise, of = each
            tolerated = max(tolerance * of, LEAST)
            if mismatch > SIGNIFICANT * noise:
                if (size := math.sqrt(mismatch**2 - noise**2)) > tolerated:
                    faults.append(ForceFault(forces[number], number, size, of))
            elif (hidden := mismatch / SMALLEST_RATIO) > tolerated:
                doubts.append(ForceDoubt(forces[number], number, hidden, of))
    return ForceCheck(tuple(faults), tuple(doubts), tuple(forces.values()), tolerance)


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
        (Forces, 3): the mismatch at the positions and its standard error, for a displacement of 1 nm, and the norm of
        the forces; kJ/mol/nm.
    """
    times, interval = np.linspace(-REACH, REACH, 2 * SEGMENTS + 1, retstep=True)
    points = []
    for time in times:
        context.setPositions(positions + time * direction)
        context.computeVirtualSites()
        points.append([_evaluate(context, group, number, direction) for group, number in enumerate(batch)])
    energies, powers, norms = np.array(points).transpose(2, 1, 0)
    work = _by_simpson(powers, interval)
    mismatches, errors = _in_the_middle((work + np.diff(energies[:, ::2])) / (2 * interval))
    # Where the rule with half as many points differs, neither is exact.
    inexact = work.reshape(len(work), -1, 2).sum(axis=2) - _by_simpson(powers[:, ::2], 2 * interval)
    errors = np.hypot(errors, _rms(inexact) / (4 * interval))
    return np.stack([mismatches, errors, _rms(norms)], axis=1)


def _by_simpson(values: np.ndarray, interval: float) -> np.ndarray:
    """Return integrals (m, n) over the segments of functions that are given at 2 n + 1 points, (m, 2 n + 1)."""
    return interval / 3 * (values[:, :-2:2] + 4 * values[:, 1:-1:2] + values[:, 2::2])


def _in_the_middle(series: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the values (m,) in the middle of series (m, n), with standard errors (m,), by polynomials that fit them.

    The middle are the positions themselves: forces may be right there and wrong beside them, as those on particles that
    are the axes of an ellipsoid, which are only right at right angles.
    """
    n = series.shape[1]
    design = np.vander(np.linspace(-1, 1, n), DEGREE + 1, increasing=True)
    weights = np.linalg.pinv(design)
    residuals = series - series @ weights.T @ design.T
    scatter = np.sqrt((residuals**2).sum(axis=1) / (n - DEGREE - 1))
    return series @ weights[0], scatter * np.linalg.norm(weights[0])


def _rms(values: np.ndarray) -> np.ndarray:
    return np.sqrt((values**2).mean(axis=1))


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
