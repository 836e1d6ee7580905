"""PDB files, with the mistakes refused of which a simulation would make nonsense."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from openmm import app, unit

from openmm_sier.dynamics.constants import GRAM_PER_CM3

#: OpenMM warns so of an atom that a residue has twice, and keeps one of them.
TWICE = "WARNING: duplicate atom"

#: The largest density of a box, g/cm3, above that of any matter on earth. Files without a box often have one of 1 A.
DENSEST = 30.0


class ForceFieldError(ValueError):
    """No force field is named, found or applied, or there is no PDB file that one could be for."""


def read_pdb(path: str | Path) -> app.PDBFile:
    """Read a PDB file.

    Raises:
        ForceFieldError: it is none, has an atom twice, two atoms in one place, or a box that cannot hold its atoms.
        OSError: the file cannot be read.
    """
    lines = Path(path).read_text(errors="replace").splitlines()
    if not any(line.startswith(("ATOM", "HETATM")) for line in lines):
        raise ForceFieldError(f"{path} is no PDB file with atoms")
    for line in lines:
        if line.startswith("CRYST1"):
            _check_edges(path, line)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("error", TWICE)
            pdb = app.PDBFile(str(path))
    except Exception as error:
        message = first_line(error)
        if message.startswith(TWICE):
            raise ForceFieldError(f"{path} has an atom twice: {message.removeprefix(TWICE).strip()}") from None
        raise ForceFieldError(f"cannot read {path} as a PDB file: {message}") from error
    _refuse_coincident(path, pdb)
    _refuse_dense(path, pdb)
    return pdb


def first_line(error: BaseException) -> str:
    """An error's message on one line."""
    return " ".join(str(error).split()) or type(error).__name__


def _check_edges(path: str | Path, record: str) -> None:
    try:
        edges = [float(record[first : first + 9]) for first in (6, 15, 24)]
    except ValueError:
        raise ForceFieldError(f"{path}: expected the edges of the box in Angstrom, got {record.strip()!r}") from None
    if not all(0 < edge < np.inf for edge in edges):
        raise ForceFieldError(
            f"{path}: the box has edges of {', '.join(f'{edge:g}' for edge in edges)} Angstrom, expected lengths above "
            "0; leave out the record CRYST1 where there is no box"
        )


def _refuse_coincident(path: str | Path, pdb: app.PDBFile) -> None:
    """Refuse atoms in the very same place, as of a molecule that is listed twice. Virtual sites may be anywhere."""
    atoms = [atom for atom in pdb.topology.atoms() if atom.element is not None]
    places = pdb.getPositions(asNumpy=True).value_in_unit(unit.nanometer)[[atom.index for atom in atoms]]
    if not np.isfinite(places).all():
        raise ForceFieldError(f"{path} has coordinates that are no numbers")
    order = np.lexsort(places.T)
    same = np.flatnonzero((np.diff(places[order], axis=0) == 0).all(axis=1))
    if len(same):
        one, two = (_named(atoms[order[same[0] + k]]) for k in (0, 1))
        raise ForceFieldError(f"{path}: {one} and {two} are in the same place: is a molecule listed twice?")


def _named(atom: app.topology.Atom) -> str:
    return f"atom {atom.id} ({atom.name} of {atom.residue.name} {atom.residue.id})"


def _refuse_dense(path: str | Path, pdb: app.PDBFile) -> None:
    vectors = pdb.topology.getPeriodicBoxVectors()
    if vectors is None:
        return
    volume = abs(float(np.linalg.det(np.array(vectors.value_in_unit(unit.nanometer)))))
    elements = [atom.element for atom in pdb.topology.atoms() if atom.element is not None]
    mass = sum(element.mass.value_in_unit(unit.dalton) for element in elements)
    if not mass < DENSEST * GRAM_PER_CM3 * volume:
        raise ForceFieldError(
            f"{path}: the box has a volume of {volume:.3g} nm3, too small for its {mass:.4g} dalton; leave out the "
            "record CRYST1 where there is no box"
        )
