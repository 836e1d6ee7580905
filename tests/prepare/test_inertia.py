"""Mass and moments of inertia that a user gives to bodies."""

import numpy as np
import openmm
import pytest
from openmm import unit

from openmm_sier import RigidBodies, SIERLangevinIntegrator, select_bodies, set_inertia
from tests.support.domains import DOMAINS, domain_system, folded, topology_of
from tests.support.seeded import seeded
from tests.support.systems import assembled
from tests.support.waters import platform

#: A centre, and patches on a sphere of 0.5 nm.
PATCHY = 0.5 * np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=float)


def patchy(count=1):
    """Particles with patches, far apart."""
    system = openmm.System()
    for _ in range(count * len(PATCHY)):
        system.addParticle(1.0)
    positions = np.concatenate([PATCHY + np.array([5.0 * i, 0, 0]) for i in range(count)])
    return system, positions, [range(i * len(PATCHY), (i + 1) * len(PATCHY)) for i in range(count)]


def test_a_particle_with_patches_gets_the_moments_of_a_ball():
    """Two fifths of its mass times the square of its radius."""
    system, positions, bodies = patchy(2)
    ball = 0.4 * 100 * 0.5**2
    set_inertia(system, positions, bodies, 100 * unit.dalton, 3 * [ball] * unit.dalton * unit.nanometer**2)
    result = RigidBodies.from_system(system, rigid=bodies, positions=positions)
    np.testing.assert_allclose(result.masses, 100.0, rtol=1e-12)
    np.testing.assert_allclose(result.moments, ball, rtol=1e-12)
    assert len(result.species) == 1


def test_domains_keep_their_centre_and_axes():
    """Moments of the domains are some 900, 1100 and 1500 dalton nm^2 with equal masses."""
    topology, positions, system = topology_of(), folded(), domain_system()
    domains = select_bodies(topology, [f"A:{residues}" for residues in DOMAINS])
    before = RigidBodies.from_system(system, topology, domains, positions)
    q, A = before.fit(positions)
    number = int(before.owners[domains[1][0]])
    moments = before.moments[:, number] * [1.1, 0.95, 1.02] * 20
    set_inertia(system, positions, domains[1:], 20 * before.masses[number], moments)
    after = RigidBodies.from_system(system, topology, domains, positions)
    other = int(after.owners[domains[1][0]])
    np.testing.assert_allclose(after.moments[:, other], moments, rtol=1e-9)
    assert after.masses[other] == pytest.approx(20 * before.masses[number], rel=1e-12)
    moved, turned = after.fit(positions)
    np.testing.assert_allclose(moved[:, other], q[:, number], atol=1e-9)
    np.testing.assert_allclose(
        np.abs(np.einsum("ax,bx->ab", turned[:, :, other], A[:, :, number])), np.eye(3), atol=1e-8
    )
    # The first domain is as it was.
    assert system.getParticleMass(domains[0][0])._value == 110


def test_kinetic_energies_agree_with_openmm():
    """OpenMM adds up those of atoms, which move with their bodies: equal to rounding."""
    system, positions, bodies = patchy(8)
    set_inertia(system, positions, bodies, 100, [6.0, 8.0, 12.0])
    known = RigidBodies.from_system(system, rigid=bodies, positions=positions)
    integrator = seeded(SIERLangevinIntegrator(300, 1, 0.01, bodies=known), 2)
    context = openmm.Context(system, integrator, platform("Reference"))
    context.setPositions(positions)
    context.setVelocitiesToTemperature(300, 1)
    integrator.step(20)
    state = context.getState(energy=True)
    motion = integrator.getBodyState()
    assert state.getKineticEnergy()._value == pytest.approx(sum(integrator.bodies.kinetic_energies(motion)), rel=1e-10)


def test_masses_need_not_be_near_equal_ones():
    """Of a lattice with nearly all of its mass at the centre: the least deviation from equal masses is below zero."""
    lattice = 0.3 * np.stack(np.meshgrid(*3 * [np.arange(3)], indexing="ij"), axis=-1).reshape(-1, 3)
    system, bodies = assembled(len(lattice) * [1.0]), [range(len(lattice))]
    set_inertia(system, lattice, bodies, 100, [1.0, 1.2, 1.5])
    assert min(system.getParticleMass(i)._value for i in bodies[0]) > 0
    result = RigidBodies.from_system(system, rigid=bodies, positions=lattice)
    np.testing.assert_allclose(result.moments[:, 0], [1.0, 1.2, 1.5], rtol=1e-7)


def test_moments_that_no_masses_have():
    system, positions, bodies = patchy()
    texts = openmm.XmlSerializer.serialize(system)
    # All mass on the patches has 2/3 of M R^2, 16.7 dalton nm^2, less what the centre must have.
    with pytest.raises(ValueError, match=r"atoms 0-6 .*further out"):
        set_inertia(system, positions, bodies, 100, 3 * [20.0])
    with pytest.raises(ValueError, match="no masses give"):
        set_inertia(system, np.where([1, 1, 0], positions, 0.0), bodies, 100, 3 * [5.0])
    for moments in ([3, 2, 1], [1, 1, 3], [-1, 1, 1], [1, 1]):
        with pytest.raises(ValueError, match=r"moments must|no body has such moments"):
            set_inertia(system, positions, bodies, 100, moments)
    with pytest.raises(ValueError, match="mass must be"):
        set_inertia(system, positions, bodies, 0, 3 * [5.0])
    with pytest.raises(ValueError, match="atoms with mass"):
        set_inertia(system, positions, [[]], 100, 3 * [5.0])
    with pytest.raises(TypeError, match="dalton nm"):
        set_inertia(system, positions, bodies, 100, 3 * [5.0] * unit.dalton)
    assert openmm.XmlSerializer.serialize(system) == texts


@pytest.mark.filterwarnings("error")
def test_a_body_of_one_atom_has_its_mass_alone():
    system = assembled([3.0])
    set_inertia(system, np.zeros((1, 3)), [[0]], 5.0, 3 * [0.0])
    assert system.getParticleMass(0)._value == 5.0
    with pytest.raises(ValueError, match="moments 1, 1, 1"):
        set_inertia(system, np.zeros((1, 3)), [[0]], 5.0, 3 * [1.0])


def test_a_body_with_massless_patches_is_refused_with_a_remedy_that_works():
    """As bodies are in other programs, where the centre carries mass and moments."""
    positions = 0.1 * np.array([[0, 0, 0], [1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    system = assembled([50.0, 0, 0, 0, 0])
    with pytest.raises(ValueError, match=r"setParticleMass\(1, 1\)"):
        set_inertia(system, positions, [range(5)], 50.0, [0.5, 0.5, 0.5])
    for patch in range(1, 5):
        system.setParticleMass(patch, 1)
    set_inertia(system, positions, [range(5)], 50.0, [0.5, 0.5, 0.5])
    bodies = RigidBodies.from_system(system, None, [range(5)], positions)
    assert bodies.masses == pytest.approx([50.0])
    assert bodies.moments.ravel() == pytest.approx([0.5, 0.5, 0.5])
