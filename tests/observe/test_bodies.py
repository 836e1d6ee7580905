"""Observables of single bodies: orientations, forces, torques, kinetic energies by axis, and trajectories of them."""

import numpy as np
import openmm
import pytest
from openmm import app
from scipy.spatial.transform import Rotation

from openmm_sier import RigidBodies, SIERIntegrator
from openmm_sier.observe.gsd_reporter import GSDReporter
from openmm_sier.observe.reporters import BodyStateReporter
from tests.support.types import PATCHY, TOP, built
from tests.support.waters import platform


def simulated(counts, steps=0, **options):
    """A Simulation of bodies of types, its bodies and lists of particles."""
    system, positions, lists = built(counts, **options)
    bodies = RigidBodies.from_types(system, lists, positions)
    topology = app.Topology()
    chain = topology.addChain()
    for _ in positions:
        topology.addAtom("S", None, topology.addResidue("X", chain))
    simulation = app.Simulation(topology, system, SIERIntegrator(0.01, bodies=bodies), platform())
    simulation.context.setPositions(positions)
    simulation.context.setVelocitiesToTemperature(300, 1)
    simulation.step(steps)
    return simulation, bodies, lists


def at_sites(kind, q, turns):
    """Positions of the sites of bodies, (n, k, 3), with centres (n, 3) and quaternions (w, x, y, z)."""
    R = Rotation.from_quat(turns, scalar_first=True).as_matrix()
    return q[:, None] + np.einsum("nxy,ky->nkx", R, kind.positions - kind.centre)


def test_orientations_turn_the_frame_of_the_type():
    simulation, bodies, lists = simulated({PATCHY: 3, TOP: 4}, steps=5)
    state = simulation.integrator.getBodyState()
    turns = bodies.orientations(state)
    x = simulation.context.getState(positions=True).getPositions(asNumpy=True)._value
    for kind, columns in ((PATCHY, slice(0, 3)), (TOP, slice(3, 7))):
        np.testing.assert_allclose(
            at_sites(kind, state.q.T[columns], turns[columns]), x[lists[kind]], rtol=0, atol=1e-13
        )
    assert (turns[:, 0] >= 0).all()


def test_without_a_type_orientations_turn_the_principal_axes():
    system, positions, lists = built({TOP: 2})
    bodies = RigidBodies.from_system(system, rigid=lists[TOP], positions=positions)
    _, A = bodies.fit(positions)
    state = SIERIntegrator(0.01, bodies=bodies)
    context = openmm.Context(system, state, platform())
    context.setPositions(positions)
    R = Rotation.from_quat(bodies.orientations(state.getBodyState()), scalar_first=True).as_matrix()
    np.testing.assert_allclose(R, A.transpose(2, 1, 0), rtol=0, atol=1e-14)


def test_forces_and_torques_are_derivatives_of_the_energy(rng):
    simulation, bodies, _ = simulated({PATCHY: 2, TOP: 2})
    context, state = simulation.context, simulation.integrator.getBodyState()
    F, tau = simulation.integrator.computeBodyForces()

    def energy(shift, turn):
        A = np.einsum("abn,cb->acn", state.A, Rotation.from_rotvec(turn).as_matrix())
        x = bodies.place(state.q + shift[:, None], A, np.zeros((bodies.n_particles, 3)))
        context.setPositions(x)
        return context.getState(energy=True).getPotentialEnergy()._value

    for direction in rng.normal(size=(3, 3)):
        # Central differences of second order: errors of 1e-8 of the third derivatives, which are of the order of 100.
        h = 1e-4
        rest, step = np.zeros(3), h * direction
        shifted = energy(-step, rest) - energy(step, rest)
        turned = energy(rest, -step) - energy(rest, step)
        assert F.sum(axis=1) @ direction == pytest.approx(shifted / (2 * h), abs=1e-4)
        assert tau.sum(axis=1) @ direction == pytest.approx(turned / (2 * h), abs=1e-4)


