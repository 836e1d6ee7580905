"""A System that is neither harmonic nor free, whose canonical averages are known exactly.

Rigid dipoles turn in a field, with the function of Langevin. Atoms are in wells of fourth order, whose energies have a
gamma distribution.
"""

import math

import numpy as np
import openmm

from openmm_sier.dynamics.constants import GAS_CONSTANT
from tests.support.systems import assembled

TEMPERATURE = 300.0
KT = GAS_CONSTANT * TEMPERATURE

#: Numbers of dipoles and of other atoms.
DIPOLES, ATOMS = 4, 8

#: Places of the atoms of a dipole, nm, and their masses, Da. The dipole is from the third atom to the second.
SITES = np.array([[0.0, 0.0, 0.0], [0.02, 0.0, 0.09], [0.0, 0.09, -0.06]])
MASSES = (16.0, 4.0, 6.0)
LENGTH = math.dist(SITES[1], SITES[2])

#: Of a dipole in the field over kT, and of the wells, kJ/mol/nm^4.
FIELD, WELL = 3.0, 2e5


def system(*others, well_group=0):
    """The System; its wells are in a force group, and other Forces may be there."""
    pull = openmm.CustomExternalForce(f"{-FIELD * KT / LENGTH!r}*charge*z")
    pull.addPerParticleParameter("charge")
    wells = openmm.CustomExternalForce(f"{WELL!r}*(x^4 + y^4 + z^4)")
    wells.setForceGroup(well_group)
    for first in range(0, 3 * DIPOLES, 3):
        pull.addParticle(first + 1, [1.0])
        pull.addParticle(first + 2, [-1.0])
    for atom in range(ATOMS):
        wells.addParticle(3 * DIPOLES + atom)
    restraints = [
        (first + i, first + j, np.linalg.norm(SITES[i] - SITES[j]))
        for first in range(0, 3 * DIPOLES, 3)
        for i, j in ((0, 1), (0, 2), (1, 2))
    ]
    return assembled(DIPOLES * MASSES + ATOMS * (1.0,), pull, wells, *others, constraints=restraints)


def positions():
    """Positions to begin with, (N, 3), nm."""
    dipoles = np.concatenate([SITES + np.array([i, 0, 0]) for i in range(DIPOLES)])
    return np.concatenate([dipoles, np.zeros((ATOMS, 3))])


#: Exact averages of `observed`.
EXACT = np.array([1 / math.tanh(FIELD) - 1 / FIELD, 1 / 4, 5 / 16, 1.0, 0.0])


def observed(x, v):
    """Means over the bodies of one sample: cosine; energy of a well over kT, and its square; kinetic energy of an atom
    in units of kT/2; product of place and velocity of an atom."""
    cosines = (x[1 : 3 * DIPOLES : 3, 2] - x[2 : 3 * DIPOLES : 3, 2]) / LENGTH
    q, p = x[3 * DIPOLES :], v[3 * DIPOLES :]
    wells = WELL * q**4 / KT
    width = (KT / WELL) ** 0.25
    return cosines.mean(), wells.mean(), (wells**2).mean(), (p**2).mean() / KT, (q * p).mean() / width / KT**0.5


def distances(rows, blocks=25):
    """Differences of means of rows of `observed` from the exact ones in standard errors, which are those of blocks."""
    means = np.array(rows)[: len(rows) // blocks * blocks].reshape(blocks, -1, len(EXACT)).mean(axis=1)
    return (means.mean(axis=0) - EXACT) / (means.std(axis=0, ddof=1) / blocks**0.5)
