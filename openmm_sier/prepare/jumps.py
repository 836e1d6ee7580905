"""Pair energies that end at the cut-off with a jump, which the forces do not know."""

from collections import Counter
from collections.abc import Iterator
from itertools import combinations_with_replacement
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
import openmm
from openmm import unit

from openmm_sier.system import tables
from openmm_sier.system.inner_forces import Part, parts

#: kJ/mol. Smaller jumps are not spoken of. In TIP3P at 0.9 nm, where it is 5e-3, rms(H)/rms(V) of SIER4G within 1 ps is
#: 0.2 to 0.3 %, and the error goes with the jump: one of this size adds less than a scheme of fourth order has itself.
LEAST = 1e-4

#: Fraction of the cut-off at which an energy is taken to be that before the jump: an expression may end with a step.
JUST_WITHIN = 1 - 1e-9

#: So many kinds of particles, those of which there are most, are looked at in pairs.
MOST_KINDS = 40

#: Distance at which OpenMM's switching function is to begin, over the cut-off.
SWITCHED_FROM = 5 / 6


class Jump(NamedTuple):
    """A jump of a pair energy at the cut-off.

    Attributes:
        energy: its size, kJ/mol.
        atoms: particle indices of a pair that has it.
    """

    energy: float
    atoms: tuple[int, int]


def describe_jumps(system: openmm.System) -> tuple[str, ...]:
    """Return a sentence for each Force of a System that ends with a jump, with the remedy that this Force has."""
    return tuple(dict.fromkeys(_described(part, jump) for part in parts(system) if (jump := _jump(part))))


def _described(part: Part, jump: Jump) -> str:
    cutoff = part.force.getCutoffDistance().value_in_unit(unit.nanometer)
    start = f"{SWITCHED_FROM * cutoff:.2g}*nanometer"
    by_hand = f"setUseSwitchingFunction(True) and setSwitchingDistance({start}) of this Force"
    what = f"{part.name} ends with a jump of the energy at {cutoff:.3g} nm"
    if isinstance(part.force, openmm.NonbondedForce):
        return (
            f"{what}, which matters most at constant energy: in water at 0.9 nm SIER4G then has an energy error of 0.2 "
            f"to 0.3 % within 1 ps in place of 0.1 %. Create the System with switchDistance={start}, or call {by_hand}."
        )
    a, b = jump.atoms
    return (
        f"{what}, of {jump.energy:.1g} kJ/mol between atoms {a} and {b}. Each pair that crosses it changes the energy "
        f"by that much: call {by_hand}, or subtract from the expression its value at the cut-off."
    )


def _jump(part: Part) -> Jump | None:
    """Return the largest jump of a Force, by its parameters and global parameters at their defaults; None without."""
    force = part.force
    if not isinstance(force, openmm.NonbondedForce | openmm.CustomNonbondedForce) or force.getUseSwitchingFunction():
        return None
    if force.getNonbondedMethod() == force.NoCutoff:
        return None
    weight = part.weight
    found = _of_lennard_jones(force) if isinstance(force, openmm.NonbondedForce) else _of_expression(force)
    jumps = (Jump((1.0 if weight is None else abs(weight)) * energy, atoms) for energy, atoms in found)
    largest = max((jump for jump in jumps if np.isfinite(jump.energy)), default=Jump(0.0, (0, 0)))
    return largest if largest.energy > LEAST else None


def _of_lennard_jones(force: openmm.NonbondedForce) -> Iterator[Jump]:
    """Give the largest jump of an atom with its like. Coulomb's law has none: it is shifted, or goes on in the mesh."""
    if force.getNonbondedMethod() == force.LJPME or not force.getNumParticles():
        return
    cutoff = force.getCutoffDistance().value_in_unit(unit.nanometer)
    _, sigma, epsilon = tables.atom_parameters(force).T
    sixth = (sigma / cutoff) ** 6
    energies = np.abs(4 * epsilon * (sixth - 1) * sixth)
    atom = int(np.where(np.isfinite(energies), energies, 0.0).argmax())
    yield Jump(float(energies[atom]), (atom, atom))


def _of_expression(force: openmm.CustomNonbondedForce) -> Iterator[Jump]:
    """Give the jump of each pair of kinds of particles that interact."""
    if not force.getNumParticles():
        return
    kinds = [tuple(force.getParticleParameters(i)) for i in range(force.getNumParticles())]
    members: dict[tuple, list[int]] = {kind: [] for kind, _ in Counter(kinds).most_common(MOST_KINDS)}
    for i, kind in enumerate(kinds):
        if kind in members:
            members[kind].append(i)
    alone, context = _two_alone(force)
    for one, other in combinations_with_replacement(members, 2):
        atoms = _interacting(force, members[one], members[other])
        if atoms is None:
            continue
        alone.setParticleParameters(0, one)
        alone.setParticleParameters(1, other)
        alone.updateParametersInContext(context)
        energy = context.getState(energy=True).getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole)
        yield Jump(abs(energy), atoms)


def _interacting(force: openmm.CustomNonbondedForce, one: list[int], other: list[int]) -> tuple[int, int] | None:
    """Return an atom of each list that interact with each other; None where a Force lets none do so."""
    if not force.getNumInteractionGroups():
        return _pair(one, other)
    for number in range(force.getNumInteractionGroups()):
        here, there = map(set, force.getInteractionGroupParameters(number))
        for group, opposite in ((here, there), (there, here)):
            found = _pair([i for i in one if i in group], [i for i in other if i in opposite])
            if found is not None:
                return found
    return None


def _pair(one: list[int], other: list[int]) -> tuple[int, int] | None:
    """Return an atom of each list, not twice the same; None where there are none."""
    for first in one[:2]:
        for second in other[:2]:
            if first != second:
                return first, second
    return None


def _two_alone(force: openmm.CustomNonbondedForce) -> tuple[openmm.CustomNonbondedForce, openmm.Context]:
    """Return the same Force for two particles only, without cut-off, and a Context of these, the cut-off apart."""
    root = ElementTree.fromstring(openmm.XmlSerializer.serialize(force))
    for name in ("Particles", "Exclusions", "InteractionGroups"):
        if (listed := root.find(name)) is not None:
            listed.clear()
    root.set("method", str(openmm.CustomNonbondedForce.NoCutoff))
    alone = openmm.XmlSerializer.deserialize(ElementTree.tostring(root, encoding="unicode"))
    system = openmm.System()
    for _ in range(2):
        system.addParticle(1.0)
        alone.addParticle(force.getParticleParameters(0))
    system.addForce(alone)
    reference = openmm.Platform.getPlatformByName("Reference")
    context = openmm.Context(system, openmm.VerletIntegrator(0.001), reference)
    cutoff = force.getCutoffDistance().value_in_unit(unit.nanometer)
    context.setPositions([openmm.Vec3(0, 0, 0), openmm.Vec3(JUST_WITHIN * cutoff, 0, 0)])
    return alone, context
