"""Nonbonded interactions of atoms a few bonds apart, which act within drifts and not in the kicks.

Atoms up to four bonds apart feel steep nonbonded forces while angles bend, with periods of 20 fs for hydrogen. In the
kicks these forces limit the step of a peptide; with them inside the drifts its energy error at 6 fs is a seventh.

The NonbondedForce stays as it is. A force of its own computes the close pairs once more, in the fast group, and another
one subtracts them in the kicks. The two cancel whatever is done to the other Forces later, so that the System remains
what it was: if charges are scaled after that, only the division into fast and slow forces becomes less good.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
import openmm
from openmm import unit

#: Largest number of bonds between atoms of a close pair. Those further apart make no difference.
REACH = 4

#: 1/(4 pi epsilon_0) in kJ/mol nm/e^2, as OpenMM has it.
COULOMB = 138.93545764438198

#: Names of the two Forces. XML and copies keep them, and a prepared System is recognized by them.
NAME = "openmm_sier: close pairs"
OPPOSITE = "openmm_sier: close pairs, subtracted"

#: Coulomb's law and Lennard-Jones by powers of r alone, which take half as long as with sigma and epsilon.
ENERGY = "coulomb*u + (repulsion*u6 - attraction)*u6; u6 = u^6; u = 1/r"


class Pair(NamedTuple):
    """Parameters of an interaction, e^2, nm and kJ/mol."""

    q: float
    sigma: float
    epsilon: float


def own_forces(system: openmm.System) -> list[int]:
    """Numbers of the Forces that preparation added to a System."""
    return [i for i, force in enumerate(system.getForces()) if force.getName() in (NAME, OPPOSITE)]


def fast_force_groups(system: openmm.System) -> int:
    """Bit mask of the fast force groups of a prepared System; 0 for any other System."""
    return sum({1 << force.getForceGroup() for force in system.getForces() if force.getName() == NAME})


def add_close_pairs(system: openmm.System, edges: np.ndarray, movable: np.ndarray, group: int, periodic: bool) -> int:
    """Add the interactions of close pairs to a fast group, and subtract them from that of the NonbondedForce.

    They are those of the NonbondedForces as they are now, with global parameters at their defaults, and without cut-off
    and switch. The potential energy is unchanged. Without a close pair there is an empty Force in the fast group, by
    which the System is recognized, and nothing is subtracted.

    Args:
        system: openmm.System, which has none of `own_forces`.
        edges: bonded pairs of particles, (b, 2).
        movable: for each particle whether its pairs may act within drifts, (N,).
        group: the fast force group.
        periodic: whether distances are those of the nearest images.

    Returns:
        How many pairs there are.
    """
    forces = [force for force in system.getForces() if isinstance(force, openmm.NonbondedForce)]
    close = list(_close(edges, movable))
    fast, opposite = _pair_force(NAME, "", group, periodic), None
    for force in forces:
        if opposite is None:
            opposite = _pair_force(OPPOSITE, "-", force.getForceGroup(), periodic)
        for (a, b), (q, sigma, epsilon) in _interactions(force, close):
            parameters = [COULOMB * q, 4 * epsilon * sigma**12, 4 * epsilon * sigma**6]
            fast.addBond(a, b, parameters)
            opposite.addBond(a, b, parameters)
    system.addForce(fast)
    if opposite is not None and opposite.getNumBonds():
        system.addForce(opposite)
    return fast.getNumBonds()


def _pair_force(name: str, sign: str, group: int, periodic: bool) -> openmm.CustomBondForce:
    energy, definitions = ENERGY.split(";", 1)
    force = openmm.CustomBondForce(f"{sign}({energy});{definitions}")
    for parameter in ("coulomb", "repulsion", "attraction"):
        force.addPerBondParameter(parameter)
    force.setName(name)
    force.setForceGroup(group)
    force.setUsesPeriodicBoundaryConditions(periodic)
    return force


def _interactions(force: openmm.NonbondedForce, close: list[tuple[int, int]]) -> Iterator[tuple[tuple[int, int], Pair]]:
    """The close pairs that a NonbondedForce lets interact, and how."""
    exceptions, atoms = _exceptions(force, set(close)), _atoms(force, {atom for pair in close for atom in pair})
    for a, b in close:
        pair = exceptions.get((a, b)) or _combined(atoms[a], atoms[b])
        if pair.q or pair.epsilon:
            yield (a, b), pair


def _combined(one: Pair, other: Pair) -> Pair:
    return Pair(one.q * other.q, (one.sigma + other.sigma) / 2, math.sqrt(max(0.0, one.epsilon * other.epsilon)))


def _atoms(force: openmm.NonbondedForce, wanted: set[int]) -> dict[int, Pair]:
    """Charge, sigma and epsilon of some particles."""
    offsets = _offsets(force, force.getNumParticleParameterOffsets(), openmm.NonbondedForce.getParticleParameterOffset)
    return {i: _shifted(_numbers(force.getParticleParameters(i)), offsets[i]) for i in wanted}


def _exceptions(force: openmm.NonbondedForce, wanted: set[tuple[int, int]]) -> dict[tuple[int, int], Pair]:
    """The exceptions among some pairs."""
    offsets = _offsets(
        force, force.getNumExceptionParameterOffsets(), openmm.NonbondedForce.getExceptionParameterOffset
    )
    found = {}
    for number in range(force.getNumExceptions()):
        a, b, *parameters = force.getExceptionParameters(number)
        if (pair := (min(a, b), max(a, b))) in wanted:
            found[pair] = _shifted(_numbers(parameters), offsets[number])
    return found


def _offsets(force: openmm.NonbondedForce, count: int, get: Any) -> dict[int, np.ndarray]:
    """What global parameters, at their defaults, add to the parameters of particles or exceptions."""
    names = range(force.getNumGlobalParameters())
    defaults = {force.getGlobalParameterName(i): force.getGlobalParameterDefaultValue(i) for i in names}
    found: dict[int, np.ndarray] = defaultdict(lambda: np.zeros(3))
    for number in range(count):
        parameter, index, *scales = get(force, number)
        found[index] += defaults[parameter] * np.array(_numbers(scales))
    return found


def _shifted(parameters: Iterable[float], offset: np.ndarray) -> Pair:
    return Pair(*(np.array(tuple(parameters)) + offset).tolist())


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
    md = unit.md_unit_system
    return tuple(p.value_in_unit_system(md) if unit.is_quantity(p) else float(p) for p in parameters)
