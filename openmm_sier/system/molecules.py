"""Molecules that the periodic box has cut are made whole, by their bonds, and broken ones are refused."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import openmm
from openmm import app, unit

from openmm_sier.dynamics.constraints.graph import joined
from openmm_sier.system import tables
from openmm_sier.system.arguments import Positions, checked_positions, checked_system
from openmm_sier.system.bonded_terms import harmonic_bonds
from openmm_sier.system.boxes import wrapped
from openmm_sier.system.inner_forces import parts

#: kJ/mol. A bond that is longer than its own length and has more energy than this is broken: bonds dissociate with 400.
BREAKING = 1000.0

#: nm. A constraint is broken beyond its length by this much: bonds of hydrogen have then more energy than `BREAKING`.
STRETCH = 0.1

#: nm. The longest bond whose length no force field tells; those of iodine and of heavy metals have 0.3.
LONGEST_BOND = 0.4


class Bonds(NamedTuple):
    """Hold the bonds that keep molecules together.

    Attributes:
        pairs: particle indices, (b, 2).
        lengths: that the force field has, (b,), nm; NaN where it is not known.
        longest: beyond which a bond is broken, (b,), nm.
        periodic: whether the force field takes the nearest images of the two atoms, (b,).
    """

    pairs: np.ndarray
    lengths: np.ndarray
    longest: np.ndarray
    periodic: np.ndarray

    @classmethod
    def joined(cls, pairs: Any, lengths: Any = math.nan, longest: Any = LONGEST_BOND, periodic: bool = False) -> Bonds:
        """Make bonds of one kind; numbers count for all."""
        pairs = np.array(pairs, dtype=np.int64).reshape(-1, 2)
        each = np.broadcast_to(np.array(lengths, dtype=float), len(pairs))
        return cls(pairs, each, np.broadcast_to(longest, len(pairs)), np.broadcast_to(periodic, len(pairs)))

    @classmethod
    def of_topology(cls, topology: app.Topology) -> Bonds:
        """Read the bonds of an openmm.app.Topology."""
        return cls.joined([(bond[0].index, bond[1].index) for bond in topology.bonds()])

    @classmethod
    def guessed(cls, topology: app.Topology) -> Bonds:
        """Read the bonds of a topology, and join atoms without bonds to the first atom of their residue."""
        bonds = cls.of_topology(topology)
        known, pairs = set(bonds.pairs.ravel().tolist()), []
        for residue in topology.residues():
            first, *others = (atom.index for atom in residue.atoms())
            pairs += [(first, other) for other in others if other not in known]
        return cls.together(bonds, cls.joined(pairs))

    @classmethod
    def of_system(cls, system: openmm.System) -> Bonds:
        """Read constraints, harmonic bonds that do work, and bonds of virtual sites to their first particles."""
        pairs, lengths = tables.constraints(system)
        found = [cls.joined(pairs, lengths, lengths + STRETCH)]
        for force in (part.force for part in parts(system)):
            if isinstance(force, openmm.HarmonicBondForce):
                ends, lengths, strengths = harmonic_bonds(force)
                acts = strengths > 0
                longest = lengths[acts] + np.sqrt(2 * BREAKING / strengths[acts])
                found.append(cls.joined(ends[acts], lengths[acts], longest, force.usesPeriodicBoundaryConditions()))
        sites = [i for i in range(system.getNumParticles()) if system.isVirtualSite(i)]
        found.append(cls.joined([(i, system.getVirtualSite(i).getParticle(0)) for i in sites]))
        return cls.together(*found)

    @classmethod
    def together(cls, *parts: Bonds) -> Bonds:
        """Join the bonds of several parts. Where two parts join the same atoms, the earlier one counts."""
        pairs, *others = map(np.concatenate, zip(*parts, strict=True))
        pairs = np.sort(pairs, axis=1)
        _, first = np.unique(pairs, axis=0, return_index=True)
        return cls(*(column[np.sort(first)] for column in (pairs, *others)))

    def measured(self, positions: np.ndarray, box: np.ndarray | None) -> np.ndarray:
        """Return lengths at positions (N, 3) in nm, (b,), nm."""
        arms = positions[self.pairs[:, 1]] - positions[self.pairs[:, 0]]
        if box is not None:
            arms[self.periodic] = wrapped(arms[self.periodic], box, np.round)
        return np.linalg.norm(arms, axis=1)


def make_whole(system: openmm.System, positions: Positions, topology: app.Topology | None = None) -> np.ndarray:
    """Return positions at which the periodic boundary cuts no molecule.

    Call it where a file has molecules that the box has cut: OpenMM's constraints, and most bonds, ignore the box.

    >>> whole = make_whole(system, positions, topology)

    Where a bond or a constraint is far too long, its atoms move next to each other by box vectors, together with the
    atoms bonded to them. Molecules that are whole already keep their positions to the last bit.

    Args:
        system: the System, with the periodic box, if any, as its default.
        positions: (N, 3), nm or a Quantity.
        topology: the topology of all particles, for the names of residues in messages, and for bonds that the System
            does not have or has only as an expression (CustomBondForce).

    Returns:
        (N, 3), nm.

    Raises:
        ValueError: a bond is broken, even between the nearest images of its atoms: one that has more than 1000 kJ/mol,
            a constraint that is 0.1 nm too long, or a bond of the topology alone of more than 0.4 nm. The message names
            the worst.
    """
    x = checked_positions(positions, checked_system(system).getNumParticles())
    bonds = Bonds.of_system(system)
    if topology is not None:
        bonds = Bonds.together(bonds, Bonds.of_topology(topology))
    vectors = [vector.value_in_unit(unit.nanometer) for vector in system.getDefaultPeriodicBoxVectors()]
    box = np.array(vectors) if system.usesPeriodicBoundaryConditions() else None
    x = joined_by(bonds, x, box)
    _refuse_broken(bonds, x, box, topology)
    return x


def joined_by(bonds: Bonds, positions: np.ndarray, box: np.ndarray | None) -> np.ndarray:
    """Move atoms next to those that they are bonded to, at positions (N, 3) in nm, in a box of vectors (3, 3).

    What is not broken stays as it is, even if another image is nearer.
    """
    if box is None or not (cut := bonds.measured(positions, box) > bonds.longest).any():
        return positions
    parents, numbers = _tree(bonds, len(positions))
    atoms = np.flatnonzero(numbers >= 0)
    atoms = atoms[cut[numbers[atoms]]]
    arms = positions[atoms] - positions[parents[atoms]]
    shifts = np.zeros((len(parents), 3))
    shifts[atoms] = wrapped(arms, box, np.round) - arms
    # Sums along the way to the root, of twice as many bonds each time.
    while (parents != len(positions)).any():
        shifts += shifts[parents]
        parents = parents[parents]
    return positions + shifts[:-1]


def _tree(bonds: Bonds, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return for n particles the next one on the way to the first of the molecule, and the number of their bond.

    The first of each molecule has the particle n next, and no bond, -1; and so has the particle n. What is held most
    closely is joined first: a restraint between two molecules tells less than their bonds.
    """
    from scipy import sparse
    from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

    ends = bonds.pairs.T
    forest = minimum_spanning_tree(sparse.coo_array((bonds.longest, ends), (n + 1, n + 1)).tocsr()).tocoo()
    first = np.unique(joined(n, bonds.pairs))
    rows = np.concatenate([forest.row, np.full(len(first), n)]), np.concatenate([forest.col, first])
    rooted = sparse.coo_array((np.ones(len(rows[0])), rows), (n + 1, n + 1)).tocsr()
    _, parents = breadth_first_order(rooted, n, directed=False)
    parents[n] = n
    known = dict(zip(map(tuple, bonds.pairs.tolist()), range(len(bonds.pairs)), strict=True))
    numbers = [known.get((min(i, parent), max(i, parent)), -1) for i, parent in enumerate(parents.tolist())]
    return parents, np.array(numbers)


