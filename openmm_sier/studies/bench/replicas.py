"""Boxes of many sizes, from one that is repeated."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import NamedTuple

import numpy as np
import openmm
from openmm import app, unit

from openmm_sier.measure.forcefields import Box, load, pme_system


class Replica(NamedTuple):
    """A box repeated along its edges.

    Attributes:
        molecules: their number.
        positions: (N, 3), nm, virtual sites included.
        system: with PME.
    """

    molecules: int
    positions: np.ndarray
    system: openmm.System


def copies_for(molecules: int, of: int) -> tuple[int, int, int]:
    """How often a box of `of` molecules stands along each edge of the most cubic one of so many molecules.

    Raises:
        ValueError: it is not a multiple of the box.
    """
    times, rest = divmod(molecules, of)
    if rest or not times:
        raise ValueError(f"sizes are multiples of the {of} molecules of the box, got {molecules}")
    divisors = [n for n in range(1, times + 1) if times % n == 0]
    shapes = [(a, b, times // (a * b)) for a, b in itertools.product(divisors, repeat=2) if times % (a * b) == 0]
    return min(shapes, key=lambda shape: (max(shape) - min(shape), shape))


def repeated(box: Box, directory: Path, copies: tuple[int, int, int]) -> Replica:
    """A box repeated along each edge.

    Args:
        box: the box.
        directory: where its PDB file is, beside which force fields are looked for.
        copies: along each edge.
    """
    positions = np.array(box.positions.value_in_unit(unit.nanometer))
    if copies == (1, 1, 1):
        return Replica(box.topology.getNumResidues(), positions, box.system)
    vectors = np.array(box.topology.getPeriodicBoxVectors().value_in_unit(unit.nanometer))
    places = np.array(list(itertools.product(*map(range, copies))))
    topology = app.Topology()
    for _ in places:
        _add(box.topology, topology)
    topology.setPeriodicBoxVectors(np.array(copies)[:, None] * vectors * unit.nanometer)
    system = pme_system(topology, load(box.choice.files, directory))
    return Replica(topology.getNumResidues(), ((places @ vectors)[:, None] + positions).reshape(-1, 3), system)


def _add(box: app.Topology, topology: app.Topology) -> None:
    """Add the molecules of a box once more."""
    atoms = {}
    for chain in box.chains():
        added = topology.addChain()
        for residue in chain.residues():
            place = topology.addResidue(residue.name, added)
            for atom in residue.atoms():
                atoms[atom] = topology.addAtom(atom.name, atom.element, place)
    for first, second in box.bonds():
        topology.addBond(atoms[first], atoms[second])
