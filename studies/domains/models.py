"""Models of the study: a System with rigid bodies, and one with springs in the bodies."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import openmm

from openmm_sier import RigidBodies

#: Force groups: of interactions between bodies, and of springs within them, which the rigid model lacks. Energies that
#: are compared leave springs out.
INTERACTIONS, SPRINGS = 4, 5

#: The names of the Forces of bonds that join no bodies, and of those that do, and the force group of fast forces.
LINKERS, JOINTS, FAST = "bonds of linkers", "bonds to domains", 1

#: Numbers of two atoms, the lower one first.
Pair = tuple[int, int]


@dataclass(frozen=True)
class Model:
    """Bodies in a bath, rigid or held by springs.

    Attributes:
        name: for tables.
        rigid: the System in which bodies are rigid; nothing acts within them.
        network: one in which springs of the force group `SPRINGS` hold bodies; None without.
        positions: (N, 3), nm.
        bodies: atoms of each body.
        chains: atoms of each molecule of several bodies, of which there is a radius of gyration.
        temperature: K.
        usual: the step with which such models are run with springs, fs.
        offset: kJ/mol, of what cannot move.
    """

    name: str
    rigid: openmm.System
    network: openmm.System | None
    positions: np.ndarray
    bodies: Sequence[Sequence[int]]
    chains: Sequence[Sequence[int]] = ()
    temperature: float = 300.0
    usual: float = 10.0
    offset: float = 0.0

    @cached_property
    def rigid_bodies(self) -> RigidBodies:
        """The rigid bodies of the System `rigid`, with the shapes that they have in the positions."""
        return RigidBodies.from_system(self.rigid, rigid=self.bodies, positions=self.positions)


def pairs_within(bodies: Sequence[Sequence[int]]) -> set[Pair]:
    """All pairs of atoms of one body, the lower number first."""
    return {pair for body in bodies for pair in itertools.combinations(sorted(body), 2)}


def nearer(pairs: Iterable[Pair], positions: np.ndarray, reach: float) -> set[Pair]:
    """The pairs whose atoms are not as far apart as `reach`, nm."""
    return {(i, j) for i, j in pairs if np.linalg.norm(positions[i] - positions[j]) < reach}


def exclude(force: openmm.CustomNonbondedForce | openmm.NonbondedForce, pairs: Iterable[Pair]) -> None:
    """Leave out the interactions of pairs in a Force that leaves out none of them yet."""
    for i, j in sorted(pairs):
        if isinstance(force, openmm.CustomNonbondedForce):
            force.addExclusion(i, j)
        else:
            force.addException(i, j, 0, 1, 0)


def contacts(cutoff: float, switch: float) -> openmm.NonbondedForce:
    """A Force without charges and without atoms, whose interactions are switched off between two distances, nm."""
    force = openmm.NonbondedForce()
    force.setNonbondedMethod(force.CutoffPeriodic)
    # Reaction fields do not matter without charges.
    force.setCutoffDistance(cutoff)
    force.setUseSwitchingFunction(True)
    force.setSwitchingDistance(switch)
    force.setName("contacts")
    force.setForceGroup(INTERACTIONS)
    return force


def of_molecules(
    name: str,
    force: openmm.NonbondedForce,
    molecules: Sequence[np.ndarray],
    mass: float,
    lennard_jones: tuple[float, float],
    edge: float,
) -> Model:
    """A model of rigid molecules of one kind of atom in a cubic box.

    Args:
        name: of the model.
        force: see `contacts`; atoms are added.
        molecules: positions of each, (k, 3), nm.
        mass: of an atom, Da.
        lennard_jones: sigma in nm and epsilon in kJ/mol.
        edge: nm.
    """
    system = openmm.System()
    bodies = []
    for places in molecules:
        bodies.append([system.addParticle(mass) for _ in places])
        for _ in places:
            force.addParticle(0, *lennard_jones)
    exclude(force, pairs_within(bodies))
    system.addForce(force)
    system.setDefaultPeriodicBoxVectors(*(edge * np.eye(3)))
    return Model(name, system, None, np.concatenate(molecules), bodies)


def springs(positions: np.ndarray, stiffness: Mapping[Pair, float]) -> openmm.HarmonicBondForce:
    """Springs k/2 (r - r0)^2 at rest in some positions (N, 3) in nm, with k in kJ/mol/nm^2 for each pair."""
    force = openmm.HarmonicBondForce()
    force.setName("springs")
    force.setForceGroup(SPRINGS)
    for (i, j), k in sorted(stiffness.items()):
        force.addBond(i, j, float(np.linalg.norm(positions[i] - positions[j])), k)
    return force


def with_network(
    system: openmm.System, positions: np.ndarray, bodies: Sequence[Sequence[int]], reach: float, stiffness: float
) -> openmm.System:
    """Return a copy of a System with springs of one stiffness within bodies.

    Args:
        system: openmm.System.
        positions: (N, 3), nm, at which the springs are at rest.
        bodies: atoms of each body.
        reach: nm, up to which two atoms of a body are joined.
        stiffness: kJ/mol/nm^2.
    """
    joined = nearer(pairs_within(bodies), positions, reach)
    return with_force(system, springs(positions, dict.fromkeys(joined, stiffness)))


def with_force(system: openmm.System, force: openmm.Force) -> openmm.System:
    """A copy of a System with one more Force."""
    copy = openmm.XmlSerializer.clone(system)
    copy.addForce(force)
    return copy
