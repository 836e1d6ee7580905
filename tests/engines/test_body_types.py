"""Bodies whose moments are not those of their masses move, are drawn, reported and stored like all others."""

import numpy as np
import openmm
import pytest

from openmm_sier import (
    BodyType,
    RigidBodies,
    SIERHMCIntegrator,
    SIERIntegrator,
    SIERLangevinIntegrator,
    prepare_system,
    with_frames,
)
from tests.support.types import PATCHY, TOP, built, typed
from tests.support.waters import platform

#: The mass and the moments of `TOP` at its centre, and its sites without mass.
CORE = BodyType(
    "core",
    [TOP.centre, *TOP.positions],
    [61, 0, 0, 0, 0],
    TOP.axes.T @ np.diag(TOP.principal_moments) @ TOP.axes,
)

#: kJ/(mol K)
GAS_CONSTANT = 0.00831446261815324


def started(system, positions, integrator, name="Reference"):
    context = openmm.Context(system, integrator, platform(name))
    context.setPositions(positions)
    return context


def kinetic(context):
    return context.getState(energy=True).getKineticEnergy()._value


def bath(bodies):
    return SIERLangevinIntegrator(300, 2, 0.02, bodies=bodies)


def trials(bodies):
    return SIERHMCIntegrator(300, 0.02, bodies=bodies)


def integrators(bodies):
    return [
        SIERIntegrator(0.01, bodies=bodies),
        SIERLangevinIntegrator(300, 1, 0.01, bodies=bodies),
        SIERHMCIntegrator(300, 0.01, bodies=bodies),
    ]


def test_sites_move_as_masses_with_these_moments_would():
    ends = []
    for kind in (TOP, CORE):
        system, positions, lists = built({kind: 6}, seed=3, sites=slice(-4, None))
        integrator = SIERIntegrator(0.01, bodies=RigidBodies.from_types(system, lists, positions))
        context = started(system, positions, integrator)
        integrator.step(100)
        sites = [i for body in lists[kind] for i in body[-4:]]
        ends.append(context.getState(positions=True).getPositions(asNumpy=True)._value[sites])
    assert np.abs(ends[0] - positions[sites]).max() > 0.1
    # Rounding of 100 steps.
    np.testing.assert_allclose(ends[0], ends[1], rtol=0, atol=1e-11)


@pytest.mark.parametrize("ensemble", range(3))
def test_kinetic_energy_is_that_of_the_bodies(ensemble):
    """OpenMM sums it over the velocities of massive atoms, which carry no spin of a single core."""
    system, positions, bodies = typed({PATCHY: 20, TOP: 5})
    integrator = integrators(bodies)[ensemble]
    context = started(system, positions, integrator)
    context.setVelocitiesToTemperature(300, 1)

    def expected():
        return sum(bodies.kinetic_energies(integrator.getBodyState()))

    assert kinetic(context) == pytest.approx(expected(), rel=1e-12)
    integrator.step(3)
    assert kinetic(context) == pytest.approx(expected(), rel=1e-12)
    before = kinetic(context)
    context.setVelocities(2 * context.getState(velocities=True).getVelocities(asNumpy=True))
    assert kinetic(context) == pytest.approx(4 * before, rel=1e-12)


def test_drawn_velocities_are_thermal():
    n = 400
    system, positions, bodies = typed({PATCHY: n})
    integrator = SIERIntegrator(0.01, bodies=bodies)
    context = started(system, positions, integrator)
    context.setVelocitiesToTemperature(300, 1)
    state = integrator.getBodyState()
    along_axes = np.einsum("axn,xn->an", state.A, state.L)
    energies = np.concatenate([state.p**2 / bodies.masses, along_axes**2 / bodies.moments]) / (GAS_CONSTANT * 300)
    # Squares of normal numbers have the variance 2; four standard errors, with a seed.
    assert np.abs(energies.mean(axis=1) - 1).max() < 4 * (2 / n) ** 0.5


