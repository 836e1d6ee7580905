"""Named rigid bodies without constraints: rings of six atoms."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
import openmm

from openmm_sier import RigidBodies

#: Distance of the atoms of a ring from its centre and of rings from each other, nm.
RADIUS, SPACING = 0.14, 0.7

#: Dalton.
MASS = 12.0

#: Lennard-Jones parameters, nm and kJ/mol.
SIGMA, EPSILON = 0.34, 0.36


class Rings(NamedTuple):
    """Rings in a periodic box, with positions in nm, (N, 3)."""

    system: openmm.System
    positions: np.ndarray
    bodies: RigidBodies


def rings(number: int, cutoff: float) -> Rings:
    """Return rings on a lattice, whose planes are in three directions by turns.

    Args:
        number: of rings.
        cutoff: nm.
    """
    angles = np.arange(6) * np.pi / 3
    ring = RADIUS * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    side = int(np.ceil(number ** (1 / 3)))
    places = itertools.islice(itertools.product(range(side), repeat=3), number)
    positions = np.concatenate(
        [SPACING * np.array(place) + np.roll(ring, i % 3, axis=1) for i, place in enumerate(places)]
    )
    groups = np.arange(6 * number).reshape(-1, 6).tolist()
    system = openmm.System()
    system.setDefaultPeriodicBoxVectors(*(SPACING * side * np.eye(3)))
    force = openmm.NonbondedForce()
    force.setNonbondedMethod(openmm.NonbondedForce.CutoffPeriodic)
    force.setCutoffDistance(cutoff)
    for group in groups:
        for i in group:
            system.addParticle(MASS)
            force.addParticle(0, SIGMA, EPSILON)
            for j in range(group[0], i):
                force.addException(i, j, 0, 1, 0)
    system.addForce(force)
    return Rings(system, positions, RigidBodies.from_system(system, None, groups, positions))
