"""Find Forces that are not the gradient of their energy, which no step makes conserve it."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.observe.work import Mismatch, Motions
from openmm_sier.system.find_bodies import RigidBodies

#: Bodies are looked at in so many parts, so that what is wrong in few of many shows too.
PARTS = 8

#: Directions in which a part moves at first, and where something seems to be wrong.
FIRST, MORE = 2, 6

#: A mismatch counts where it is so many times its standard error.
SIGNIFICANT = 5.0

#: kJ/mol/nm. What is wrong by less, as the rounding of terms that are at their minimum, does not count.
LEAST = 1e-6

#: At most so many atoms are named.
NAMED = 12


@dataclass(frozen=True)
class ForceFault:
    """Describe a Force whose forces are not the gradient of its energy.

    Attributes:
        force: its name and class.
        number: of the Force in the System.
        atoms: particle indices of the body on which it is most wrong.
        body: the name of that body.
        turns: True if the torque on the body is wrong, False if the force is.
        size: the error, kJ/mol/nm; of a torque, kJ/mol.
        of: the size of the force or torque itself, in the same unit.
    """

    force: str
    number: int
    atoms: tuple[int, ...]
    body: str
    turns: bool
    size: float
    of: float

    def __str__(self) -> str:
        what, of_unit = ("torque", "kJ/mol") if self.turns else ("force", "kJ/mol/nm")
        return (
            f"{self.force}, Force {self.number} of the System, is not the gradient of its energy: the {what} on "
            f"{self.body} is {self.of:.2g} {of_unit}, and wrong by about {self.size:.2g}. With such a Force no step "
            "conserves the energy. Try another platform or precision, or other parameters of this Force"
        )


@dataclass(frozen=True)
class ForceCheck:
    """Hold what `check_forces` found; print it.

    Attributes:
        faults: one for each Force that is not the gradient of its energy; empty if all are.
        checked: names of all Forces that were looked at.
        tolerance: fraction of the forces on some bodies that may be wrong.
    """

    faults: tuple[ForceFault, ...]
    checked: tuple[str, ...]
    tolerance: float

    def __str__(self) -> str:
        if self.faults:
            return "\n".join(f"{fault}." for fault in self.faults)
        what = ", ".join(self.checked) or "none"
        return f"All Forces are the gradients of their energies within {100 * self.tolerance:g} %: {what}."


def check_forces(context: openmm.Context, tolerance: float = 0.01, seed: int = 1) -> ForceCheck:
    """Find Forces that are not the gradient of their energy. Use it when the energy drifts and you do not know why.

    >>> print(check_forces(simulation.context))
    All Forces are the gradients of their energies within 1 %: HarmonicBondForce, NonbondedForce...

    It moves bodies by some hundredths of an Angstrom in random directions, and compares the work of each Force with the
    change of its energy, on the Context's platform and in its precision. This takes some 350 evaluations of all forces.
    The Context stays as it is.

    It cannot see faults that are smaller than the rounding of energies in single precision, nor a jump of the energy at
    a cut-off. `prepare_system` names NonbondedForces that have one.

    Args:
        context: a Context with positions and any integrator. Without a SIER integrator, bodies are those of the
            System's constraints.
        tolerance: fraction of the forces on an eighth of all bodies that may be wrong, between 0 and 1.
        seed: seed of the random directions.

    Returns:
        The faults, with names, atoms and sizes; print it.

    Raises:
        TypeError: `context` is no Context, such as a Simulation.
        ValueError: the tolerance is not between 0 and 1.
        openmm.OpenMMException: an energy or a force is not finite, as where there are no positions, or atoms overlap.
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
        seen = _errors(motions, place, motions.forces, FIRST)
        doubtful = [number for number, (error, force) in seen.items() if error > tolerance * force]
        for number, (error, force) in _errors(motions, place, doubtful, MORE).items():
            if error > tolerance * force and (number not in worst or error > worst[number].error):
                worst[number] = place._replace(error=error, force=force)
    faults = [
        _fault(bodies, number, names[number], _located(motions, number, place)) for number, place in worst.items()
    ]
    return ForceCheck(tuple(faults), tuple(names.values()), tolerance)


class _Place(NamedTuple):
    """Hold the numbers of some bodies, how they move, and the error of a Force there; see `_errors`."""

    bodies: np.ndarray
    turns: bool
    error: float = 0.0
    force: float = 0.0


def _places(motions: Motions, bodies: BodySet) -> Iterator[_Place]:
    """Divide all bodies into parts, each of which is shifted, and turned where bodies can turn."""
    for turns in (False, True):
        able = np.flatnonzero(motions.radii > 0) if turns else np.arange(bodies.n)
        for part in np.array_split(able, min(PARTS, max(1, len(able)))):
            if len(part):
                yield _Place(part, turns)


def _errors(motions: Motions, place: _Place, numbers: list[int], times: int) -> dict[int, tuple[float, float]]:
    """Return for each Force what is wrong with it on the bodies of a place, and itself, as norms, kJ/mol/nm.

    The error is zero where it is not significant.
    """
    if not numbers:
        return {}
    along = [motions.along(place.bodies, numbers, place.turns) for _ in range(times)]
    return {number: _error([found[number] for found in along]) for number in numbers}


def _error(found: list[Mismatch]) -> tuple[float, float]:
    means, errors, forces = np.array(found).T
    square, noise = (means**2).mean(), (errors**2).mean()
    is_significant = np.isfinite(square) and square > SIGNIFICANT**2 * noise + LEAST**2
    return (float(np.sqrt(square - noise)) if is_significant else 0.0), float(np.sqrt((forces**2).mean()))


def _located(motions: Motions, number: int, place: _Place) -> _Place:
    """Find the body of a place on which a Force is most wrong, by halves."""
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
    found = getattr(context.getIntegrator(), "bodies", None)
    return found if isinstance(found, BodySet) else RigidBodies.from_system(context.getSystem())