@pytest.mark.parametrize("ensemble", range(3))
def test_restarts_have_the_same_bits(ensemble):
    system, positions, bodies = typed({PATCHY: 6, TOP: 3})
    integrator = integrators(bodies)[ensemble]
    context = started(system, positions, integrator)
    context.setVelocitiesToTemperature(300, 1)
    integrator.step(5)
    checkpoint = context.createCheckpoint()
    text = openmm.XmlSerializer.serialize(integrator)
    integrator.step(5)
    expected = integrator.getBodyState()
    restored = openmm.XmlSerializer.deserialize(text)
    assert str(restored.impl.settings.bodies) == str(bodies)
    later = started(system, positions, restored)
    later.loadCheckpoint(checkpoint)
    restored.step(5)
    for name in ("q", "p", "A", "L"):
        assert np.array_equal(getattr(restored.getBodyState(), name), getattr(expected, name))


def test_velocities_alone_carry_the_momenta():
    system, positions, bodies = typed({PATCHY: 6})
    first, second = (SIERIntegrator(0.01, bodies=bodies) for _ in range(2))
    context, other = started(system, positions, first), started(system, positions, second)
    context.setVelocitiesToTemperature(300, 1)
    first.step(5)
    other.setState(context.getState(positions=True, velocities=True))
    for one, two in zip(first.getBodyState().L, second.getBodyState().L, strict=True):
        np.testing.assert_allclose(one, two, rtol=0, atol=1e-11)


def test_prepared_bodies_are_molecules():
    system, positions, bodies = typed({PATCHY: 3})
    assert "3 rigid bodies are joined" in str(prepare_system(system, bodies))
    context = started(system, positions, SIERIntegrator(0.01, bodies=bodies))
    assert [list(molecule) for molecule in context.getMolecules()] == [[0, 1, 2], [3, 4, 5], [6, 7, 8]]


def test_frames_have_the_moments():
    system, positions, bodies = typed({PATCHY: 3, TOP: 1})
    framed = with_frames(system, positions, bodies)
    for frame in framed.frames:
        shape = frame.shape
        squares = (shape.masses * shape.corners**2).sum(axis=1)
        np.testing.assert_allclose(squares.sum() - squares, bodies.moments[:, frame.body], rtol=1e-12)
    context = started(framed.system, framed.positions, openmm.LangevinMiddleIntegrator(300, 1, 0.004))
    context.getIntegrator().step(20)
    # OpenMM's solvers are exact to 1e-5 of a length.
    bodies.fit(framed.getAtomPositions(context.getState(positions=True)))


def test_the_native_engine_refuses_them():
    system, positions, bodies = typed({PATCHY: 3})
    with pytest.raises(openmm.OpenMMException, match=r"moments .*engine='exact'"):
        started(system, positions, SIERIntegrator(0.01, bodies=bodies, engine="native"))


@pytest.mark.parametrize(("make", "steps"), [(bath, 50), (trials, 20)])
def test_dipoles_of_massless_sites_have_langevins_function(make, steps):
    """In a field of 2 kT; rotors that do not interact are not chaotic."""
    n, kT, field = 300, GAS_CONSTANT * 300, 2.0
    system, positions, lists = built({PATCHY: n}, seed=7)
    system.removeForce(0)
    dipoles = openmm.CustomExternalForce("-pull*z")
    dipoles.addPerParticleParameter("pull")
    for core, patch, _ in lists[PATCHY]:
        dipoles.addParticle(core, [-field * kT / 0.3])
        dipoles.addParticle(patch, [field * kT / 0.3])
    system.addForce(dipoles)
    bodies = RigidBodies.from_types(system, lists, positions)
    integrator = make(bodies)
    integrator.setRandomNumberSeed(1)
    context = started(system, positions, integrator)
    context.setVelocitiesToTemperature(300, 1)
    integrator.step(8 * steps)
    cosines, energies = [], []
    for _ in range(30):
        integrator.step(steps)
        state = integrator.getBodyState()
        x = context.getState(positions=True).getPositions(asNumpy=True)._value
        cosines.append(((x[1::3, 2] - x[::3, 2]) / 0.3).mean())
        energies.append(bodies.kinetic_energies_by_axis(state).mean(axis=2) / (kT / 2))
    exact = 1 / np.tanh(field) - 1 / field
    # Successive samples correlate by 0.2 in the bath and by 0.8^4 of trials, as was seen: at least 12 of 30 are
    # independent. Variances of the cosine are below 1/3 and those of squares 2; four standard errors, with a seed.
    assert abs(np.mean(cosines) - exact) < 4 * (1 / 3 / (12 * n)) ** 0.5
    assert np.abs(np.mean(energies, axis=0) - 1).max() < 4 * (2 / (12 * n)) ** 0.5