def _refuse_broken(bonds: Bonds, positions: np.ndarray, box: np.ndarray | None, topology: app.Topology | None) -> None:
    found = bonds.measured(positions, box)
    broken = np.flatnonzero(found > bonds.longest)
    if not broken.size:
        return
    worst = broken[np.argmax(found[broken])]
    by_topology = np.isnan(bonds.lengths[worst])
    expected = "are bonded" if by_topology else f"belong {bonds.lengths[worst]:.4f} nm apart"
    names = f"atoms {bonds.pairs[worst][0]} and {bonds.pairs[worst][1]}"
    if topology is not None:
        atoms = list(topology.atoms())
        one, two = (atoms[i] for i in bonds.pairs[worst])
        names = " and ".join(f"{atom.name} of {atom.residue.name} {atom.residue.id}" for atom in (one, two))
    images = "" if box is None else ", at the nearest images"
    more = f" ({len(broken)} bonds are too long)" if len(broken) > 1 else ""
    stale = ", is the bond left from another file (a record CONECT)" if by_topology else ""
    raise ValueError(
        f"a molecule is broken: {names} {expected}, but are {found[worst]:.4g} nm apart{images}{more}. Is an atom "
        f"misplaced, are residues missing between the two{stale}, or is the box that of another system?"
    )
