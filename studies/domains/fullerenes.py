"""Crystals of C60 with rotating molecules: Lennard-Jones atoms with Girifalco's parameters.

The interactions are those of L. A. Girifalco, J. Phys. Chem. 96, 858 (1992). The crystal is
cubic and face-centred, with a lattice constant of 1.417 nm at room temperature (W. I. F. David et al., Europhys. Lett.
18, 219 (1992)).
"""

from __future__ import annotations

import itertools
import math

import numpy as np

from studies.domains.models import Model, contacts, of_molecules

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
    edge = cells * LATTICE
    force = contacts(min(cutoff, 0.49 * edge), min(switch, 0.43 * edge))
    random = np.random.default_rng(1)
    faces = 0.5 * np.array([[0, 0, 0], [0, 1, 1], [1, 0, 1], [1, 1, 0]])
    molecules = [
        buckminsterfullerene() @ rotation(random) + LATTICE * (np.array(cell) + corner)
        for cell, corner in itertools.product(itertools.product(range(cells), repeat=3), faces)
    ]
    return of_molecules("C60", force, molecules, CARBON, (SIGMA, EPSILON), edge)


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
