"""Body states as per-atom variables, so that OpenMM's checkpoints and States carry them bit for bit."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from openmm_sier.dynamics.bodies import BodyState, RigidBodies

#: Number of per-atom vectors that hold the numbers of all bodies, 18 for a body of two or more atoms and 6 for a point.
VARIABLES = 3


def pack(bodies: RigidBodies, state: BodyState) -> np.ndarray:
    """The numbers (q, p, L, A) of all bodies, one after the other.

    Returns:
        Shape (VARIABLES, N, 3); zero beyond those numbers.
    """
    values = np.zeros((VARIABLES, bodies.n_particles, 3))
    for place, vectors in _places(bodies, state, values):
        place[:] = vectors
    return values


def unpack(bodies: RigidBodies, values: np.ndarray) -> BodyState:
    """The state that `pack` stored, with identity attitudes for point bodies.

    Args:
        bodies: the bodies it was packed for.
        values: shape (VARIABLES, N, 3).
    """
    q, p, L = np.zeros((3, 3, bodies.n))
    state = BodyState(q, p, np.repeat(np.eye(3)[:, :, None], bodies.n, axis=2), L)
    for place, vectors in _places(bodies, state, values):
        vectors[:] = place
    return state


def sites(bodies: RigidBodies) -> np.ndarray:
    """The atoms' places in the principal frames of their bodies, (N, 3), nm; zero for particles of no body."""
    values = np.zeros((bodies.n_particles, 3))
    for species in bodies.species:
        values[species.atoms] = species.sites.T
    return values


def _places(bodies: RigidBodies, state: BodyState, values: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pairs of views of equal shape: where numbers are stored, and the part of the state that they are."""
    flat, start = values.reshape(-1), 0
    for species, part in zip(bodies.species, bodies.parts, strict=True):
        vectors = [state.q[:, part], state.p[:, part]]
        # A point body's attitude means nothing, and it has no angular momentum.
        if species.atoms.shape[1] > 1:
            vectors += [state.L[:, part], state.A[:, :, part]]
        for some in vectors:
            yield flat[start : start + some.size].reshape(some.shape), some
            start += some.size
