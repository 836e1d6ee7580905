"""Identify kinds of files by content: AMBER and GROMACS both use the suffix .top, AMBER and CHARMM .crd."""

import re

from openmm_sier.inputs.source_files import FilePath, SourceFile

#: Kinds of files, as named in messages.
PDB = "a PDB file"
MMCIF = "a PDBx/mmCIF file"
AMBER_COORDINATES = "a coordinate file of AMBER"
GRO = "a gro file of GROMACS"
CRD = "a crd file of CHARMM"
STATE = "a State of OpenMM"
PRMTOP = "a prmtop file of AMBER"
TOP = "a top file of GROMACS"
PSF = "a psf file of CHARMM"
SYSTEM = "a System of OpenMM"
UNKNOWN = "of no kind that is known"

#: Kinds with positions, names and residues; kinds with positions only; and kinds of topologies.
STRUCTURES = (PDB, MMCIF)
POSITIONS = (AMBER_COORDINATES, GRO, CRD, STATE)
TOPOLOGIES = (PRMTOP, TOP, PSF, SYSTEM)

#: Number of bytes inspected.
HEAD = 2**20

#: Starts of files, after blanks; NetCDF files are AMBER's binary coordinates.
_BEGINNINGS = {"%VERSION": PRMTOP, "PSF": PSF, "*": CRD, "CDF": AMBER_COORDINATES, "\ufffdHDF": AMBER_COORDINATES}

_ROOT = re.compile(r"<(State|System)\b")

#: Starts of lines in other kinds of files; the first match counts.
_LINES = {
    MMCIF: re.compile(r"^\s*_atom_site\.", re.MULTILINE),
    PDB: re.compile(r"^(ATOM|HETATM)", re.MULTILINE),
    TOP: re.compile(r"^\s*(\[\s*[a-z_]+\s*\]|#\s*include\s)", re.MULTILINE),
}


def file_kind(path: FilePath) -> str:
    """Return the kind of a file, one of the constants above.

    Raises:
        OSError: the file cannot be read.
    """
    text = SourceFile.of(path).content[:HEAD].decode(errors="replace")
    # Titles may start with anything.
    if kind := _counted(text.splitlines()[:3]):
        return kind
    begun = text.lstrip()
    for beginning, kind in _BEGINNINGS.items():
        if begun.startswith(beginning):
            return kind
    if begun.startswith("<"):
        root = _ROOT.search(begun)
        return {"State": STATE, "System": SYSTEM}[root[1]] if root else UNKNOWN
    return next((kind for kind, line in _LINES.items() if line.search(text)), UNKNOWN)


def _counted(lines: list[str]) -> str:
    """Return the kind of a file with a title, the number of atoms and then the atoms; empty for other files."""
    if len(lines) < 3 or not lines[1].split() or not lines[1].split()[0].isdigit():
        return ""
    if re.match(r"( *-?\d+\.\d+){3}", lines[2]):
        return AMBER_COORDINATES
    # Number and name of the residue, name and number of the atom, in five columns each, then the coordinates.
    return GRO if re.match(r"[ \d]{5}.{10}[ \d]{5}( *-?\d+\.\d+){3}", lines[2]) else ""
