"""The table of Forces has a row for each class of OpenMM, and its rows are what OpenMM does."""

import numpy as np
import openmm
import pytest

from openmm_sier.system.forces import FORCES, UNKNOWN, kind_of
from tests.support.systems import assembled, field
from tests.support.waters import plain_context


def test_every_force_of_openmm_has_its_row():
    classes = {member for member in vars(openmm).values() if isinstance(member, type)}
    assert set(FORCES) == {member for member in classes if issubclass(member, openmm.Force)} - {openmm.Force}


def test_a_subclass_has_the_row_of_its_class():
    class Springs(openmm.HarmonicBondForce):
        pass

    class Plugin(openmm.Force):
        def __init__(self):
            pass

    assert kind_of(Springs()) == FORCES[openmm.HarmonicBondForce]
    assert kind_of(Plugin()) == UNKNOWN


def test_what_executes_code_or_has_no_xml_is_no_data():
    """A class that is new in OpenMM is data unless it executes code or opens files, as PythonForce does."""
    others = {force for force, kind in FORCES.items() if not kind.is_data}
    assert others == {openmm.PythonForce, openmm.RPMDMonteCarloBarostat}


def centroids(energy):
    force = openmm.CustomCentroidBondForce(1, energy)
    force.addGroup([0])
    return force


def donors(energy):
    force = openmm.CustomHbondForce(energy)
    force.addDonor(0, 1, 2)
    force.addAcceptor(3, 2, 1)
    return force


def of_all_particles(force):
    for _ in range(4):
        force.addParticle()
    return force


#: Functions that make a Force of an expression, for each class of particles whose energy is one.
EXPRESSIONS = {
    openmm.CustomBondForce: openmm.CustomBondForce,
    openmm.CustomAngleForce: openmm.CustomAngleForce,
    openmm.CustomTorsionForce: openmm.CustomTorsionForce,
    openmm.CustomCompoundBondForce: lambda energy: openmm.CustomCompoundBondForce(1, energy),
    openmm.CustomCentroidBondForce: centroids,
    openmm.CustomHbondForce: donors,
    openmm.CustomNonbondedForce: lambda energy: of_all_particles(openmm.CustomNonbondedForce(energy)),
    openmm.CustomManyParticleForce: lambda energy: of_all_particles(openmm.CustomManyParticleForce(3, energy)),
    # Its coordinates are x, y and z.
    openmm.CustomExternalForce: lambda energy: field(energy, [0]),
}


def test_every_class_with_an_expression_is_in_the_table():
    custom = {force for force in FORCES if hasattr(force, "getEnergyFunction")}
    of_no_particles = {openmm.ATMForce, openmm.CustomCVForce, openmm.CustomVolumeForce}
    assert custom == EXPRESSIONS.keys() | of_no_particles


@pytest.mark.parametrize("kind", EXPRESSIONS, ids=lambda kind: kind.__name__)
def test_classes_with_absolute_coordinates_are_those_that_accept_them(kind):
    """OpenMM refuses unknown names when it makes a Context."""

    def context(energy):
        return plain_context(assembled(4 * [1.0], EXPRESSIONS[kind](energy)), np.eye(4, 3))

    context("0")
    if FORCES[kind].has_coordinates:
        context("x1")
    else:
        with pytest.raises(openmm.OpenMMException, match="x1"):
            context("x1")
