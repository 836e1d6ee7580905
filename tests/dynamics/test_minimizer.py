"""Minimization of rigid bodies."""

from itertools import islice, pairwise

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from openmm_sier.dynamics.minimizer import LARGEST_DISPLACEMENT, descent
from tests.support.molecules import CARBON_DIOXIDE, ION, METHANE, WATER, SoftCluster, scattered, thermal_state
from tests.support.oracles import orthogonality_error

KINDS = [WATER, METHANE, CARBON_DIOXIDE, ION, WATER]


@pytest.fixture
def cluster(rng):
    found = SoftCluster(KINDS)
    return found, thermal_state(rng, found.bodies, rng.uniform(-0.3, 0.3, (3, found.bodies.n)))


def settled(cluster, state, iterations):
    return list(islice(descent(cluster.bodies, cluster.forces, state.q, state.A), iterations))


def energy_at(cluster, state, q, A):
    return cluster.potential_energy(type(state)(q, state.p, A, state.L))


@pytest.mark.slow
def test_it_ends_at_a_minimum(cluster):
    """Another minimizer, in rotation vectors about the attitudes found, finds no lower energy nearby."""
    found, state = cluster
    last = next(point for point in settled(found, state, 1000) if point.rms < 1)
    assert orthogonality_error(last.A) < 1e-12
    lowest = energy_at(found, state, last.q, last.A)
    n = found.bodies.n

    def energy(x):
        q, turns = last.q + x[: 3 * n].reshape(3, n), Rotation.from_rotvec(x[3 * n :].reshape(n, 3)).as_matrix()
        return energy_at(found, state, q, np.einsum("ayn,nxy->axn", last.A, turns))

    rng = np.random.default_rng(3)
    for _ in range(3):
        again = minimize(energy, rng.normal(scale=1e-3, size=6 * n), method="BFGS")
        # Forces of 1 kJ/mol/nm on 27 freedoms, the softest of some 10 kJ/mol/nm^2, are 27/20 kJ/mol above a minimum.
        assert lowest - 1.35 < again.fun < lowest


def test_dipoles_in_a_field_turn_to_it(rng):
    """Each in a harmonic trap: the centres go to the origin, and the principal axis of the dipole along the field."""
    bodies = scattered([WATER, METHANE], each=3, n_free=0)
    field = np.array([30.0, -20.0, 10.0])

    def forces(q, A):
        return -500 * q, np.cross(A[2].T, field).T

    start = thermal_state(rng, bodies, rng.uniform(-0.5, 0.5, (3, bodies.n)))
    last = next(point for point in islice(descent(bodies, forces, start.q, start.A), 2000) if point.rms < 1e-7)
    # Forces of 1e-7 kJ/mol/nm, on six bodies of six freedoms each.
    assert np.abs(last.q).max() < 6e-7 / 500
    assert np.abs(last.A[2] - (field / np.linalg.norm(field))[:, None]).max() < 1e-7
    assert orthogonality_error(last.A) < 1e-12


def test_forces_are_measured_as_those_on_the_degrees_of_freedom(cluster):
    found, state = cluster
    first = next(descent(found.bodies, found.forces, state.q, state.A))
    F, tau = found.forces(state.q, state.A)
    squares = (F**2).sum()
    for species, part in zip(found.bodies.species, found.bodies.parts, strict=True):
        if species.moments.any():
            # The mean square distance of the atoms from the centre.
            gyration = (species.masses * (species.sites**2).sum(axis=0)).sum() / species.mass
            squares += (tau[:, part] ** 2).sum() / gyration
    assert first.q is state.q
    assert first.rms == pytest.approx(np.sqrt(squares / found.bodies.dof), rel=1e-12)


def test_no_body_is_thrown(cluster):
    """Bodies on one another feel any force; each goes at most by LARGEST_DISPLACEMENT, and they come apart."""
    found, state = cluster
    q = state.q.copy()
    q[:, 1:] = q[:, :1] + 1e-4 * state.q[:, 1:]
    crowded = type(state)(q, state.p, state.A, state.L)
    points = settled(found, crowded, 300)
    for one, other in pairwise(points):
        assert np.linalg.norm(other.q - one.q, axis=0).max() <= LARGEST_DISPLACEMENT * (1 + 1e-12)
    energies = [energy_at(found, state, point.q, point.A) for point in points]
    assert energies[-1] < energies[0] - 50


def test_bodies_without_forces_stay():
    found = SoftCluster([ION])
    start = np.zeros((3, 1)), np.eye(3)[:, :, None]
    points = list(islice(descent(found.bodies, lambda q, A: (0 * q, 0 * q), *start), 3))
    assert [point.rms for point in points] == [0.0] * 3
    assert all(point.q is start[0] for point in points)
