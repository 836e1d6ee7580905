"""Flexible SPC as an OpenMM System."""

import numpy as np
import openmm

from tests.support.starts import displaced

#: Of bonds, kJ/mol/nm^2, and of angles, kJ/mol/rad^2.
BOND, ANGLE = 2.8e5, 420.0


def system_of(count):
    """System and positions (N, 3) in nm of molecules in a row, 0.45 nm apart, at the minimum of bonds and angles."""
    half = np.arccos(-1 / 3) / 2
    shape = 0.1 * np.array([[0, 0, 0], [np.sin(half), np.cos(half), 0], [-np.sin(half), np.cos(half), 0]])
    system, positions = openmm.System(), []
    bonds, angles, nonbonded = openmm.HarmonicBondForce(), openmm.HarmonicAngleForce(), openmm.NonbondedForce()
    for number in range(count):
        oxygen, *hydrogens = (system.addParticle(mass) for mass in (15.999, 1.008, 1.008))
        nonbonded.addParticle(-0.82, 0.31, 0.7)
        for hydrogen in hydrogens:
            nonbonded.addParticle(0.41, 0.12, 0.06)
            bonds.addBond(oxygen, hydrogen, 0.1, BOND)
        angles.addAngle(hydrogens[0], oxygen, hydrogens[1], 2 * half, ANGLE)
        positions.append(shape - shape.mean(axis=0) + [0, 0, 0.45 * number])
    pairs = [bonds.getBondParameters(i)[:2] for i in range(bonds.getNumBonds())]
    nonbonded.createExceptionsFromBonds(pairs, 0.83, 0.5)
    for force in (bonds, angles, nonbonded):
        system.addForce(force)
    return system, displaced(np.vstack(positions), system)
