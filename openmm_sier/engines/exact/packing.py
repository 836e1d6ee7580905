"""Body states as per-atom variables, so that OpenMM's checkpoints and States carry them bit for bit.

The numbers of the bodies follow one another, kind by kind, without regard to whose atoms the variables are. So each is
copied once.
"""

from collections.abc import Iterator

import numpy as np

from openmm_sier.dynamics.bodies import BodyState, RigidBodies


def pack(bodies: RigidBodies, state: BodyState) -> np.ndarray:
    """The numbers (q, p, L, A) of all bodies, shape (3, N, 3): three vectors for each atom; zero beyond them."""
    values = np.zeros((3, bodies.n_particles, 3))
    for packed, vectors in _places(bodies, values, state):
        packed[:] = vectors
    return values


def unpack(bodies: RigidBodies, values: np.ndarray) -> BodyState:
    """The state that `pack` stored, with identity attitudes for point bodies.

    Args:
        bodies: the bodies it was packed for.
        values: shape (3, N, 3).
    """
    q, p, L = np.zeros((3, 3, bodies.n))
    state = BodyState(q, p, np.repeat(np.eye(3)[:, :, None], bodies.n, axis=2), L)
    for packed, vectors in _places(bodies, values, state):
        vectors[:] = packed
    return state


def _places(bodies: RigidBodies, values: np.ndarray, state: BodyState) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Views of equal shape: where numbers are stored, and the part of the state that they are."""
    flat, start = values.reshape(-1), 0
    for species, part in zip(bodies.species, bodies.parts, strict=True):
        is_point = species.atoms.shape[1] == 1
        # Of a point there is room for six numbers, and it has no more.
        for vectors in (state.q, state.p) if is_point else (state.q, state.p, state.L, state.A):
            own = vectors[..., part]
            yield flat[start : start + own.size].reshape(own.shape), own
            start += own.size


def sites(bodies: RigidBodies) -> np.ndarray:
    """The atoms' places in the principal frames of their bodies, (N, 3), nm; zero for particles of no body."""
    values = np.zeros((bodies.n_particles, 3))
    for species in bodies.species:
        values[species.atoms] = species.sites.T
    return values
