"""A stiff Force of each class limits the step, or is reported as one that cannot be judged."""

import math
import warnings

import numpy as np
import openmm
import pytest

from openmm_sier import SIER2, RigidBodies
from openmm_sier.dynamics.integration_method import IntegrationMethod
from openmm_sier.stability.advice import StepError, StepWarning
from openmm_sier.stability.step_check import StepCheck
from openmm_sier.system.forces import FORCES
from tests.support.containers import at_rest
from tests.support.systems import assembled, field
from tests.support.waters import plain_context

#: A light atom among three heavy ones, dalton and nm.
MASSES = (16.0, 1.0, 16.0, 16.0)
POSITIONS = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.4, 0.1], [0.3, 0.0, 0.5]])

#: kJ/mol/nm^2 or kJ/mol. With it the light atom has a period of 8.6 fs or less.
STIFFNESS = 5e5

#: ps. It is longer than any of these periods.
STEP = 0.02


def harmonic_bond():
    force = openmm.HarmonicBondForce()
    force.addBond(0, 1, 0.1, STIFFNESS)
    return force


def custom_bond(energy=f"{STIFFNESS}/2*(r-0.1)^2"):
    force = openmm.CustomBondForce(energy)
    force.addBond(0, 1)
    return force


def compound_bond():
    force = openmm.CustomCompoundBondForce(2, f"{STIFFNESS}/2*(distance(p1,p2)-0.1)^2")
    force.addBond([0, 1])
    return force


def centroid_bond():
    force = openmm.CustomCentroidBondForce(2, f"{STIFFNESS}/2*(distance(g1,g2)-0.1)^2")
    for atom in (0, 1):
        force.addGroup([atom])
    force.addBond([0, 1])
    return force


def held_at_its_value(variable):
    """Return a CustomCVForce whose minimum is the value of a collective variable at `POSITIONS`."""
    context = plain_context(assembled(MASSES, openmm.XmlSerializer.clone(variable)), POSITIONS)
    value = context.getState(energy=True).getPotentialEnergy()._value
    force = openmm.CustomCVForce(f"1000*{STIFFNESS}/2*(v-{value!r})^2")
    force.addCollectiveVariable("v", variable)
    return force


def rmsd():
    return held_at_its_value(openmm.RMSDForce(POSITIONS * [1, 1.3, 0.8]))


def radius_of_gyration():
    return held_at_its_value(openmm.RGForce(range(4)))


def orientation():
    return openmm.OrientationRestraintForce(1000 * STIFFNESS, POSITIONS)


def drude():
    """Atom 1 as the Drude particle of atom 0."""
    force = openmm.DrudeForce()
    force.addParticle(1, 0, -1, -1, -1, -1.0, 0.001, 1.0, 1.0)
    return force


def python():
    return openmm.PythonForce(lambda state: (0.0, np.zeros((4, 3))))


#: A stiff Force of each class, and the atoms that move: those of its term, or the one that moves most.
STIFF = {
    openmm.HarmonicBondForce: (harmonic_bond, (0, 1)),
    openmm.CustomBondForce: (custom_bond, (0, 1)),
    openmm.CustomCompoundBondForce: (compound_bond, (1,)),
    openmm.CustomCentroidBondForce: (centroid_bond, (1,)),
    openmm.CustomExternalForce: (lambda: field(f"{STIFFNESS}/2*((x-0.1)^2+y^2+z^2)", [1]), (1,)),
    openmm.RMSDForce: (rmsd, (1,)),
    openmm.RGForce: (radius_of_gyration, (1,)),
    openmm.OrientationRestraintForce: (orientation, (1,)),
    openmm.CustomCVForce: (lambda: held_at_its_value(custom_bond("r")), (1,)),
    openmm.ATMForce: (lambda: at_rest(assembled(MASSES), harmonic_bond()), (0, 1)),
}

#: Forces whose stiffness nothing tells.
UNKNOWN = {openmm.DrudeForce: drude, openmm.PythonForce: python}

#: Forces that are taken for softer than bonds, whatever their parameters: they bend and turn bonds, or act between
#: molecules. Librations by those with charges are estimated.
SOFT = {
    openmm.HarmonicAngleForce,
    openmm.PeriodicTorsionForce,
    openmm.RBTorsionForce,
    openmm.CMAPTorsionForce,
    openmm.CustomAngleForce,
    openmm.CustomTorsionForce,
    openmm.AmoebaTorsionTorsionForce,
    openmm.CustomHbondForce,
    openmm.NonbondedForce,
    openmm.ConstantPotentialForce,
    openmm.AmoebaMultipoleForce,
    openmm.HippoNonbondedForce,
    openmm.AmoebaVdwForce,
    openmm.AmoebaWcaDispersionForce,
    openmm.AmoebaGeneralizedKirkwoodForce,
    openmm.CustomNonbondedForce,
    openmm.CustomGBForce,
    openmm.GBSAOBCForce,
    openmm.LCPOForce,
    openmm.GayBerneForce,
    openmm.CustomManyParticleForce,
    openmm.CustomVolumeForce,
}


def judged(force):
    """Check a long step in a System with one Force."""
    system = assembled(MASSES, force)
    context = plain_context(system, POSITIONS)
    with warnings.catch_warnings():
        warnings.simplefilter("error", StepWarning)
        StepCheck(system, RigidBodies.from_system(system))(IntegrationMethod(SIER2, STEP), 1, context)


def test_every_class_is_in_one_of_the_tables():
    """A class that is new in OpenMM needs an example here, unless it is softer than bonds for certain."""
    assert {kind for kind, row in FORCES.items() if row.exerts_forces} == STIFF.keys() | UNKNOWN.keys() | SOFT
    without_forces = {kind for kind, row in FORCES.items() if not row.exerts_forces}
    # That of bonds is known.
    assert {FORCES[kind].stiffness for kind in SOFT | without_forces | {openmm.HarmonicBondForce}} == {"soft"}
    # Where the Forces in a container are not known, its own row counts.
    containers = {openmm.ATMForce, openmm.CustomCVForce}
    assert {FORCES[kind].stiffness for kind in UNKNOWN.keys() | containers} == {"unknown"}


@pytest.mark.parametrize("kind", STIFF, ids=lambda kind: kind.__name__)
def test_a_stiff_force_limits_the_step(kind):
    make, atoms = STIFF[kind]
    numbers = " and ".join(map(str, atoms)) if len(atoms) == 2 else str(atoms[0])
    with pytest.raises(StepError, match=rf"atoms? {numbers} "):
        judged(make())


@pytest.mark.parametrize("kind", UNKNOWN, ids=lambda kind: kind.__name__)
def test_an_unknown_stiffness_limits_no_step_that_is_chosen(kind):
    """Such as that of an equilibration, which would be needlessly short."""
    system = assembled(MASSES, UNKNOWN[kind]())
    check = StepCheck(system, RigidBodies.from_system(system))
    assert check.longest_step(SIER2, 1, 0, context=plain_context(system, POSITIONS)) == math.inf


@pytest.mark.parametrize("kind", UNKNOWN, ids=lambda kind: kind.__name__)
def test_a_force_of_unknown_stiffness_is_reported(kind):
    with pytest.raises(StepWarning, match=f"cannot be judged.*{kind.__name__}"):
        judged(UNKNOWN[kind]())
