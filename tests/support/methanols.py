"""A box of methanol as it stands in a PDB file, whose coordinates are rounded."""

from itertools import combinations

import numpy as np
import openmm
from openmm import app
from scipy.spatial.transform import Rotation

ATOMS = ("C", "H1", "H2", "H3", "O", "HO")
MASSES = np.array([12.011, 1.008, 1.008, 1.008, 15.999, 1.008])


def _geometry():
    """Coordinates in nm: staggered, C-H 0.109, C-O 0.143, O-H 0.0945, angles at C tetrahedral, at O 108.5 degrees."""
    around = 2 * np.pi / 3 * np.arange(3)
    rim = np.sqrt(8) * np.stack([np.cos(around), np.sin(around)], axis=1)
    hydrogens = 0.109 / 3 * np.column_stack([-np.ones(3), rim])
    angle = np.radians(108.5)
    hydroxyl = [0.143 - 0.0945 * np.cos(angle), -0.0945 * np.sin(angle), 0.0]
    return np.array([[0.0, 0.0, 0.0], *hydrogens, [0.143, 0.0, 0.0], hydroxyl])


GEOMETRY = _geometry()

#: nm, of coordinates in a PDB file.
DIGIT = 1e-4


def positions_of(molecules, geometry=GEOMETRY, seed=1, digit=DIGIT):
    """Positions (6 molecules, 3) in nm on a grid, each molecule turned at random, rounded to a digit."""
    side = int(np.ceil(molecules ** (1 / 3)))
    centres = 0.45 * np.array(list(np.ndindex(side, side, side)))[:molecules]
    turns = Rotation.random(molecules, rng=np.random.default_rng(seed)).as_matrix()
    positions = (np.einsum("mxy,ky->mkx", turns, geometry) + centres[:, None]).reshape(-1, 3)
    return np.round(positions / digit) * digit if digit else positions


def topology_of(molecules):
    topology = app.Topology()
    chain = topology.addChain()
    for number in range(molecules):
        residue = topology.addResidue("MOH", chain, str(number + 1))
        atoms = [topology.addAtom(name, app.element.Element.getBySymbol(name[0]), residue) for name in ATOMS]
        for i, j in ((0, 1), (0, 2), (0, 3), (0, 4), (4, 5)):
            topology.addBond(atoms[i], atoms[j])
    return topology


def system_of(molecules, pairs=(), positions=None):
    """A System with constraints between pairs of atoms of each molecule, as long as those are in `positions`.

    Bonds, angles and soft interactions are there too.
    """
    system = openmm.System()
    bonds, angles, nonbonded = openmm.HarmonicBondForce(), openmm.HarmonicAngleForce(), openmm.NonbondedForce()
    for start in range(0, 6 * molecules, 6):
        for mass, charge in zip(MASSES, (0.1, 0.05, 0.05, 0.05, -0.65, 0.4), strict=True):
            system.addParticle(mass)
            nonbonded.addParticle(charge, 0.3 if mass > 2 else 0.1, 0.4 if mass > 2 else 0.05)
        for i, j in pairs:
            system.addConstraint(start + i, start + j, np.linalg.norm(positions[start + i] - positions[start + j]))
        for i, j in combinations(range(6), 2):
            nonbonded.addException(start + i, start + j, 0, 1, 0)
        for i, j, length in ((0, 1, 0.11), (0, 2, 0.11), (0, 3, 0.11), (0, 4, 0.14), (4, 5, 0.096)):
            bonds.addBond(start + i, start + j, length, 3e5)
        for i, j, k in ((1, 0, 2), (1, 0, 3), (2, 0, 3), (4, 0, 1), (4, 0, 2), (4, 0, 3), (0, 4, 5)):
            angles.addAngle(start + i, start + j, start + k, 1.95, 300.0)
    for force in (bonds, angles, nonbonded):
        system.addForce(force)
    return system
