"""Read coordinates of all supported formats with OpenMM's readers."""

import io
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from openmm import app, unit
from openmm.unit import Quantity

from openmm_sier.inputs.file_kinds import AMBER_COORDINATES, CRD, GRO, STATE, STRUCTURES, file_kind
from openmm_sier.inputs.pdb_files import ForceFieldError, box_of, named_atom, read_pdb, refusing
from openmm_sier.inputs.source_files import FilePath, SourceFile
from openmm_sier.system.untrusted_files import read_state

#: Elements recognized by the first letter of an atom's name.
_LETTERS = "HCNOPS"


class Coordinates(NamedTuple):
    """Contents of a coordinate file.

    Attributes:
        positions: positions of all atoms, a Quantity.
        box: periodic box vectors; None without a box.
        names: names of the atoms; empty if the file has none.
        topology: topology of a PDB or PDBx/mmCIF file; None for other files.
    """

    positions: Quantity
    box: Quantity | None
    names: Sequence[str] = ()
    topology: app.Topology | None = None


def read_coordinates(path: FilePath, edges: Sequence[float] | None = None) -> Coordinates:
    """Read a coordinate file.

    Args:
        path: path of a PDB or PDBx/mmCIF file, an inpcrd or rst7 file of AMBER, a gro file of GROMACS, a crd file of
            CHARMM, or a State of OpenMM in XML.
        edges: edges of the periodic box, nm, if the file has none.

    Raises:
        ForceFieldError: the file has none of these formats, or OpenMM cannot read it.
        OSError: the file cannot be read.
    """
    source = SourceFile.of(path)
    kind = file_kind(source)
    if kind in STRUCTURES:
        pdb = read_pdb(source, edges)
        names = [atom.name for atom in pdb.topology.atoms()]
        return Coordinates(pdb.getPositions(asNumpy=True), pdb.topology.getPeriodicBoxVectors(), names, pdb.topology)
    if kind not in _READERS:
        raise ForceFieldError(f"{path} is {kind}, but coordinates are expected")
    with refusing(f"cannot read {path} as {kind}"):
        coordinates = _READERS[kind](source)
    return coordinates._replace(box=box_of(path, coordinates.box, edges))


def _amber(source: SourceFile) -> Coordinates:
    file = app.AmberInpcrdFile(str(source))
    # OpenMM returns False instead of a box for some files of one or two atoms.
    return Coordinates(file.getPositions(asNumpy=True), file.boxVectors or None)


def _gro(source: SourceFile) -> Coordinates:
    file = app.GromacsGroFile(str(source))
    box = file.getPeriodicBoxVectors()
    is_none = not np.any(box.value_in_unit(unit.nanometer))
    return Coordinates(file.getPositions(asNumpy=True), None if is_none else box, file.atomNames)


def _crd(source: SourceFile) -> Coordinates:
    file = app.CharmmCrdFile(str(source))
    positions = np.array(file.positions.value_in_unit(unit.nanometer))
    return Coordinates(positions * unit.nanometer, None, file.attype)


def _state(source: SourceFile) -> Coordinates:
    state = read_state(io.BytesIO(source.content))
    return Coordinates(state.getPositions(asNumpy=True), state.getPeriodicBoxVectors())


_READERS = {AMBER_COORDINATES: _amber, GRO: _gro, CRD: _crd, STATE: _state}


def refuse_other_atoms(path: FilePath, coordinates: Coordinates, topology: app.Topology, source: FilePath) -> None:
    """Refuse coordinates that do not belong to the atoms of a topology.

    The numbers of atoms must agree, and in residues of several atoms the elements, as far as names show them.

    Args:
        path: path of the coordinates.
        coordinates: the coordinates.
        topology: the topology.
        source: path of the topology.

    Raises:
        ForceFieldError: the numbers of atoms differ, or an atom does; the message names the first.
    """
    number, expected = len(coordinates.positions), topology.getNumAtoms()
    if number != expected:
        raise ForceFieldError(f"{path} has {number} atoms, but {source} has {expected}")
    for atom, name in zip(topology.atoms(), coordinates.names, strict=False):
        one, two = (_letter(each) for each in (atom.name, name))
        if one and two and one != two and len(atom.residue) > 1:
            raise ForceFieldError(
                f"{path} has {name} where {source} has {named_atom(atom)}: are the atoms in another order?"
            )


def _letter(name: str) -> str:
    """Return the element implied by a name; empty if it implies none."""
    first = name.lstrip("0123456789'")[:1].upper()
    return first if first in _LETTERS else ""
