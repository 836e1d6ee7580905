"""Liquid benzene of rigid rings: six united atoms, which Lennard-Jones potentials let interact.

The parameters are those of W. L. Jorgensen, J. D. Madura and C. J. Swenson, J. Am. Chem. Soc. 106, 6638 (1984), with
sides of 0.14 nm.
"""

from __future__ import annotations

import itertools

import numpy as np

from studies.domains.fullerenes import rotation
from studies.domains.models import Model, contacts, of_molecules

#: Dalton of a united atom, nm of a side, which is the radius too, and Lennard-Jones in nm and kJ/mol.
MASS, SIDE, SIGMA, EPSILON = 13.019, 0.14, 0.375, 0.4602

#: Rings in nm^3, of the liquid at 298 K.
DENSITY = 6.74

#: nm, of the interactions and of the distance from which they are switched off.
CUTOFF, SWITCH = 1.2, 1.0


def model(edge: int = 6) -> Model:
    """`edge`^3 rings at 300 K and constant volume."""
    force = contacts(CUTOFF, SWITCH)
    force.setUseDispersionCorrection(False)
    angles = np.arange(6) * np.pi / 3
    ring = SIDE * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(6)])
    spacing = DENSITY ** (-1 / 3)
    random = np.random.default_rng(1)
    corners = itertools.product(range(edge), repeat=3)
    molecules = [spacing * np.array(corner) + ring @ rotation(random) for corner in corners]
    return of_molecules("rings", force, molecules, MASS, (SIGMA, EPSILON), edge * spacing)
