"""Crystals of C60 with rotating molecules: Lennard-Jones atoms with Girifalco's parameters.

The interactions are those of L. A. Girifalco, J. Phys. Chem. 96, 858 (1992). The crystal is
cubic and face-centred, with a lattice constant of 1.417 nm at room temperature (W. I. F. David et al., Europhys. Lett.
18, 219 (1992)).
"""

from __future__ import annotations

import itertools
import math

import numpy as np
import openmm

from studies.domains.models import INTERACTIONS, Model, exclude, pairs_within

#: Mass in dalton, length of a bond in nm, and Lennard-Jones of a carbon atom, nm and kJ/mol.
CARBON, BOND, SIGMA, EPSILON = 12.011, 0.144, 0.3469, 0.2763

GOLDEN = (1 + 5**0.5) / 2

#: nm, at 300 K and 1 bar.
LATTICE = 1.417

#: nm, of the interactions and of the distance from which they are switched off.
CUTOFF, SWITCH = 1.25, 1.1


def model(cells: int = 2, cutoff: float = CUTOFF, switch: float = SWITCH) -> Model:
    """A crystal of `cells`^3 cells of four molecules.

    Args:
        cells: along each edge.
        cutoff, switch: nm; less in a small box.
    """
    system, force, places, bodies = openmm.System(), openmm.NonbondedForce(), [], []
    force.setNonbondedMethod(force.CutoffPeriodic)
    # Reaction fields do not matter without charges.
    force.setCutoffDistance(min(cutoff, 0.49 * cells * LATTICE))
    force.setUseSwitchingFunction(True)
    force.setSwitchingDistance(min(switch, 0.43 * cells * LATTICE))
    force.setName("contacts")
    force.setForceGroup(INTERACTIONS)
    random = np.random.default_rng(1)
    faces = 0.5 * np.array([[0, 0, 0], [0, 1, 1], [1, 0, 1], [1, 1, 0]])
    for cell, corner in itertools.product(itertools.product(range(cells), repeat=3), faces):
        rotated = buckminsterfullerene() @ rotation(random)
        places.append(rotated + LATTICE * (np.array(cell) + corner))
        bodies.append([system.addParticle(CARBON) for _ in rotated])
        for _ in rotated:
            force.addParticle(0, SIGMA, EPSILON)
    exclude(force, pairs_within(bodies))
    system.addForce(force)
    system.setDefaultPeriodicBoxVectors(*(cells * LATTICE * np.eye(3)))
    return Model("C60", system, None, np.concatenate(places), bodies)


def buckminsterfullerene() -> np.ndarray:
    """Return the positions (60, 3) of a cage in nm about the origin."""
    corners = set()
    for corner in ((0, 1, 3 * GOLDEN), (1, 2 + GOLDEN, 2 * GOLDEN), (GOLDEN, 2, 2 * GOLDEN + 1)):
        for signs in itertools.product((1, -1), repeat=3):
            for shift in range(3):
                corners.add(tuple(np.round(np.roll(np.array(corner) * signs, shift), 12) + 0.0))
    return BOND / 2 * np.array(sorted(corners))


def rotation(random: np.random.Generator) -> np.ndarray:
    """A rotation at random, (3, 3)."""
    found, triangle = np.linalg.qr(random.normal(size=(3, 3)))
    found *= np.sign(np.diag(triangle))
    return found * math.copysign(1, np.linalg.det(found))
