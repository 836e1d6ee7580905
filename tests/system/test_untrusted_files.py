"""XML is read only as far as it is OpenMM's, and OpenMM gets the checked content."""

import io

import openmm
import pytest

from openmm_sier.system.untrusted_files import ContentError, open_regular, read_state, read_system
from tests.support.force_examples import EXAMPLES, system_of
from tests.support.waters import plain_context


@pytest.mark.parametrize("xml", [b"", b"none", b"<State", b"\xff\xfe", b"<System type='System'/><a/>"])
def test_what_is_no_xml_is_refused(xml):
    for reader in (read_state, read_system):
        with pytest.raises(ContentError):
            reader(io.BytesIO(xml))


def hard_system():
    """A System with texts that XML escapes, Forces within Forces and a table."""
    system = openmm.System()
    for _ in range(3):
        system.addParticle(1.5)
    inner = openmm.CustomBondForce("k*r; k = 'a'")
    inner.setName("<less & \"more\"> than 'ä'")
    outer = openmm.CustomCVForce("table(cv)")
    outer.addCollectiveVariable("cv", openmm.HarmonicBondForce())
    outer.addTabulatedFunction("table", openmm.Continuous1DFunction([0.0, 1.0, 2.0], 0.0, 1.0))
    alchemical = openmm.ATMForce("u1 - u0")
    alchemical.addForce(openmm.CustomExternalForce("x^2"))
    for i in range(3):
        alchemical.addParticle(openmm.Vec3(i, 0, 0))
    for force in (inner, outer, alchemical):
        system.addForce(force)
    return system


def test_openmm_gets_all_of_a_system():
    xml = openmm.XmlSerializer.serialize(hard_system())
    assert openmm.XmlSerializer.serialize(read_system(io.BytesIO(xml.encode()))) == xml


@pytest.mark.parametrize(
    "kind", [each for each in EXAMPLES if each not in (openmm.PythonForce, openmm.RPMDMonteCarloBarostat)]
)
def test_systems_with_each_class_of_forces_are_read(kind):
    """Some have attributes `type` that are numbers."""
    xml = openmm.XmlSerializer.serialize(system_of(kind))
    assert openmm.XmlSerializer.serialize(read_system(io.BytesIO(xml.encode()))) == xml


#: Elements of which OpenMM makes an object in place of another, and calls its methods.
MISPLACED = {
    "function as a Force": ("<Forces>", '<Forces><Force type="Continuous1DFunction" version="2"/>'),
    "function among Forces": ("<Forces>", '<Forces><Function type="Continuous1DFunction" version="2"/>'),
    "Forces among functions": ("<Functions>", '<Functions><Force type="HarmonicBondForce" version="2"/>'),
    "Force as a function": ("<Functions>", '<Functions><Function type="HarmonicBondForce" version="2"/>'),
    "function as a variable": (
        '<CollectiveVariable name="cv">',
        '<CollectiveVariable name="cv"><Function type="Discrete1DFunction" version="1"/>',
    ),
    "function under another name": ("<Forces>", '<Forces><Bond type="Continuous1DFunction" version="2"/>'),
}


@pytest.mark.parametrize("name", MISPLACED)
def test_a_force_is_no_function(name):
    """OpenMM would end the process, or go on by chance."""
    place, element = MISPLACED[name]
    xml = openmm.XmlSerializer.serialize(hard_system())
    assert place in xml
    with pytest.raises(ContentError, match="another object"):
        read_system(io.BytesIO(xml.replace(place, element, 1).encode()))


def test_elements_are_nested_up_to_a_bound():
    """OpenMM reads a million by as many calls within each other, and ends the process."""
    inner = openmm.CustomBondForce("r")
    for _ in range(30):
        outer = openmm.CustomCVForce("a")
        outer.addCollectiveVariable("a", inner)
        inner = outer
    system = openmm.System()
    system.addForce(inner)
    xml = openmm.XmlSerializer.serialize(system)
    assert openmm.XmlSerializer.serialize(read_system(io.BytesIO(xml.encode()))) == xml
    deep = xml.replace("<Forces>", "<Forces>" + 10**6 * "<a>" + 10**6 * "</a>", 1)
    with pytest.raises(ContentError, match="within each other"):
        read_system(io.BytesIO(deep.encode()))


@pytest.mark.parametrize("value", ["nan", "inf", "-1e999", "none", ""])
@pytest.mark.parametrize("name", ["time", "sier_heat", "x"])
def test_all_numbers_of_a_state_are_finite(name, value):
    system = openmm.System()
    system.addParticle(1.0)
    integrator = openmm.CustomIntegrator(0.001)
    integrator.addGlobalVariable("sier_heat", 0.5)
    # A name that is no kind of object.
    integrator.addGlobalVariable("type", 1.5)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions([[0.5, 0, 0]])
    context.setTime(0.5)
    xml = openmm.XmlSerializer.serialize(context.getState(positions=True, integratorParameters=True))
    assert openmm.XmlSerializer.serialize(read_state(io.BytesIO(xml.encode()))) == xml
    old = f'{name}=".5"'
    assert old in xml
    with pytest.raises(ContentError, match="not finite"):
        read_state(io.BytesIO(xml.replace(old, f'{name}="{value}"', 1).encode()))


def test_openmm_gets_all_of_a_state():
    system = openmm.System()
    for _ in range(4):
        system.addParticle(1.0)
    context = plain_context(system, [[0.1 * i, 0, 1e-300] for i in range(4)])
    state = context.getState(positions=True, velocities=True, forces=True, energy=True, parameters=True)
    xml = openmm.XmlSerializer.serialize(state)
    assert openmm.XmlSerializer.serialize(read_state(io.BytesIO(xml.encode()))) == xml


def test_directories_are_distinguished_from_other_things(tmp_path):
    with pytest.raises(IsADirectoryError):
        open_regular(tmp_path)
    with pytest.raises(FileNotFoundError):
        open_regular(tmp_path / "none")
    (tmp_path / "file").write_bytes(b"text")
    with open_regular(tmp_path / "file") as file:
        assert file.read() == b"text"
