"""The water molecule of the paper's experiments: TIP4P as published in 1983."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from openmm_sier.dynamics.bodies import BodySet, BodyState
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.species import Species

#: W. L. Jorgensen, J. Chandrasekhar, J. D. Madura, R. W. Impey and M. L. Klein, J. Chem. Phys. 79, 926 (1983), Table I:
#: r(OH) = 0.9572 A, HOH = 104.52 deg, q(H) = 0.52 e, A = 600e3 kcal A^12/mol, C = 610 kcal A^6/mol.
R_OH = 0.09572
ANGLE = math.radians(104.52)
CHARGE = 0.52
SIGMA = 0.1 * (600e3 / 610) ** (1 / 6)
EPSILON = 4.184 * 610**2 / (4 * 600e3)

#: Masses of O, H, H as in OpenMM's force fields, dalton.
MASSES = (15.99943, 1.007947, 1.007947)

#: Positions of O, H, H in a frame whose y axis is the bisector, nm.
GEOMETRY = np.array(
    [
        [0.0, 0.0, 0.0],
        [R_OH * math.sin(ANGLE / 2), R_OH * math.cos(ANGLE / 2), 0.0],
        [-R_OH * math.sin(ANGLE / 2), R_OH * math.cos(ANGLE / 2), 0.0],
    ]
)


def molecules(n: int) -> BodySet:
    """Rigid bodies for n molecules of three massive sites each."""
    return BodySet([Species.from_coordinates(np.arange(3 * n).reshape(n, 3), MASSES, GEOMETRY)], 3 * n)


def dipole_direction(bodies: BodySet) -> np.ndarray:
    """Unit vector from the oxygen to the hydrogens in the principal frame, (3,)."""
    sites = bodies.species[0].sites
    axis = sites[:, 1] + sites[:, 2] - 2 * sites[:, 0]
    return axis / np.linalg.norm(axis)


def canonical_rotation(bodies: BodySet, temperature: float, rng: np.random.Generator) -> BodyState:
    """Molecules at rest at the origin that turn as in a gas: uniform attitudes, Maxwell-distributed angular momenta.

    Args:
        bodies: what `molecules` gives.
        temperature: K.
        rng: numpy.random.Generator.
    """
    A = np.moveaxis(Rotation.random(bodies.n, random_state=rng).as_matrix(), 0, 2)
    body_L = rng.normal(size=(3, bodies.n)) * np.sqrt(bodies.moments * GAS_CONSTANT * temperature)
    L = A[0] * body_L[0] + A[1] * body_L[1] + A[2] * body_L[2]
    return BodyState(np.zeros((3, bodies.n)), np.zeros((3, bodies.n)), A, L)
