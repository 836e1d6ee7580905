"""Angles between constrained bonds, which limit the step as bonds do."""

import math

import numpy as np
import openmm
import pytest

from openmm_sier import SIER4G, SIERIntegrator, SIERLangevinIntegrator, prepare_system
from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.engines.native.refusals import points
from openmm_sier.stability.motions import Motions
from tests.support.silence import silence
from tests.support.systems import assembled
from tests.support.waters import cluster_system, judged, plain_context

#: Lengths of two bonds, nm, their angle, and its force constant, kJ/mol/rad^2.
FIRST, SECOND, ANGLE, STRENGTH = 0.1, 0.13, 1.9, 500.0
MASSES = (1.5, 12.0, 3.0)


def bent(constraints=((0, 1, FIRST), (1, 2, SECOND))):
    """Three atoms with an angle, at equilibrium."""
    angle = openmm.HarmonicAngleForce()
    angle.addAngle(0, 1, 2, ANGLE, STRENGTH)
    x = np.array([[FIRST, 0, 0], [0, 0, 0], [SECOND * math.cos(ANGLE), SECOND * math.sin(ANGLE), 0]])
    return assembled(MASSES, angle, constraints=constraints), x


def angles_of(system):
    bodies: BodySet = points(system)
    return Motions(system, bodies, []).harmonic


def test_the_period_is_that_of_the_constrained_motion():
    """Against the Hessian, by differences of OpenMM's forces, on the tangent space of the constraints."""
    system, x = bent()
    context = plain_context(system, x)
    hessian = np.empty((9, 9))
    for k in range(9):
        forces = []
        for sign in (1, -1):
            moved = x.ravel().copy()
            moved[k] += sign * 1e-5
            context.setPositions(moved.reshape(3, 3))
            forces.append(context.getState(forces=True).getForces(asNumpy=True)._value.ravel())
        hessian[k] = (forces[1] - forces[0]) / 2e-5
    gradients = np.zeros((2, 3, 3))
    for row, (i, j) in enumerate(((0, 1), (1, 2))):
        gradients[row, i], gradients[row, j] = x[i] - x[j], x[j] - x[i]
    scale = 1 / np.sqrt(np.repeat(MASSES, 3))
    tangent = np.linalg.svd(gradients.reshape(2, 9) * scale)[2][2:]
    square = np.linalg.eigvalsh(tangent @ (hessian * np.outer(scale, scale)) @ tangent.T).max()
    (angle,) = angles_of(system)
    assert angle.kind == "angle"
    assert angle.atoms == (0, 1, 2)
    # Second differences have errors of 1e-10/1e-5 of the largest, and of the squared displacement.
    assert angle.period == pytest.approx(2 * math.pi / math.sqrt(square), rel=1e-5)


@pytest.mark.parametrize(
    "constraints",
    [((0, 1, FIRST),), ((0, 1, FIRST), (1, 2, SECOND), (0, 2, 0.19)), ()],
    ids=["one bond", "rigid", "no bond"],
)
def test_other_angles_are_slower_than_a_bond_or_do_not_vibrate(constraints):
    assert not angles_of(bent(constraints)[0])


@pytest.fixture
def water():
    """A System of flexible water with constrained bonds."""
    return cluster_system(3, rigidWater=False, constraints=openmm.app.HBonds)[2]


@pytest.mark.parametrize("engine", ["exact", "native"])
def test_slow_forces_must_bend_water(water, engine):
    """In a liquid at 9 fs the mean angle differs from that of an isolated molecule by half of what it should."""
    prepare_system(water, hydrogenMass=4)
    warning = r"forces bend the angle of atoms 1, 0, 2 \(period 25 fs\) by only 53 %.* rigidWater=True"
    with pytest.warns(match=warning):
        judged(water, SIERLangevinIntegrator(300, 1, 0.009, engine=engine))
    with silence():
        judged(water, SIERLangevinIntegrator(300, 1, 0.006, engine=engine))
        judged(water, SIERIntegrator(0.0075, SIER4G, engine=engine))


@pytest.mark.filterwarnings("ignore:A step of 9 fs is long. atom 1 and similar bodies can swing")
@pytest.mark.parametrize("engine", ["exact", "native"])
def test_light_hydrogens_of_water_bend_too_fast(water, engine):
    """At 9 fs, 0.63 periods, slow forces change the mean angle in the wrong direction. Kicks of SIER4G every 5.8 fs
    heat 65 molecules by 5 kJ/mol in 0.5 ps; in steps of 4 fs the energy is right to 0.1."""
    prepare_system(water)
    refused = r"is too long for the angle of atoms \d, \d, \d: its period is 14.2 fs"
    for integrator in (SIERLangevinIntegrator(300, 1, 0.009, engine=engine), SIERIntegrator(0.0058, engine=engine)):
        with pytest.raises(openmm.OpenMMException, match=refused):
            judged(water, integrator)
    with silence():
        judged(water, SIERIntegrator(0.004, engine=engine))


def test_in_kicks_an_angle_is_judged_as_a_bond(water):
    """SIER4G is unstable there from 7.8 fs on."""
    with pytest.raises(openmm.OpenMMException, match=r"7\.8.*Call prepare_system"):
        judged(water, SIERIntegrator(0.009, SIER4G))
