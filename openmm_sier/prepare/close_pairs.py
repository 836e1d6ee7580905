"""Nonbonded interactions of atoms a few bonds apart, as bonded forces, which can act within drifts.

Atoms up to four bonds apart feel steep nonbonded forces while angles bend, with periods of 20 fs for hydrogen. In the
kicks these forces limit the step of a peptide; with them inside the drifts its energy error at 6 fs is a seventh.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import openmm
from openmm import unit

#: Largest number of bonds between atoms whose interaction is moved. Moving those further apart makes no difference.
REACH = 4

#: 1/(4 pi epsilon_0) in kJ/mol nm/e^2, as OpenMM has it.
COULOMB = 138.93545764438198

#: Methods that treat exceptions like any other pair except for the parameters, with Coulomb's law unmodified for both.
METHODS = (openmm.NonbondedForce.NoCutoff, openmm.NonbondedForce.Ewald, openmm.NonbondedForce.PME)

#: Distance in nm, longer than four bonds. Lennard-Jones must be unmodified up to here.
SPAN = 0.65

#: Forces that OpenMM requires to exclude the same pairs as the NonbondedForce.
WITH_EXCLUSIONS = (openmm.CustomNonbondedForce, openmm.CustomGBForce, openmm.GBSAOBCForce, openmm.CustomHbondForce)

NAME = "ClosePairs"


def why_not(system: openmm.System) -> str | None:
    """Why the close pairs of a System cannot be moved to a force of their own; None if they can."""
    forces = system.getForces()
    nonbonded = [force for force in forces if isinstance(force, openmm.NonbondedForce)]
    if len(nonbonded) != 1:
        return f"there are {len(nonbonded)} NonbondedForces"
    (force,) = nonbonded
    if force.getNumParticleParameterOffsets() or force.getNumExceptionParameterOffsets():
        return "parameters of the NonbondedForce have offsets"
    if others := [other for other in forces if isinstance(other, WITH_EXCLUSIONS)]:
        return f"{others[0].getName()} has to exclude the same pairs"
    if force.getNonbondedMethod() not in METHODS:
        return "the NonbondedForce has a method other than PME, Ewald and NoCutoff"
    if force.getNonbondedMethod() != openmm.NonbondedForce.NoCutoff and _whole_up_to(force) < SPAN:
        return f"the NonbondedForce is switched off from {_whole_up_to(force):.3g} nm, which such pairs reach"
    return None


def _whole_up_to(force: openmm.NonbondedForce) -> float:
    cutoff, switch = force.getCutoffDistance()._value, force.getSwitchingDistance()._value
    return min(cutoff, switch) if force.getUseSwitchingFunction() else cutoff


def move_close_pairs(system: openmm.System, edges: np.ndarray, movable: np.ndarray, group: int) -> int:
    """Give pairs of atoms up to `REACH` bonds apart a force of their own; the potential energy is unchanged.

    Exceptions of the NonbondedForce lose their parameters, and pairs without an exception get one, without interaction.

    Args:
        system: openmm.System for which `why_not` is None.
        edges: bonded pairs of particles, (b, 2).
        movable: for each particle whether its pairs may be moved, (N,).
        group: force group of the new Force, a CustomBondForce named `NAME`.

    Returns:
        How many pairs were moved; if none, there is no new Force.
    """
    (nonbonded,) = (force for force in system.getForces() if isinstance(force, openmm.NonbondedForce))
    moved = openmm.CustomBondForce(f"{COULOMB!r}*q/r + 4*epsilon*((sigma/r)^12 - (sigma/r)^6)")
    for name in ("q", "sigma", "epsilon"):
        moved.addPerBondParameter(name)
    excepted = _move_exceptions(nonbonded, movable, moved)
    for a, b in _close(edges, movable):
        if (a, b) not in excepted:
            (q1, s1, e1), (q2, s2, e2) = (_numbers(nonbonded.getParticleParameters(i)) for i in (a, b))
            nonbonded.addException(a, b, 0.0, 1.0, 0.0)
            moved.addBond(a, b, [q1 * q2, (s1 + s2) / 2, (e1 * e2) ** 0.5])
    if moved.getNumBonds():
        moved.setName(NAME)
        moved.setForceGroup(group)
        system.addForce(moved)
    return moved.getNumBonds()


def _move_exceptions(
    nonbonded: openmm.NonbondedForce, movable: np.ndarray, moved: openmm.CustomBondForce
) -> set[tuple[int, int]]:
    """Give the interactions of exceptions to another Force; returns all pairs that have an exception."""
    excepted = set()
    for number in range(nonbonded.getNumExceptions()):
        a, b, *parameters = nonbonded.getExceptionParameters(number)
        excepted.add((min(a, b), max(a, b)))
        q, sigma, epsilon = _numbers(parameters)
        if (q or epsilon) and movable[a] and movable[b]:
            moved.addBond(a, b, [q, sigma, epsilon])
            nonbonded.setExceptionParameters(number, a, b, 0.0, 1.0, 0.0)
    return excepted


def _close(edges: np.ndarray, movable: np.ndarray) -> Iterator[tuple[int, int]]:
    """Movable pairs (smaller, larger) up to `REACH` edges apart."""
    neighbours = defaultdict(set)
    for a, b in np.asarray(edges).tolist():
        neighbours[a].add(b)
        neighbours[b].add(a)
    for start in sorted(neighbours):
        if not movable[start]:
            continue
        seen, front = {start}, {start}
        for _ in range(REACH):
            front = {other for atom in front for other in neighbours[atom]} - seen
            seen |= front
        yield from ((start, other) for other in sorted(seen) if other > start and movable[other])


def _numbers(parameters: Iterable[Any]) -> tuple[float, ...]:
    return tuple(p.value_in_unit_system(unit.md_unit_system) for p in parameters)
