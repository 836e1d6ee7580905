"""Small molecules with redundant, exact or missing constraints."""

from itertools import combinations
from typing import NamedTuple

import numpy as np
import openmm

from tests.support.molecules import TETRAHEDRON
from tests.support.starts import displaced
from tests.support.systems import assembled

FORMATE = np.array([[0, 0, 0], [0.11, 0, 0], [-0.06, 0.11, 0], [-0.06, -0.11, 0]])
RING = np.array([[np.cos(a), np.sin(a), 0.0] for a in np.pi / 3 * np.arange(6)])
OH, HOH = 0.09572, np.radians(104.52)


class ConstrainedMolecule(NamedTuple):
    """A molecule.

    Attributes:
        masses: (k,), dalton.
        places: (k, 3), nm.
        pairs: constrained pairs of atoms.
    """

    masses: list
    places: np.ndarray
    pairs: list

    def without(self, *pairs):
        return self._replace(pairs=[pair for pair in self.pairs if pair not in pairs])

    def ordered(self, order):
        """The same molecule with its atoms in another order."""
        pairs = [tuple(sorted((order.index(i), order.index(j)))) for i, j in self.pairs]
        return ConstrainedMolecule([self.masses[i] for i in order], self.places[list(order)], pairs)

    def constraints(self, first=0):
        lengths = [float(np.linalg.norm(self.places[i] - self.places[j])) for i, j in self.pairs]
        return [(first + i, first + j, length) for (i, j), length in zip(self.pairs, lengths, strict=True)]


def complete(masses, places):
    return ConstrainedMolecule(list(masses), np.array(places, dtype=float), list(combinations(range(len(masses)), 2)))


def triangle(masses, angle=HOH, arm=OH):
    """Atoms 1 and 2 at equal distances from atom 0."""
    x, y = arm * np.sin(angle / 2), arm * np.cos(angle / 2)
    return complete(masses, [[0, 0, 0], [x, y, 0], [-x, y, 0]])


def methane():
    return complete([12.0, 1.0, 1.0, 1.0, 1.0], TETRAHEDRON)


def formate():
    return complete([12.0, 1.0, 16.0, 16.0], FORMATE)


def benzene():
    return complete(6 * [12.0] + 6 * [1.0], np.concatenate([0.1397 * RING, 0.248 * RING]))


def gas(molecule, edge=2, spacing=0.6):
    """System and positions of edge^3 such molecules with Lennard-Jones atoms, each turned by another angle."""
    k, n = len(molecule.masses), edge**3
    force, positions, constraints = openmm.NonbondedForce(), [], []
    for number in range(n):
        for _ in range(k):
            force.addParticle(0.0, 0.3, 0.3)
        for i, j in combinations(range(k), 2):
            force.addException(number * k + i, number * k + j, 0, 1, 0)
        constraints += molecule.constraints(number * k)
        cosine, sine = np.cos(number), np.sin(number)
        turn = np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])
        positions.append(molecule.places @ turn + spacing * np.array(np.unravel_index(number, 3 * (edge,))))
    system = assembled(n * molecule.masses, force, constraints=constraints)
    return system, displaced(np.concatenate(positions), system)
