"""Small flexible molecules by name, as OpenMM Systems among rigid waters and ions."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
import openmm

from tests.support.starts import displaced

#: Masses, charges, Lennard-Jones radius in nm and depth in kJ/mol.
ATOMS = {
    "C": (12.011, -0.1, 0.34, 0.4),
    "H": (1.008, 0.06, 0.12, 0.06),
    "O": (15.999, -0.4, 0.31, 0.7),
    "S": (32.06, -0.1, 0.36, 1.0),
    "Na": (22.99, 1.0, 0.25, 0.4),
    "Cl": (35.45, -1.0, 0.44, 0.4),
}

#: Of bonds, kJ/mol/nm^2, those with hydrogen and the others; of angles, kJ/mol/rad^2.
WITH_HYDROGEN, HEAVY, BENDING = 2.8e5, 2.6e5, 420.0

TIP3P = np.array([[0.0, 0.0, 0.0], [0.09572, 0.0, 0.0], [-0.0239872, 0.0926627, 0.0]])


@dataclass
class Molecule:
    """Atoms at the minimum of their bonds and angles.

    Attributes:
        elements: of the atoms.
        x: positions, (n, 3), nm.
        bonds: pairs of atoms.
        held: which pairs constraints hold; they may be no bonds.
        torsions: (i, j, k, l) of threefold barriers.
    """

    elements: tuple[str, ...]
    x: np.ndarray
    bonds: tuple[tuple[int, int], ...] = ()
    held: tuple[tuple[int, int], ...] = ()
    torsions: tuple[tuple[int, int, int, int], ...] = ()
    charges: tuple[float, ...] | None = None

    def with_hydrogens_held(self) -> Molecule:
        """The same with constraints on bonds of hydrogen."""
        held = tuple(bond for bond in self.bonds if "H" in (self.elements[bond[0]], self.elements[bond[1]]))
        return Molecule(self.elements, self.x, self.bonds, held, self.torsions, self.charges)


def water(rigid=True):
    """TIP3P's geometry; flexible it has springs for its bonds and its angle."""
    bonds = ((0, 1), (0, 2))
    return Molecule(("O", "H", "H"), TIP3P, bonds, (*bonds, (1, 2)) if rigid else (), charges=(-0.834, 0.417, 0.417))


def spc():
    """Flexible SPC: 0.1 nm, tetrahedral, springs for bonds and the angle."""
    half = np.arccos(-1 / 3) / 2
    x = 0.1 * np.array([[0, 0, 0], [np.sin(half), np.cos(half), 0], [-np.sin(half), np.cos(half), 0]])
    return Molecule(("O", "H", "H"), x, ((0, 1), (0, 2)), charges=(-0.82, 0.41, 0.41))


def ion(element):
    return Molecule((element,), np.zeros((1, 3)))


def _methyl(at, axis):
    """Hydrogens (3, 3) of a methyl group at a place, whose bond to the rest points along an axis."""
    axis = axis / np.linalg.norm(axis)
    side = np.cross(axis, [0.3, -0.5, 0.8])
    side /= np.linalg.norm(side)
    other = np.cross(axis, side)
    turns = 2 * np.pi / 3 * np.arange(3)
    out = np.cos(turns)[:, None] * side + np.sin(turns)[:, None] * other
    return at + 0.109 * (-axis / 3 + np.sqrt(8) / 3 * out)


def disulfide():
    """Dimethyl disulfide: CH3-S-S-CH3 with a dihedral of 90 degrees."""
    half, angle = 0.1025, np.radians(103.0)
    along, across = 0.181 * np.cos(angle), 0.181 * np.sin(angle)
    sulfur = np.array([[-half, 0, 0], [half, 0, 0]])
    carbon = np.array([[-half + along, across, 0], [half - along, 0, across]])
    hydrogens = [_methyl(c, s - c) for c, s in zip(carbon, sulfur, strict=True)]
    bonds = ((0, 1), (0, 2), (1, 3), *((2, i) for i in (4, 5, 6)), *((3, i) for i in (7, 8, 9)))
    torsions = ((2, 0, 1, 3), (4, 2, 0, 1), (7, 3, 1, 0))
    return Molecule((*"SSCC", *6 * "H"), np.vstack([sulfur, carbon, *hydrogens]), bonds, torsions=torsions)


