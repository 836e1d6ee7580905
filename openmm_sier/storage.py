"""Body states as per-atom variables, so that OpenMM's checkpoints and States carry them bit for bit."""

from __future__ import annotations

import numpy as np

from openmm_sier.bodies import BodyState, RigidBodies

#: Per-atom vectors that hold the six vectors of a body of two or more atoms.
VARIABLES = 3


def pack(bodies: RigidBodies, state: BodyState) -> np.ndarray:
    """The numbers (q, p, A, L) of all bodies, spread over their atoms.

    Returns:
        Shape (VARIABLES, N, 3); zero for particles of no body.
    """
    values = np.zeros((VARIABLES, bodies.n_particles, 3))
    for species, part in zip(bodies.species, bodies.parts, strict=True):
        for (variable, column), vectors in zip(_places(species), _vectors(state), strict=False):
            values[variable, column] = vectors[:, part].T
    return values


def unpack(bodies: RigidBodies, values: np.ndarray) -> BodyState:
    """The state that `pack` stored, with identity attitudes for point bodies.

    Args:
        bodies: the bodies it was packed for.
        values: shape (VARIABLES, N, 3).
    """
    q, p, L = np.zeros((3, 3, bodies.n))
    state = BodyState(q, p, np.repeat(np.eye(3)[:, :, None], bodies.n, axis=2), L)
    for species, part in zip(bodies.species, bodies.parts, strict=True):
        for (variable, column), vectors in zip(_places(species), _vectors(state), strict=False):
            vectors[:, part] = values[variable, column].T
    return state


def sites(bodies: RigidBodies) -> np.ndarray:
    """The atoms' places in the principal frames of their bodies, (N, 3), nm; zero for particles of no body."""
    values = np.zeros((bodies.n_particles, 3))
    for species in bodies.species:
        values[species.atoms] = species.sites.T
    return values


def _vectors(state: BodyState):
    """What is stored of a state, in its order."""
    return state.q, state.p, state.L, *state.A


def _places(species) -> list[tuple]:
    """Where the vectors of a species' bodies go: variable and atoms."""
    if len(species.columns) == 1:
        # A point body's attitude means nothing, and it has no angular momentum.
        return [(variable, species.columns[0]) for variable in range(2)]
    return [(variable, column) for variable in range(VARIABLES) for column in species.columns]
