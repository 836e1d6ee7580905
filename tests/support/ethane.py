"""A molecule that is constrained and not rigid."""

import numpy as np
import openmm

from tests.support.starts import displaced
from tests.support.systems import assembled


def ethane():
    """System and positions (8, 3) in nm of an ethane with constrained C-H bonds."""
    bond, angle = openmm.HarmonicBondForce(), openmm.HarmonicAngleForce()
    bond.addBond(0, 4, 0.153, 2e5)
    system = assembled((12.0, 1.0, 1.0, 1.0) * 2, bond, angle)
    for carbon, other in ((0, 4), (4, 0)):
        hydrogens = [carbon + i for i in (1, 2, 3)]
        for i in hydrogens:
            system.addConstraint(carbon, i, 0.109)
            angle.addAngle(i, carbon, other, np.deg2rad(110), 400)
        for i, j in ((0, 1), (0, 2), (1, 2)):
            angle.addAngle(hydrogens[i], carbon, hydrogens[j], np.deg2rad(108), 300)
    turns = np.array([0, 2 * np.pi / 3, 4 * np.pi / 3])
    ring = np.stack([np.full(3, -0.037), 0.1025 * np.cos(turns), 0.1025 * np.sin(turns)], axis=1)
    half = np.concatenate([np.zeros((1, 3)), ring])
    positions = np.concatenate([half, half * [-1, 1, -1] + [0.153, 0, 0]])
    return system, displaced(positions, system)
