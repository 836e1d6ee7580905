"""Alternate places of atoms in PDB and PDBx/mmCIF files, of which OpenMM takes the first."""

import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from openmm_sier.inputs.file_kinds import MMCIF, PDB

#: A value of an mmCIF file. A quotation ends with its mark and a blank.
_VALUE = re.compile(r"""'.*?'(?=\s|$)|".*?"(?=\s|$)|\S+""")

#: Columns of an mmCIF file for the names of a `Place`, each of which begins with "auth_" or "label_".
_NAMES = ("asym_id", "seq_id", "comp_id", "atom_id")


class Place(NamedTuple):
    """A place of an atom.

    Attributes:
        chain, number: of its residue, which may have other names in other places.
        residue: the name of its residue.
        atom: its name.
        alternate: the letter of the place; empty where there is no other.
        occupancy: the share of molecules that are so.
    """

    chain: str
    number: str
    residue: str
    atom: str
    alternate: str
    occupancy: float


class Alternates(NamedTuple):
    """The alternate locations of a residue.

    Attributes:
        residue: its name and number.
        occupancies: by the letters of the places; OpenMM takes the first.
    """

    residue: str
    occupancies: dict[str, float]

    @property
    def is_rarer(self) -> bool:
        """Return whether the first place is rarer than another one."""
        first, *others = self.occupancies.values()
        return any(other > first for other in others)

    def __str__(self) -> str:
        return ", ".join(f"{letter or '(no letter)'} {share:.2g}" for letter, share in self.occupancies.items())


def find_alternates(path: str | Path, kind: str) -> list[Alternates]:
    """Return the residues of a file with atoms in several places, in the order of the file.

    Args:
        path: of the file.
        kind: of the file, see `openmm_sier.inputs.file_kinds`.

    Raises:
        OSError: it cannot be read.
    """
    text = Path(path).read_text(errors="replace")
    residues: dict[tuple[str, str], list[Place]] = defaultdict(list)
    for place in _PLACES[kind](text):
        residues[place.chain, place.number].append(place)
    found = [Alternates(f"{places[0].residue} {places[0].number}", _shares(places)) for places in residues.values()]
    return [each for each in found if each.occupancies]


def _shares(places: list[Place]) -> dict[str, float]:
    """Return mean occupancies by letter of the atoms of a residue that are in several places; empty without any."""
    letters: dict[str, set[str]] = defaultdict(set)
    for place in places:
        letters[place.atom].add(place.alternate)
    shares: dict[str, list[float]] = defaultdict(list)
    for place in places:
        if len(letters[place.atom]) > 1:
            shares[place.alternate].append(place.occupancy)
    return {letter: sum(each) / len(each) for letter, each in shares.items()}


def _of_pdb(text: str) -> Iterator[Place]:
    for line in text.splitlines():
        # Later models give other positions to the same atoms.
        if line.startswith("ENDMDL"):
            return
        if line.startswith(("ATOM", "HETATM")):
            names = line[21:22], line[22:27].strip(), line[17:20].strip(), line[12:16].strip()
            yield Place(*names, line[16:17].strip(), _occupancy(line[54:60]))


def _of_mmcif(text: str) -> Iterator[Place]:
    columns: list[str] = []
    model = None
    for line in text.splitlines():
        if line.startswith("_atom_site."):
            columns.append(line.split()[0].removeprefix("_atom_site."))
            continue
        if not line.startswith(("ATOM", "HETATM")) or not columns:
            continue
        row = dict(zip(columns, (value.strip("\"'") for value in _VALUE.findall(line)), strict=False))
        model = model or row.get("pdbx_PDB_model_num")
        if row.get("pdbx_PDB_model_num") != model:
            return
        chain, number, residue, atom = (row.get(f"auth_{name}") or row.get(f"label_{name}", "") for name in _NAMES)
        inserted, alternate = (row.get(name, "").strip(".?") for name in ("pdbx_PDB_ins_code", "label_alt_id"))
        yield Place(chain, number + inserted, residue, atom, alternate, _occupancy(row.get("occupancy", "")))


_PLACES = {PDB: _of_pdb, MMCIF: _of_mmcif}


def _occupancy(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return 1.0
