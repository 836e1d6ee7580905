"""Body states as per-atom variables, so that OpenMM's checkpoints and States carry them bit for bit."""

from __future__ import annotations

import numpy as np

from openmm_sier.bodies import BodyState, RigidBodies

#: Per-atom vectors that hold the 18 numbers of a body of two or more atoms. A point has 6: its attitude means nothing.
VARIABLES = 3


def pack(bodies: RigidBodies, state: BodyState) -> np.ndarray:
    """The numbers (q, p, A, L) of all bodies, spread over their atoms.

    Returns:
        Shape (VARIABLES, N, 3); zero for particles of no body.
    """
    values = np.zeros((VARIABLES, bodies.n_particles, 3))
    everything = np.concatenate([state.q, state.p, state.L, state.A.reshape(9, -1)])
    for species, part in zip(bodies.species, bodies.parts, strict=True):
        m, k = species.atoms.shape
        block = np.zeros((VARIABLES * 3 * k, m))
        rows = _rows(k)
        block[:rows] = everything[:rows, part]
        values[:, species.atoms] = block.reshape(VARIABLES, k, 3, m).transpose(0, 3, 1, 2)
    return values


def unpack(bodies: RigidBodies, values: np.ndarray) -> BodyState:
    """The state that `pack` stored, with identity attitudes for point bodies.

    Args:
        bodies: the bodies it was packed for.
        values: shape (VARIABLES, N, 3).
    """
    everything = np.zeros((18, bodies.n))
    everything[9:] = np.eye(3).reshape(9, 1)
    for species, part in zip(bodies.species, bodies.parts, strict=True):
        m, k = species.atoms.shape
        rows = _rows(k)
        everything[:rows, part] = values[:, species.atoms].transpose(0, 2, 3, 1).reshape(-1, m)[:rows]
    q, p, L = everything[0:3], everything[3:6], everything[6:9]
    return BodyState(q.copy(), p.copy(), everything[9:].reshape(3, 3, -1).copy(), L.copy())


def sites(bodies: RigidBodies) -> np.ndarray:
    """The atoms' places in the principal frames of their bodies, (N, 3), nm; zero for particles of no body."""
    values = np.zeros((bodies.n_particles, 3))
    for species in bodies.species:
        values[species.atoms] = species.sites.T
    return values


def _rows(n_atoms: int) -> int:
    return 18 if n_atoms > 1 else 6
