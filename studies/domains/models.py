"""A model of the study: a System whose bodies are rigid, and one in which springs hold them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import openmm

#: Force groups: of interactions between bodies, and of springs within them, which the rigid model lacks. Energies that
#: are compared leave springs out.
INTERACTIONS, SPRINGS = 4, 5


@dataclass(frozen=True)
class Model:
    """Bodies in a bath, rigid or held by springs.

    Attributes:
        name: for tables.
        rigid: the System in which bodies are rigid; nothing acts within them.
        network: the same with springs in the force group `SPRINGS`, by which bodies hold their shape; None without.
        positions: (N, 3), nm.
        bodies: atoms of each body.
        chains: atoms of each molecule of several bodies, of which there is a radius of gyration.
        temperature: K.
        pressure: bar; None keeps the volume.
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
    pressure: float | None = None
    usual: float = 10.0
    offset: float = 0.0


def exclude_within(force: openmm.CustomNonbondedForce | openmm.NonbondedForce, bodies: Sequence[Sequence[int]]) -> None:
    """Leave out the interactions of atoms of one body, but for pairs that are left out already."""
    custom = isinstance(force, openmm.CustomNonbondedForce)
    known = set()
    for index in range(force.getNumExclusions() if custom else force.getNumExceptions()):
        i, j, *_ = force.getExclusionParticles(index) if custom else force.getExceptionParameters(index)
        known.add((min(i, j), max(i, j)))
    for body in bodies:
        for i, j in itertools.combinations(sorted(body), 2):
            if (i, j) in known:
                continue
            if custom:
                force.addExclusion(i, j)
            else:
                force.addException(i, j, 0, 1, 0)


def with_springs(
    system: openmm.System, positions: np.ndarray, bodies: Sequence[Sequence[int]], stiffness: float, reach: float
) -> openmm.System:
    """A copy of a System in which springs hold each body in its shape.

    Args:
        system: in which nothing acts within bodies.
        positions: (N, 3), nm.
        bodies: atoms of each.
        stiffness: of a spring k/2 (r - r0)^2, kJ/mol/nm^2.
        reach: nm, up to which atoms of a body are joined.
    """
    made = openmm.XmlSerializer.clone(system)
    springs = openmm.HarmonicBondForce()
    springs.setName("springs")
    springs.setForceGroup(SPRINGS)
    for body in bodies:
        for i, j in itertools.combinations(body, 2):
            length = float(np.linalg.norm(positions[i] - positions[j]))
            if length < reach:
                springs.addBond(i, j, length, stiffness)
    made.addForce(springs)
    return made
