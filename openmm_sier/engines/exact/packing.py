"""Body states as per-atom variables, so that OpenMM's checkpoints and States carry them bit for bit.

A body's position, momentum and angular momentum are the variables of its first atom, and the rows of its attitude those
of its second.
"""

from __future__ import annotations

import numpy as np

from openmm_sier.dynamics.bodies import BodyState, RigidBodies


def pack(bodies: RigidBodies, state: BodyState) -> np.ndarray:
    """The numbers (q, p, L, A) of all bodies, shape (3, N, 3): three vectors for each atom, zero for other atoms."""
    values = np.zeros((3, bodies.n_particles, 3))
    vectors = np.stack([state.q, state.p, state.L]).transpose(0, 2, 1), state.A.transpose(0, 2, 1)
    for species, part in zip(bodies.species, bodies.parts, strict=True):
        for atoms, some in zip(species.atoms.T, vectors, strict=False):
            values[:, atoms] = some[:, part]
    return values


def unpack(bodies: RigidBodies, values: np.ndarray) -> BodyState:
    """The state that `pack` stored, with identity attitudes for point bodies.

    Args:
        bodies: the bodies it was packed for.
        values: shape (3, N, 3).
    """
    found = np.zeros((3, 3, bodies.n)), np.repeat(np.eye(3)[:, :, None], bodies.n, axis=2)
    for species, part in zip(bodies.species, bodies.parts, strict=True):
        for atoms, vectors in zip(species.atoms.T, found, strict=False):
            vectors[:, :, part] = values[:, atoms].transpose(0, 2, 1)
    (q, p, L), A = found
    return BodyState(q, p, A, L)


def sites(bodies: RigidBodies) -> np.ndarray:
    """The atoms' places in the principal frames of their bodies, (N, 3), nm; zero for particles of no body."""
    values = np.zeros((bodies.n_particles, 3))
    for species in bodies.species:
        values[species.atoms] = species.sites.T
    return values
