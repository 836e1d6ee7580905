import pytest

from tests.support import molecules


@pytest.fixture
def mixture(rng):
    """Several bodies of every kind, their atoms out of order among free particles, and forces on all of these."""
    bodies = molecules.scattered(molecules.GEOMETRIES, each=40)
    state = molecules.thermal_state(rng, bodies, rng.normal(size=(3, bodies.n)))
    return bodies, state, 1000 * rng.normal(size=(bodies.n_particles, 3))
