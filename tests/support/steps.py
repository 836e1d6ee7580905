"""Steps of bodies of every kind, for the tests of kernels and threads."""

from dataclasses import replace

from tests.support import molecules


def every_kind(rng, each=40):
    """Several bodies of every kind, their atoms out of order among free particles, and forces on all of these."""
    bodies = molecules.scattered(molecules.GEOMETRIES, each)
    state = molecules.thermal_state(rng, bodies, rng.normal(size=(3, bodies.n)))
    return bodies, state, 1000 * rng.normal(size=(bodies.n_particles, 3))


def with_a_fast_body(bodies, state):
    """The state with a body at rest and one that spins too fast for the series."""
    L, slow = state.L.copy(), bodies.columns[1].start
    L[:, slow], L[:, slow + 1] = 0.0, 100 * L[:, slow + 1]
    return replace(state, L=L)


def constant_torques(bodies, forces):
    """Forces that hold the bodies near the origin, and torques of atom forces, none on the body at rest."""

    def forces_at(q, A):
        F, tau = bodies.forces_and_torques(forces, A)
        tau[:, bodies.columns[1].start] = 0.0
        return F - 100.0 * q, tau

    return forces_at