def test_kinetic_energies_by_axis_have_the_sums():
    simulation, bodies, _ = simulated({PATCHY: 3, TOP: 4}, steps=5)
    state = simulation.integrator.getBodyState()
    by_axis = bodies.kinetic_energies_by_axis(state)
    assert by_axis.shape == (2, 3, 7)
    np.testing.assert_allclose(by_axis.sum(axis=(1, 2)), bodies.kinetic_energies(state), rtol=1e-13)
    along = 0.5 * (state.A[2, :, 1] @ state.p[:, 1]) ** 2 / bodies.masses[1]
    assert by_axis[0, 2, 1] == pytest.approx(along, rel=1e-13)


def test_hdf5_files_have_types_and_their_frames(tmp_path):
    h5py = pytest.importorskip("h5py")
    simulation, _, lists = simulated({PATCHY: 3, TOP: 4})
    simulation.reporters.append(BodyStateReporter(tmp_path / "run.h5", 2))
    simulation.step(2)
    with h5py.File(tmp_path / "run.h5") as file:
        assert file["species_1"].attrs["type"] == "top"
        R = Rotation.from_quat(file["quaternion"][-1], scalar_first=True).as_matrix()[3:]
        sites = file["q"][-1][3:, None] + np.einsum("nxy,ky->nkx", R, file["species_1/sites"][:])
        tensor = file["species_1/axes"][:].T @ np.diag(file["species_1/moments"][:]) @ file["species_1/axes"][:]
    x = simulation.context.getState(positions=True).getPositions(asNumpy=True)._value
    np.testing.assert_allclose(sites, x[lists[TOP]], rtol=0, atol=1e-13)
    arms = TOP.positions - TOP.centre
    expected = sum(m * (r @ r * np.eye(3) - np.outer(r, r)) for m, r in zip(TOP.masses, arms, strict=True))
    np.testing.assert_allclose(tensor, expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize("periodic", [False, True])
def test_gsd_files_have_places_and_orientations(tmp_path, periodic):
    gsd = pytest.importorskip("gsd.hoomd")
    simulation, bodies, _ = simulated({PATCHY: 3, TOP: 4}, periodic=periodic)
    path = tmp_path / "run.gsd"
    simulation.reporters.append(GSDReporter(path, 2))
    simulation.step(4)
    simulation.reporters[0].close()
    simulation.reporters[0] = GSDReporter(path, 2, append=True)
    simulation.step(2)
    simulation.reporters[0].close()
    state = simulation.integrator.getBodyState()
    with gsd.open(str(path)) as file:
        assert [frame.configuration.step for frame in file] == [2, 4, 6]
        last = file[-1]
    assert last.particles.types == ["patchy", "top"]
    assert last.particles.typeid.tolist() == [0] * 3 + [1] * 4
    # Single precision.
    np.testing.assert_allclose(last.particles.mass, bodies.masses, rtol=1e-7)
    np.testing.assert_allclose(last.particles.orientation, bodies.orientations(state), rtol=0, atol=1e-6)
    np.testing.assert_allclose(last.particles.velocity, (state.p / bodies.masses).T, rtol=0, atol=1e-5)
    lx, ly, lz, xy, xz, yz = last.configuration.box
    box = np.array([[lx, 0, 0], [xy * ly, ly, 0], [xz * lz, yz * lz, lz]])
    np.testing.assert_allclose(last.particles.position + last.particles.image @ box, state.q.T, rtol=0, atol=1e-5)
    assert (np.abs(np.linalg.solve(box.T, last.particles.position.T)) <= 0.5 + 1e-6).all()
    assert last.particles.image.any() == periodic
    if periodic:
        vectors = simulation.context.getState().getPeriodicBoxVectors(asNumpy=True)._value
        np.testing.assert_allclose(box, vectors, rtol=0, atol=1e-6)


def test_a_gsd_file_of_other_bodies_is_not_continued(tmp_path):
    pytest.importorskip("gsd.hoomd")
    for count in (3, 4):
        simulation, _, _ = simulated({TOP: count})
        simulation.reporters.append(GSDReporter(tmp_path / "run.gsd", 1, append=count == 4))
        if count == 3:
            simulation.step(1)
            simulation.reporters[0].close()
    with pytest.raises(ValueError, match=r"run\.gsd .*3 bodies.* 4"):
        simulation.step(1)
