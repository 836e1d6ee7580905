"""XML is read only as far as it is OpenMM's, and OpenMM gets the checked content."""

import io
import itertools

import openmm
import pytest

from openmm_sier.system.untrusted_files import (
    ContentError,
    open_regular,
    read_state,
    read_system,
    read_within,
)
from tests.support.waters import plain_context

BEGIN = b'<State type="State" version="1" time="0">'

#: Bytes beyond which a reader does not end by itself. It stops far earlier.
ENOUGH = 2**26


class Endless:
    """A stream of a beginning and of copies of a piece."""

    def __init__(self, beginning, piece):
        self._pieces = itertools.chain([beginning], itertools.repeat(piece))
        self._rest = b""
        self.count = 0

    def read(self, size):
        while len(self._rest) < size:
            self._rest += next(self._pieces)
        content, self._rest = self._rest[:size], self._rest[size:]
        self.count += size
        if self.count > ENOUGH:
            pytest.fail("it is read without end")
        return content


def test_bytes_are_read_up_to_a_bound():
    assert read_within(io.BytesIO(b"four"), 4) == b"four"
    with pytest.raises(ContentError):
        read_within(Endless(b"", b"1"), 1000)
    with pytest.raises(ContentError):
        read_state(Endless(BEGIN, b" " * 1000), particles=10)


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


def test_openmm_gets_all_of_a_state():
    system = openmm.System()
    for _ in range(4):
        system.addParticle(1.0)
    context = plain_context(system, [[0.1 * i, 0, 1e-300] for i in range(4)])
    state = context.getState(positions=True, velocities=True, forces=True, energy=True, parameters=True)
    xml = openmm.XmlSerializer.serialize(state)
    assert openmm.XmlSerializer.serialize(read_state(io.BytesIO(xml.encode()), 4)) == xml


def test_directories_are_distinguished_from_other_things(tmp_path):
    with pytest.raises(IsADirectoryError):
        open_regular(tmp_path)
    with pytest.raises(FileNotFoundError):
        open_regular(tmp_path / "none")
    (tmp_path / "file").write_bytes(b"text")
    with open_regular(tmp_path / "file") as file:
        assert file.read() == b"text"
