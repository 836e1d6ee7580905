"""Find Forces that are not the gradient of their energy, with which no step conserves it."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.observe.work import Mismatch, Motions
from openmm_sier.system.find_bodies import RigidBodies

#: Number of groups of bodies that are examined one by one, so that a fault in few of many bodies shows too.
PARTS = 8

#: Number of directions in which a group moves at first, and after a suspicious mismatch.
FIRST, MORE = 2, 6

#: Ratio of a mismatch to its standard error above which it is significant.
SIGNIFICANT = 5.0

#: Mismatch in kJ/mol/nm below which it does not count, such as rounding of terms at their minimum.
LEAST = 1e-6

#: Maximum number of atoms named in a message.
NAMED = 12


@dataclass(frozen=True)
class ForceFault:
    """Force that is not the gradient of its energy.

    Attributes:
        force: name and class of the Force.
        number: index of the Force in the System.
        atoms: particle indices of the body with the largest error.
        body: name of the body.
        turns: True if the torque on the body is wrong, False if the force is.
        size: error of the force, kJ/mol/nm, or torque, kJ/mol.
        of: magnitude of the force or torque, in the same unit.
    """

    force: str
    number: int
    atoms: tuple[int, ...]
    body: str
    turns: bool
    size: float
    of: float

    def __str__(self) -> str:
        quantity, of_unit = ("torque", "kJ/mol") if self.turns else ("force", "kJ/mol/nm")
        return (
            f"{self.force}, Force {self.number} of the System, is not the gradient of its energy: the {quantity} on "
            f"{self.body} is {self.of:.2g} {of_unit}, and wrong by about {self.size:.2g}. With such a Force no step "
            "conserves the energy. Try another platform or precision, or other parameters of this Force"
        )


@dataclass(frozen=True)
class ForceCheck:
    """Result of `check_forces`. Print it for a summary.

    Attributes:
        faults: Forces that are not the gradient of their energy.
        checked: names of all Forces examined.
        tolerance: tolerated relative error of the forces on a group of bodies.
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

    Bodies are moved by some hundredths of an Angstrom in random directions, and the work of each Force is compared with
    the change of its energy, on the Context's platform and in its precision. This takes some 350 evaluations of all
    forces. The Context is not changed.

    Faults smaller than the rounding of energies in single precision cannot be detected, nor can jumps of the energy at
    a cut-off. `prepare_system` names NonbondedForces with such a jump.

    Args:
        context: a Context with positions and any integrator. Without a SIER integrator, bodies are defined by the
            System's constraints.
        tolerance: tolerated relative error of the forces on an eighth of all bodies, between 0 and 1.
        seed: seed of the random directions.

    Returns:
        The faults, with names, atoms and sizes; print it.

    Raises:
        TypeError: `context` is not a Context.
        ValueError: the tolerance is not between 0 and 1.
        openmm.OpenMMException: an energy or force is not finite: positions are not set, or atoms overlap.
    """
    if not isinstance(context, openmm.Context):
        remedy = ": give simulation.context" if hasattr(context, "context") else ""
        raise TypeError(f"context must be an openmm.Context, got a {type(context).__name__}{remedy}")
    if not 0 < tolerance < 1:
        raise ValueError(f"tolerance must be between 0 and 1, got {tolerance!r}")
    system, bodies = context.getSystem(), _bodies(context)
    motions = Motions(context, bodies, seed)
    names = {number: _name(system.getForce(number)) for number in motions.forces}
    worst: dict[int, _Place] = {}
    for place in _places(motions, bodies):
        errors = _errors(motions, place, motions.forces, FIRST)
        doubtful = [number for number, (error, force) in errors.items() if error > tolerance * force]
        for number, (error, force) in _errors(motions, place, doubtful, MORE).items():
            if error > tolerance * force and (number not in worst or error > worst[number].error):
                worst[number] = place._replace(error=error, force=force)
    faults = [
        _fault(bodies, number, names[number], _located(motions, number, place)) for number, place in worst.items()
    ]
    return ForceCheck(tuple(faults), tuple(names.values()), tolerance)


class _Place(NamedTuple):
    """Indices of bodies, whether they turn, and the error and size of a Force on them; see `_errors`."""

    bodies: np.ndarray
    turns: bool
    error: float = 0.0
    force: float = 0.0


def _places(motions: Motions, bodies: BodySet) -> Iterator[_Place]:
    """Yield groups of bodies to be shifted, and groups of bodies to be turned."""
    for turns in (False, True):
        able = np.flatnonzero(motions.radii > 0) if turns else np.arange(bodies.n)
        for chosen in np.array_split(able, min(PARTS, max(1, len(able)))):
            if len(chosen):
                yield _Place(chosen, turns)


def _errors(motions: Motions, place: _Place, numbers: list[int], times: int) -> dict[int, tuple[float, float]]:
    """Return the error and the size of each Force on the bodies of a place, as norms, kJ/mol/nm.

    Insignificant errors are zero.
    """
    if not numbers:
        return {}
    along = [motions.along(place.bodies, numbers, place.turns) for _ in range(times)]
    return {number: _error([mismatches[number] for mismatches in along]) for number in numbers}


def _error(mismatches: list[Mismatch]) -> tuple[float, float]:
    means, errors, forces = np.array(mismatches).T
    square, noise = (means**2).mean(), (errors**2).mean()
    is_significant = np.isfinite(square) and square > SIGNIFICANT**2 * noise + LEAST**2
    return (float(np.sqrt(square - noise)) if is_significant else 0.0), float(np.sqrt((forces**2).mean()))


def _located(motions: Motions, number: int, place: _Place) -> _Place:
    """Find the body of a place with the largest error of a Force, by bisection."""
    while len(place.bodies) > 1:
        halves = [place._replace(bodies=half) for half in np.array_split(place.bodies, 2)]
        errors = [_errors(motions, half, [number], MORE)[number] for half in halves]
        place = max(
            (half._replace(error=error, force=force) for half, (error, force) in zip(halves, errors, strict=True)),
            key=lambda half: half.error,
        )
    radius = motions.radii[place.bodies[0]] if place.turns else 1.0
    # A norm has three directions.
    unit_of_one = radius / np.sqrt(3)
    return place._replace(error=place.error * unit_of_one, force=place.force * unit_of_one)


def _fault(bodies: BodySet, number: int, name: str, place: _Place) -> ForceFault:
    atoms = bodies.atoms_of(int(place.bodies[0]))
    body = bodies.describe_atoms(atoms[:NAMED]) + (" and others of its body" if len(atoms) > NAMED else "")
    return ForceFault(name, number, tuple(map(int, atoms)), body, place.turns, place.error, place.force)


def _name(force: openmm.Force) -> str:
    kind = type(force).__name__
    return kind if force.getName() == kind else f"{force.getName()} ({kind})"


def _bodies(context: openmm.Context) -> BodySet:
    bodies = getattr(context.getIntegrator(), "bodies", None)
    return bodies if isinstance(bodies, BodySet) else RigidBodies.from_system(context.getSystem())
