"""Warnings of hydrogens with unconstrained angles, and of no others."""

import warnings

import openmm
import pytest
from openmm import app

from openmm_sier import SIERIntegrator
from tests.support.systems import assembled, with_forces
from tests.support.waters import cluster_system, platform

MASSES = (16.0, 1.0, 1.0)
BOTH = ((0, 1, 0.1), (0, 2, 0.1))


def bonds():
    force = openmm.HarmonicBondForce()
    for hydrogen in (1, 2):
        force.addBond(0, hydrogen, 0.1, 400000.0)
    return force


def angle():
    force = openmm.HarmonicAngleForce()
    force.addAngle(1, 0, 2, 1.9, 400.0)
    return force


def custom_angle():
    force = openmm.CustomAngleForce("400*(theta - 1.9)^2")
    force.addAngle(1, 0, 2)
    return force


def urey_bradley():
    force = openmm.HarmonicBondForce()
    force.addBond(1, 2, 0.16, 40000.0)
    return force


def expression():
    force = openmm.CustomCompoundBondForce(3, "400*(angle(p1, p2, p3) - 1.9)^2")
    force.addBond([1, 0, 2])
    return force


def created(system):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        openmm.Context(system, SIERIntegrator(0.0005, "SIER2"), platform())


LOOSE = {
    "constraints": assembled(MASSES, constraints=BOTH),
    "bonds": assembled(MASSES, bonds()),
    "one of each": assembled(MASSES, bonds(), constraints=BOTH[:1]),
}
HELD = {
    "a third constraint": assembled(MASSES, constraints=(*BOTH, (1, 2, 0.16))),
    "an angle": assembled(MASSES, angle(), constraints=BOTH),
    "an angle of flexible water": assembled(MASSES, bonds(), angle()),
    "a custom angle": assembled(MASSES, custom_angle(), constraints=BOTH),
    "a bond between hydrogens": assembled(MASSES, urey_bradley(), constraints=BOTH),
    # Of that no angle is known.
    "an expression": assembled(MASSES, expression(), constraints=BOTH),
    "beads that are no hydrogens": assembled((16.0, 16.0, 16.0), constraints=BOTH),
    "a third neighbour": assembled((*MASSES, 12.0), constraints=(*BOTH, (0, 3, 0.15))),
}


@pytest.mark.parametrize("system", LOOSE.values(), ids=LOOSE)
def test_unconstrained_hydrogens_draw_a_warning(system):
    with pytest.warns(UserWarning, match="Nothing fixes the angle of atoms 1, 0 and 2, nor that of 0 other molecules"):
        openmm.Context(system, SIERIntegrator(0.0005, "SIER2"), platform())


@pytest.mark.parametrize("system", HELD.values(), ids=HELD)
def test_hydrogens_that_something_holds_are_not(system):
    created(system)


@pytest.mark.parametrize("options", [{}, {"rigidWater": False, "constraints": app.HBonds}], ids=["rigid", "flexible"])
@pytest.mark.parametrize("model", ["tip3p", "tip4pew"])
def test_usual_water_is_held(model, options):
    _, _, system = cluster_system(4, model, **options)
    created(with_forces(system, openmm.CMMotionRemover()))
