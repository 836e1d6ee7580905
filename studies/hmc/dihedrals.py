"""Dihedrals of a dipeptide."""

from __future__ import annotations

import numpy as np
from openmm import app

#: Atoms of phi and psi, each with its residue beside that of the alpha carbon.
PHI = ((-1, "C"), (0, "N"), (0, "CA"), (0, "C"))
PSI = ((0, "N"), (0, "CA"), (0, "C"), (1, "N"))


def backbone(topology: app.Topology) -> tuple[list[int], list[int]]:
    """Indices of the atoms of phi and psi of the first residue that has both.

    Raises:
        ValueError: none has.
    """
    residues = [{atom.name: atom.index for atom in residue.atoms()} for residue in topology.residues()]
    wanted = PHI + PSI
    inner = range(1, len(residues) - 1)
    centre = next((i for i in inner if all(name in residues[i + beside] for beside, name in wanted)), None)
    if centre is None:
        raise ValueError("no residue has an alpha carbon between two others")
    phi, psi = ([residues[centre + beside][name] for beside, name in atoms] for atoms in (PHI, PSI))
    return phi, psi


def dihedral(positions: np.ndarray, atoms: list[int]) -> float:
    """The angle of four of the positions (N, 3), of one molecule that is whole, in radians from -pi to pi."""
    a, b, c, d = positions[atoms]
    axis = (c - b) / np.linalg.norm(c - b)
    first, last = np.cross(b - a, axis), np.cross(axis, d - c)
    return float(np.arctan2(np.cross(first, last) @ axis, first @ last))
