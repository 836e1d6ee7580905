"""Bonded forces from a Context of some bodies: those of the whole System, parameters and box, refusals."""

import numpy as np
import openmm
import pytest

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.dynamics.species import Species
from openmm_sier.engines.exact.fast_force_context import FastForceContext, FastForceError, working_forces
from tests.support.systems import assembled
from tests.support.waters import plain_context

#: Particles: a water 0-2 in front, eight flexible atoms in a shuffled order, a virtual site, an ion.
FLEXIBLE = [9, 3, 4, 7, 5, 6, 10, 8]
WATER = [0, 1, 2]
SITE, ION = 11, 12
FAST = 3

#: For each particle the number of its body where none is rigid.
MOVING = np.arange(13) != SITE
OWNER = np.where(MOVING, np.arange(13), -1)


def bonded_forces():
    """One of each kind, with terms on flexible atoms."""
    a = FLEXIBLE
    bond = openmm.HarmonicBondForce()
    bond.addBond(a[0], a[1], 0.15, 2e5)
    bond.addBond(a[6], a[7], 0.12, 1e5)
    angle = openmm.HarmonicAngleForce()
    angle.addAngle(a[2], a[0], a[1], 1.9, 400)
    torsion = openmm.PeriodicTorsionForce()
    torsion.addTorsion(a[0], a[1], a[2], a[3], 3, 0.4, 9)
    ryckaert = openmm.RBTorsionForce()
    ryckaert.addTorsion(a[4], a[5], a[6], a[7], 1, 2, 3, 4, 5, 6)
    cmap = openmm.CMAPTorsionForce()
    angles = 2 * np.pi * np.arange(24) / 24
    cmap.addMap(24, (10 * np.outer(np.sin(angles), np.cos(2 * angles)) + 4 * np.cos(angles)).ravel())
    cmap.addTorsion(0, a[0], a[1], a[2], a[3], a[1], a[2], a[3], a[4])
    custom_bond = openmm.CustomBondForce("scale*k*(r-0.2)^4")
    custom_bond.addGlobalParameter("scale", 1.0)
    custom_bond.addPerBondParameter("k")
    custom_bond.addBond(a[3], a[5], [3e4])
    custom_angle = openmm.CustomAngleForce("k*(theta-2)^2")
    custom_angle.addPerAngleParameter("k")
    custom_angle.addAngle(a[3], a[4], a[5], [77.0])
    custom_torsion = openmm.CustomTorsionForce("k*cos(2*theta)")
    custom_torsion.addPerTorsionParameter("k")
    custom_torsion.addTorsion(a[1], a[3], a[5], a[7], [11.0])
    return [bond, angle, torsion, ryckaert, cmap, custom_bond, custom_angle, custom_torsion]


def whole_system(forces):
    for force in forces:
        force.setForceGroup(FAST)
    slow = openmm.HarmonicBondForce()
    slow.addBond(ION, FLEXIBLE[0], 0.1, 500)
    masses = [15.999, 1.008, 1.008, *8 * [12.011], 0.0, 22.99]
    system = assembled(masses, slow, openmm.CMMotionRemover(), *forces)
    system.setVirtualSite(SITE, openmm.TwoParticleAverageSite(FLEXIBLE[0], FLEXIBLE[1], 0.5, 0.5))
    return system


def fast_forces(system):
    return [force for force in system.getForces() if force.getForceGroup() == FAST]


def fast_context_of(system, owner=OWNER):
    points = Species.from_sites(np.sort(FLEXIBLE)[:, None], np.array([12.011]), np.zeros((3, 1)))
    bodies = BodySet([points], system.getNumParticles())
    forces = working_forces(fast_forces(system), owner, MOVING)
    return FastForceContext(forces, bodies, openmm.Platform.getPlatformByName("Reference"), {})


def assert_forces_are_those_in(context, fast):
    """The same arithmetic on the same numbers."""
    expected = forces_in(context)[np.sort(FLEXIBLE)].T
    positions = context.getState(positions=True).getPositions(asNumpy=True)._value
    q = np.ascontiguousarray(positions[np.sort(FLEXIBLE)].T)
    F, tau = fast(q, np.repeat(np.eye(3)[:, :, None], len(FLEXIBLE), axis=2))
    assert np.abs(expected).max() > 1.0
    assert np.abs(F - expected).max() < 1e-12 * np.abs(expected).max()
    assert not tau.any()


def forces_in(context):
    return context.getState(forces=True, groups={FAST}).getForces(asNumpy=True)._value


@pytest.fixture
def positions(rng):
    x = 0.5 * rng.random((13, 3))
    x[SITE] = 0.5 * (x[FLEXIBLE[0]] + x[FLEXIBLE[1]])
    return x


@pytest.mark.parametrize("kind", range(len(bonded_forces())), ids=[type(f).__name__ for f in bonded_forces()])
def test_each_kind_gives_the_forces_of_the_whole_system(positions, kind):
    """Every kind alone, so that a wrong one cannot hide; other groups and passive Forces stay out."""
    system = whole_system([bonded_forces()[kind]])
    assert_forces_are_those_in(plain_context(system, positions), fast_context_of(system))


def test_parameters_and_box_follow(positions):
    bond = openmm.HarmonicBondForce()
    bond.addBond(FLEXIBLE[0], FLEXIBLE[1], 0.15, 2e5)
    bond.setUsesPeriodicBoundaryConditions(True)
    forces = [bonded_forces()[5], bond]
    system = whole_system(forces)
    system.setDefaultPeriodicBoxVectors(*(3 * np.eye(3)))
    # Half a box apart, where the nearest image depends on the box.
    positions[FLEXIBLE[1]] = positions[FLEXIBLE[0]] + [1.2, 0, 0]
    context = plain_context(system, positions)
    fast = fast_context_of(system)
    assert fast.follow(context)
    assert not fast.follow(context)
    context.setParameter("scale", 2.5)
    assert fast.follow(context)
    assert not fast.follow(context)
    context.setPeriodicBoxVectors(*(2.2 * np.eye(3)))
    assert fast.follow(context)
    assert_forces_are_those_in(context, fast)


def test_terms_within_a_rigid_body_are_left_out(positions):
    """As force fields have them for rigid water."""
    angle = openmm.HarmonicAngleForce()
    angle.addAngle(1, 0, 2, 1.8, 400)
    angle.addAngle(*FLEXIBLE[:3], 1.8, 400)
    owner = OWNER.copy()
    owner[WATER] = 0
    system = whole_system([angle])
    (only,) = working_forces(fast_forces(system), owner, MOVING).forces
    assert only.getNumAngles() == 1
    assert_forces_are_those_in(plain_context(system, positions), fast_context_of(system, owner))


def test_forces_without_working_terms_are_left_out():
    angle = openmm.HarmonicAngleForce()
    angle.addAngle(1, 0, 2, 1.8, 400)
    system = whole_system([angle])
    assert working_forces(fast_forces(system), np.where(OWNER < 3, 0, OWNER), MOVING).forces == []


def test_what_is_refused():
    external = openmm.CustomExternalForce("x")
    external.setName("trap")
    bond = openmm.HarmonicBondForce()
    bond.addBond(FLEXIBLE[0], SITE, 0.15, 2e5)
    for force, message in (
        (external, r"trap \(CustomExternalForce\) is in the fast force group 3, but only HarmonicBondForce"),
        (bond, "bond of HarmonicBondForce acts on the atoms 9, 11, but atom 11 is a virtual site or frozen"),
    ):
        system = whole_system([force])
        with pytest.raises(FastForceError, match=message):
            working_forces(fast_forces(system), OWNER, MOVING)
