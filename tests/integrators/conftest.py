"""Water that tests of several modules start from; they change no System but copies of it."""

import pytest

from tests.support.waters import cluster_system, periodic_system, relaxed


def settled(topology, positions, system):
    """Topology, System, and positions and velocities (N, 3) near 297 K."""
    return topology, system, relaxed(topology, positions, system)


@pytest.fixture(scope="session")
def cluster():
    """Eight molecules without a cut-off."""
    return settled(*cluster_system(8))


@pytest.fixture(scope="session")
def box():
    """59 molecules in a periodic box."""
    return settled(*periodic_system())
