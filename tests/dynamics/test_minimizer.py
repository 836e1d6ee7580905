"""Minimization of rigid bodies."""

from itertools import islice, pairwise

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from openmm_sier.dynamics.minimizer import LARGEST_DISPLACEMENT, descent
from tests.support.molecules import CARBON_DIOXIDE, ION, METHANE, WATER, SoftCluster, thermal_state
from tests.support.oracles import orthogonality_error

KINDS = [WATER, METHANE, CARBON_DIOXIDE, ION, WATER]


@pytest.fixture
def cluster(rng):
    result = SoftCluster(KINDS)
    return result, thermal_state(rng, result.bodies, rng.uniform(-0.3, 0.3, (3, result.bodies.n)))


def settled(cluster, state, iterations):
    return list(islice(descent(cluster.bodies, cluster.forces, state.q, state.A), iterations))


def energy_at(cluster, state, q, A):
    return cluster.potential_energy(type(state)(q, state.p, A, state.L))


@pytest.mark.thorough
def test_it_ends_at_a_minimum(cluster):
    """Another minimizer, in rotation vectors about the attitudes found, finds no lower energy nearby."""
    results, state = cluster
    last = next(point for point in settled(results, state, 1000) if point.rms < 1)
    assert orthogonality_error(last.A) < 1e-12
    lowest = energy_at(results, state, last.q, last.A)
    n = results.bodies.n

    def energy(x):
        q, turns = last.q + x[: 3 * n].reshape(3, n), Rotation.from_rotvec(x[3 * n :].reshape(n, 3)).as_matrix()
        return energy_at(results, state, q, np.einsum("ayn,nxy->axn", last.A, turns))

    rng = np.random.default_rng(3)
    for _ in range(3):
        again = minimize(energy, rng.normal(scale=1e-3, size=6 * n), method="BFGS")
        # Forces of 1 kJ/mol/nm on 27 freedoms, the softest of some 10 kJ/mol/nm^2, are 27/20 kJ/mol above a minimum.
        assert lowest - 1.35 < again.fun < lowest


def test_no_body_is_thrown(cluster):
    """Bodies on one another feel any force; each goes at most by LARGEST_DISPLACEMENT, and they come apart."""
    results, state = cluster
    q = state.q.copy()
    q[:, 1:] = q[:, :1] + 1e-4 * state.q[:, 1:]
    crowded = type(state)(q, state.p, state.A, state.L)
    points = settled(results, crowded, 300)
    for one, other in pairwise(points):
        assert np.linalg.norm(other.q - one.q, axis=0).max() <= LARGEST_DISPLACEMENT * (1 + 1e-12)
    energies = [energy_at(results, state, point.q, point.A) for point in points]
    assert energies[-1] < energies[0] - 50
