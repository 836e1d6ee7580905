"""Positions that are not quite those of the bodies: molecules that are recognized are mended, others refused."""

import numpy as np
import openmm
import pytest

from openmm_sier import RigidBodies, RigidityError, SIERIntegrator
from openmm_sier.dynamics.species import FIT_FRACTION, FIT_TOLERANCE, Species
from tests.support.oracles import random_attitudes
from tests.support.silence import silence
from tests.support.systems import assembled, field
from tests.support.waters import cluster_system, context_at, phase_point, platform

#: O-H in nm and H-O-H in degrees: water models of OpenMM's force fields, and hydrogens as crystallographers place them.
WATERS = {
    "TIP3P": (0.09572, 104.52),
    "SPC/E": (0.1, 109.47),
    "OPC": (0.08724, 103.6),
    "OPC3": (0.09789, 109.47),
    "TIP3P-FB": (0.10118, 108.15),
    "crystal": (0.084, 107.0),
}
MASSES = np.array([15.999, 1.008, 1.008])


def water(model):
    length, angle = WATERS[model]
    half = np.radians(angle / 2)
    return length * np.array([[0, 0, 0], [np.sin(half), np.cos(half), 0], [-np.sin(half), np.cos(half), 0]])


def turned_at_random(shape, rng, n):
    """Positions (n k, 3) of n molecules of a shape (k, 3), each turned, 1 nm apart."""
    attitudes = random_attitudes(rng, n)
    places = np.einsum("axm,ka->mkx", attitudes, shape) + np.arange(n)[:, None, None] * np.array([1.0, 0, 0])
    return places.reshape(-1, 3)


def waters_of(model, n, labels=None):
    atoms = np.arange(3 * n).reshape(n, 3)
    return RigidBodies([Species.from_coordinates(atoms, MASSES, water(model))], 3 * n, labels)


@pytest.mark.parametrize("found", WATERS)
@pytest.mark.parametrize("model", WATERS)
def test_any_water_is_taken_for_water(model, found, rng):
    bodies, x = waters_of(model, 5), turned_at_random(water(found), rng, 5)
    q, A, misfit = bodies.fit_with_misfit(x)
    assert misfit.max() < FIT_TOLERANCE
    mended = bodies.place(q, A, np.empty_like(x))
    # Atoms go no further than the fit said, the centres of mass nowhere, and oxygens, 16 times heavier, hardly.
    assert np.abs(np.linalg.norm(mended - x, axis=1).reshape(5, 3).max(axis=1) - misfit).max() < 1e-15
    # 18 dalton times the rounding of positions of 4 nm, 9e-16.
    assert np.abs((mended - x).reshape(5, 3, 3).transpose(0, 2, 1) @ MASSES).max() < 1e-13
    assert np.linalg.norm((mended - x)[::3], axis=1).max() < FIT_TOLERANCE / 7


def test_a_box_of_another_water_model_is_corrected_with_one_warning():
    """1490 waters came from a PDB file of another model, and OpenMM's own integrators pull such in."""
    _, positions, _ = cluster_system(6, "spce")
    topology, _, system = cluster_system(6, "tip3p")
    integrator = SIERIntegrator(0.001, "SIER2", bodies=RigidBodies.from_system(system, topology))
    context = context_at(system, integrator, (positions, 0 * positions))
    with pytest.warns(UserWarning, match="6 of 6 bodies") as caught:
        integrator.step(1)
    assert len(caught) == 1
    assert caught[0].filename == __file__
    # Half the difference of H-H is 0.006 nm.
    assert "by up to 0.006" in str(caught[0].message)
    assert "residue HOH" in str(caught[0].message)
    moved = phase_point(context)[0].reshape(6, 3, 3)
    for i, j, length in ((0, 1, 0.09572), (0, 2, 0.09572), (1, 2, 0.15139)):
        assert np.abs(np.linalg.norm(moved[:, i] - moved[:, j], axis=1) - length).max() < 1e-5
    with silence():
        context.setPositions(positions)
        integrator.step(1)


def test_rounding_draws_no_warning():
    _, positions, system = cluster_system(6)
    integrator = SIERIntegrator(0.001, "SIER2")
    context = context_at(system, integrator, (np.round(positions, 4), 0 * positions))
    with silence():
        integrator.step(1)
    assert context.getStepCount() == 1


def test_exchanged_atoms_are_refused(rng):
    """Atoms in another order than the System's: an oxygen where a hydrogen is to be is 0.08 nm off its place."""
    bodies, x = waters_of("TIP3P", 3), turned_at_random(water("TIP3P"), rng, 3)
    with pytest.raises(RigidityError, match=r"atoms 3, 4, 5 .*1 of 3 bodies"):
        bodies.fit(x[[0, 1, 2, 4, 3, 5, 6, 7, 8]])


def test_small_bodies_are_recognized_within_a_fraction_of_their_distances(rng):
    """Sites 0.02 nm apart: 0.01 nm off its place an atom might be taken for its neighbour."""
    small = Species.from_coordinates([[0, 1]], [1.0, 1.0], [[0, 0, 0], [0.02, 0, 0]])
    assert small.tolerance == pytest.approx(FIT_FRACTION * 0.02, rel=1e-12)
    assert waters_of("TIP3P", 1).species[0].tolerance == FIT_TOLERANCE
    # Two particles at one place are not to be told apart, and a point has no place to miss.
    assert Species.from_coordinates([[0, 1]], [1.0, 1.0], np.zeros((2, 3))).tolerance == FIT_TOLERANCE
    with pytest.raises(RigidityError, match=r"0\.005 nm"):
        RigidBodies([small], 2).fit(np.array([[0, 0, 0], [0.032, 0, 0]]))


# --- positions that were never set ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["Reference", "CPU"])
@pytest.mark.parametrize("n", [1, 3])
def test_points_may_all_be_at_the_origin(n, name):
    """OpenMM itself knows whether positions were set."""
    system = assembled(n * [20.0], field("-x", range(n)))
    integrator = SIERIntegrator(0.001, "SIER2")
    context = openmm.Context(system, integrator, platform(name))
    for ask in (lambda: integrator.step(1), integrator.getBodyState, integrator.computeSystemTemperature):
        with pytest.raises(openmm.OpenMMException, match="Particle positions have not been set"):
            ask()
    context.setPositions(np.zeros((n, 3)))
    integrator.step(2)
    # Two steps at an acceleration of 1/20.
    assert np.allclose(phase_point(context)[0], [0.5 / 20 * 0.002**2, 0, 0], rtol=1e-6, atol=0)