def carbon_dioxide():
    """Three atoms in a row without anything that holds them: for a body that is named."""
    x = np.array([[-0.116, 0, 0], [0, 0, 0], [0.116, 0, 0]])
    return Molecule(("O", "C", "O"), x, charges=(-0.35, 0.7, -0.35))


def system_of(molecules, dumbbells=0, box=None):
    """System and positions (N, 3) in nm of up to eight molecules on a grid, 0.45 nm apart, all within the cut-off.

    Args:
        molecules: `Molecule` objects.
        dumbbells: so many CO2 follow, of two masses held apart with the carbon as a virtual site.
        box: edge in nm for PME; None: no cut-off.
    """
    system, positions = openmm.System(), []
    bonds, angles, torsions = openmm.HarmonicBondForce(), openmm.HarmonicAngleForce(), openmm.PeriodicTorsionForce()
    nonbonded = openmm.NonbondedForce()
    all_bonds: list[tuple[int, int]] = []
    places = 0.45 * np.array(list(np.ndindex(2, 2, 2)))
    chosen = [*molecules, *dumbbells * [carbon_dioxide()]]
    for number, molecule in enumerate(chosen):
        first = system.getNumParticles()
        dumbbell = number >= len(molecules)
        for i, element in enumerate(molecule.elements):
            mass, charge, radius, depth = ATOMS[element]
            if dumbbell:
                mass = 0.0 if element == "C" else 22.005
            system.addParticle(mass)
            nonbonded.addParticle(molecule.charges[i] if molecule.charges else charge, radius, depth)
        positions.append(molecule.x - molecule.x.mean(axis=0) + places[number])
        if dumbbell:
            system.setVirtualSite(first + 1, openmm.TwoParticleAverageSite(first, first + 2, 0.5, 0.5))
            system.addConstraint(first, first + 2, 0.232)
        for i, j in molecule.held:
            system.addConstraint(first + i, first + j, np.linalg.norm(molecule.x[i] - molecule.x[j]))
        _bond(molecule, first, bonds, angles, torsions)
        inside = [(0, 1), (0, 2), (1, 2)] if not molecule.bonds and len(molecule.x) == 3 else molecule.bonds
        all_bonds += [(first + i, first + j) for i, j in inside]
    nonbonded.createExceptionsFromBonds(all_bonds, 0.83, 0.5)
    if box:
        nonbonded.setNonbondedMethod(openmm.NonbondedForce.PME)
        nonbonded.setCutoffDistance(0.45 * box)
        system.setDefaultPeriodicBoxVectors(*(box * np.eye(3)))
    for force in (bonds, angles, torsions, nonbonded):
        system.addForce(force)
    return system, displaced(np.vstack(positions), system)


def _bond(molecule, first, bonds, angles, torsions):
    """Springs at their minimum; none for what constraints hold."""
    x, constrained = molecule.x, {frozenset(pair) for pair in molecule.held}
    for i, j in molecule.bonds:
        if frozenset((i, j)) not in constrained:
            strength = WITH_HYDROGEN if "H" in (molecule.elements[i], molecule.elements[j]) else HEAVY
            bonds.addBond(first + i, first + j, np.linalg.norm(x[i] - x[j]), strength)
    for one, other in combinations(molecule.bonds, 2):
        for middle in set(one) & set(other):
            i, k = (set(one) | set(other)) - {middle}
            if frozenset((i, k)) not in constrained:
                a, b = x[i] - x[middle], x[k] - x[middle]
                angle = np.arccos(a @ b / np.linalg.norm(a) / np.linalg.norm(b))
                angles.addAngle(first + i, first + middle, first + k, angle, BENDING)
    for atoms in molecule.torsions:
        torsions.addTorsion(*(first + i for i in atoms), 3, 0.0, 5.0)
