"""The table of Forces has a row for each class of OpenMM, and its rows are what OpenMM does."""

import openmm

from openmm_sier.system.forces import FORCES, UNKNOWN, kind_of


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
