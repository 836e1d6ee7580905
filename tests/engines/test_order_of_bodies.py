"""Bodies keep the order of the user's lists, where kinds alternate, in all that is returned, moved and stored."""

import numpy as np
import openmm
import pytest

from openmm_sier import RigidBodies, SIERHMCIntegrator, SIERIntegrator, SIERLangevinIntegrator
from openmm_sier.dynamics.bodies import BodyState
from openmm_sier.engines.exact.packing import Packing
from tests.support.systems import field
from tests.support.waters import platform

SHAPES = (
    (np.array([[0, 0, 0], [0.2, 0, 0], [0.05, 0.18, 0]]), (12.0, 14.0, 16.0)),
    (np.array([[0, 0, 0], [0.2, 0, 0]]), (12.0, 1.0)),
    (np.array([[0, 0, 0]]), (23.0,)),
)


@pytest.fixture(scope="module")
def mixed():
    """A System in a field, positions and bodies of three kinds by turns; the last three are points without a list."""
    system, positions, lists = openmm.System(), [], []
    rng = np.random.default_rng(0)
    for k in range(8):
        shape, masses = SHAPES[k % 3]
        atoms = [system.addParticle(mass) for mass in masses]
        positions.append(shape + 2 * rng.random(3))
        if k < 7:
            lists.append(atoms)
    system.addParticle(39.0)
    positions.append(rng.random((1, 3)))
    system.addForce(field("20*(x^2 + y^2 + 2*z^2) + 30*x*y + 10*sin(3*z)", range(system.getNumParticles())))
    x = np.concatenate(positions)
    return system, x, RigidBodies.from_system(system, rigid=lists[::-1], positions=x)


def integrators(bodies):
    return {
        "constant energy": SIERIntegrator(0.01, bodies=bodies),
        "bath": SIERLangevinIntegrator(300, 1, 0.01, bodies=bodies),
        "trials": SIERHMCIntegrator(300, 0.01, bodies=bodies),
    }


def started(mixed, integrator):
    system, x, _ = mixed
    context = openmm.Context(system, integrator, platform())
    context.setPositions(x)
    context.setVelocitiesToTemperature(300, 1)
    return context


def test_each_column_is_of_the_body_with_its_number(mixed):
    system, _, bodies = mixed
    integrator = SIERIntegrator(0.01, bodies=bodies)
    context = started(mixed, integrator)
    integrator.step(5)
    state = context.getState(positions=True, velocities=True, forces=True)
    x, v, f = (
        vectors._value for vectors in (state.getPositions(True), state.getVelocities(True), state.getForces(True))
    )
    motion = integrator.getBodyState()
    F, tau = integrator.computeBodyForces()
    for number in range(bodies.n):
        atoms = bodies.atoms_of(number)
        masses = np.array([system.getParticleMass(int(i))._value for i in atoms])
        centre = masses @ x[atoms] / masses.sum()
        arms = x[atoms] - centre
        assert bodies.masses[number] == masses.sum()
        np.testing.assert_allclose(motion.q[:, number], centre, rtol=0, atol=1e-14)
        np.testing.assert_allclose(motion.p[:, number], masses @ v[atoms], rtol=0, atol=1e-12)
        np.testing.assert_allclose(F[:, number], f[atoms].sum(axis=0), rtol=0, atol=1e-11)
        np.testing.assert_allclose(tau[:, number], np.cross(arms, f[atoms]).sum(axis=0), rtol=0, atol=1e-11)
        # Angular momenta along a line, which displaced forces may give, are not those of its atoms.
        if len(atoms) > 2:
            L = (masses[:, None] * np.cross(arms, v[atoms])).sum(axis=0)
            np.testing.assert_allclose(motion.L[:, number], L, rtol=0, atol=1e-13)


@pytest.mark.parametrize("ensemble", ["constant energy", "bath", "trials"])
def test_restarts_have_the_same_bits(mixed, ensemble):
    first, second = (integrators(mixed[2])[ensemble] for _ in range(2))
    context, other = started(mixed, first), started(mixed, second)
    first.step(5)
    checkpoint = context.createCheckpoint()
    first.step(5)
    other.loadCheckpoint(checkpoint)
    second.step(5)
    one, two = first.getBodyState(), second.getBodyState()
    assert np.array_equal(one.q, two.q)
    assert np.array_equal(one.A, two.A)
    assert np.array_equal(one.p, two.p)


def test_checkpoints_hold_bodies_kind_by_kind(mixed):
    """So did those of versions that numbered them in this way."""
    bodies = mixed[2]
    rng = np.random.default_rng(1)
    order = np.concatenate(bodies.numbers)
    state = BodyState(
        *rng.normal(size=(2, 3, bodies.n)), rng.normal(size=(3, 3, bodies.n)), rng.normal(size=(3, bodies.n))
    )
    kind_by_kind = BodyState(state.q[:, order], state.p[:, order], state.A[:, :, order], state.L[:, order])
    older = RigidBodies(bodies.species, bodies.n_particles)
    packed = Packing(bodies).pack(state)
    assert np.array_equal(packed, Packing(older).pack(kind_by_kind))
    read = Packing(bodies).unpack(packed)
    assert np.array_equal(read.q, state.q)
    assert np.array_equal(read.p, state.p)


def test_xml_keeps_the_order(mixed):
    text = openmm.XmlSerializer.serialize(SIERIntegrator(0.01, bodies=mixed[2]))
    restored = openmm.XmlSerializer.deserialize(text).impl.settings.bodies
    assert [list(restored.atoms_of(i)) for i in range(restored.n)] == [list(mixed[2].atoms_of(i)) for i in range(10)]


def test_numbers_that_are_none():
    species = RigidBodies.from_system(_two_ions()).species
    with pytest.raises(ValueError, match="numbers of 2 bodies must be"):
        RigidBodies(species, 2, numbers=[np.array([0, 2])])


def _two_ions():
    system = openmm.System()
    system.addParticle(23.0)
    system.addParticle(23.0)
    return system
