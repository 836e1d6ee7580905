"""Detect molecules and bodies that the periodic boundary cuts, and make them whole."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import openmm
from openmm import app, unit

from openmm_sier.dynamics.bodies import RigidityError
from openmm_sier.dynamics.constraints.graph import joined
from openmm_sier.dynamics.index_ranges import as_ranges, distinct
from openmm_sier.system import tables
from openmm_sier.system.boxes import wrapped
from openmm_sier.system.links import links_of

#: Energy in kJ/mol above which a stretched bond counts as broken; bonds dissociate at 400.
BREAKING = 1000.0

#: Excess length in nm above which a constraint counts as broken: a bond to hydrogen would have more energy than
#: `BREAKING`.
STRETCH = 0.1

#: Maximum length in nm of a bond whose length no force field gives; bonds of iodine and heavy metals have 0.3.
LONGEST_BOND = 0.4

#: Atoms whose shifts differ by more come to different images, nm. Shifts are sums of box vectors, to rounding.
SHIFTED = 1e-6

#: Remedies, for messages.
MAKE_WHOLE = "Make molecules whole: context.setPositions(make_whole(system, positions))"
IF_CUT = f"Does the periodic boundary cut the molecule? {MAKE_WHOLE}"


class Bonds(NamedTuple):
    """Bonds that keep molecules together.

    Attributes:
        pairs: particle indices, (b, 2).
        lengths: lengths in the force field, (b,), nm; NaN if unknown.
        longest: lengths above which bonds are broken, (b,), nm.
        periodic: whether the force field uses the nearest images of the two atoms, (b,).
    """

    pairs: np.ndarray
    lengths: np.ndarray
    longest: np.ndarray
    periodic: np.ndarray

    @classmethod
    def of_pairs(cls, pairs: Any, lengths: Any = math.nan, longest: Any = LONGEST_BOND, periodic: Any = False) -> Bonds:
        """Return bonds between pairs of particles (b, 2); a scalar applies to all bonds."""
        pairs = np.array(pairs, dtype=np.int64).reshape(-1, 2)
        each = np.broadcast_to(np.array(lengths, dtype=float), len(pairs))
        return cls(pairs, each, np.broadcast_to(longest, len(pairs)), np.broadcast_to(periodic, len(pairs)))

    @classmethod
    def of_topology(cls, topology: app.Topology) -> Bonds:
        """Return the bonds of an openmm.app.Topology."""
        return cls.of_pairs([(bond[0].index, bond[1].index) for bond in topology.bonds()])

    @classmethod
    def guessed(cls, topology: app.Topology) -> Bonds:
        """Return the bonds of a topology, with atoms without bonds joined to the first atom of their residue."""
        bonds = cls.of_topology(topology)
        bonded, pairs = set(bonds.pairs.ravel().tolist()), []
        for residue in topology.residues():
            first, *others = (atom.index for atom in residue.atoms())
            pairs += [(first, other) for other in others if other not in bonded]
        return cls.merged(bonds, cls.of_pairs(pairs))

    @classmethod
    def of_system(cls, system: openmm.System) -> Bonds:
        """Return constraints, and harmonic bonds with a strength."""
        links = links_of(system)
        pairs, lengths = links.constraints
        constrained = cls.of_pairs(pairs, lengths, lengths + STRETCH)
        acts = links.strengths > 0
        lengths = links.lengths[acts]
        longest = lengths + np.sqrt(2 * BREAKING / links.strengths[acts])
        harmonic = cls.of_pairs(links.bonds[acts], lengths, longest, links.periodic[acts])
        return cls.merged(constrained, harmonic)

    @classmethod
    def merged(cls, *kinds: Bonds) -> Bonds:
        """Return the bonds of several kinds. Of two bonds between the same atoms the first one is kept."""
        pairs, *others = map(np.concatenate, zip(*kinds, strict=True))
        pairs = np.sort(pairs, axis=1)
        first = tables.first_of_each(pairs)
        return cls(*(column[first] for column in (pairs, *others)))

    def selected(self, mask: np.ndarray) -> Bonds:
        """Return the bonds selected by a mask (b,)."""
        return Bonds(*(column[mask] for column in self))

    def measured(self, positions: np.ndarray, box: np.ndarray | None) -> np.ndarray:
        """Return lengths at positions (N, 3) in nm, (b,), nm."""
        arms = positions[self.pairs[:, 1]] - positions[self.pairs[:, 0]]
        if box is not None:
            arms[self.periodic] = wrapped(arms[self.periodic], box, np.round)
        return np.linalg.norm(arms, axis=1)


def joined_by(bonds: Bonds, positions: np.ndarray, box: np.ndarray | None) -> np.ndarray:
    """Return positions at which no bond is cut, (N, 3), nm: atoms move next to their bonded partners.

    Whole molecules are not moved, even if another image of an atom is nearer.

    Args:
        bonds: bonds that keep molecules together.
        positions: (N, 3), nm.
        box: vectors as rows, (3, 3), nm; None without a box.
    """
    if box is None or not (cut := bonds.measured(positions, box) > bonds.longest).any():
        return positions
    from scipy import sparse
    from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

    n = len(positions)
    # Short bonds take precedence over long ones: bonds must decide before a restraint between two molecules.
    tree = minimum_spanning_tree(sparse.coo_array((bonds.longest, bonds.pairs.T), (n, n)).tocsr()).tocoo()
    # One more node, n, is joined to the first particle of each molecule.
    first = distinct(joined(n, bonds.pairs))
    ends = np.concatenate([tree.row, np.full(len(first), n)]), np.concatenate([tree.col, first])
    rooted = sparse.coo_array((np.ones(len(ends[0])), ends), (n + 1, n + 1)).tocsr()
    order, parents = breadth_first_order(rooted, n, directed=False)
    cut_pairs = set(map(tuple, bonds.pairs[cut].tolist()))
    shifts = np.zeros((n + 1, 3))
    for atom, parent in zip(order[1:].tolist(), parents[order[1:]].tolist(), strict=True):
        shifts[atom] = shifts[parent]
        if (min(atom, parent), max(atom, parent)) in cut_pairs:
            arm = positions[[atom]] - positions[parent]
            shifts[atom] += (wrapped(arm, box, np.round) - arm)[0]
    return positions + shifts[:-1]


def refuse_broken(bonds: Bonds, positions: np.ndarray, box: np.ndarray | None, topology: app.Topology | None) -> None:
    """Refuse bonds that are too long at positions (N, 3) in nm.

    Raises:
        RigidityError: a bond is too long; the message names the longest, by residues if there is a topology.
    """
    lengths = bonds.measured(positions, box)
    broken = np.flatnonzero(lengths > bonds.longest)
    if not broken.size:
        return
    worst = broken[np.argmax(lengths[broken])]
    by_topology = np.isnan(bonds.lengths[worst])
    expected = "are bonded" if by_topology else f"belong {bonds.lengths[worst]:.4f} nm apart"
    names = f"atoms {bonds.pairs[worst][0]} and {bonds.pairs[worst][1]}"
    if topology is not None:
        atoms = list(topology.atoms())
        one, two = (atoms[i] for i in bonds.pairs[worst])
        names = " and ".join(f"{atom.name} of {atom.residue.name} {atom.residue.id}" for atom in (one, two))
    cause = "has a box cut them that the System lacks" if box is None else "is the box that of another system"
    if by_topology:
        cause = f"is the bond left from another file (a record CONECT), or {cause}"
    count = f" ({len(broken)} bonds are too long)" if len(broken) > 1 else ""
    raise RigidityError(
        f"a molecule is broken: {names} {expected}, but are {lengths[worst]:.4g} nm apart{count}. Is an atom "
        f"misplaced, are residues missing between the two, or {cause}?"
    )


# --- bodies without bonds ----------------------------------------------------------------------------------


class Wholeness:
    """Rules by which molecules and bodies of a System are made whole.

    Bonded atoms are next to each other. Atoms of a body that no bonds join are at the images nearest to its first atom;
    so are the particles that place a virtual site. The site itself may be far from them, such as one at the centre of a
    protein. It comes to the image nearest to its first particle, unless it is near that already.

    Attributes:
        bonds: bonds of the System and of the topology.
        box: default box vectors as rows, (3, 3), nm; None in a System that is not periodic.
    """

    def __init__(self, system: openmm.System, topology: app.Topology | None = None):
        self._topology = topology
        self._particles = system.getNumParticles()
        self._frames = tables.rigid_sites(system)
        self.bonds = Bonds.of_system(system)
        if topology is not None:
            self.bonds = Bonds.merged(self.bonds, Bonds.of_topology(topology))
        vectors = [vector.value_in_unit(unit.nanometer) for vector in system.getDefaultPeriodicBoxVectors()]
        self.box = np.array(vectors) if system.usesPeriodicBoundaryConditions() else None

    def whole(self, positions: np.ndarray, clusters: Sequence[Any] | np.ndarray = ()) -> np.ndarray:
        """Return positions at which nothing is cut, (N, 3), nm; those of whole molecules do not change.

        Args:
            positions: (N, 3), nm.
            clusters: particle indices of each body.

        Raises:
            RigidityError: a body that no bonds join, or the particles that place a virtual site, extend over more than
                half the box, and are not whole about the first of them.
        """
        if self.box is None:
            return positions
        # In a body the nearest images of two atoms are not enough.
        bonds = self.bonds._replace(periodic=self.bonds.periodic & (len(clusters) == 0))
        x, fragment = joined_by(bonds, positions, self.box), joined(self._particles, self.bonds.pairs)
        frames = [frame for frame in self._frames.values() if len({int(fragment[i]) for i in frame}) > 1]
        return self._with_sites(_gathered([*clusters, *frames], fragment, x, self.box), self.box)

    def _with_sites(self, positions: np.ndarray, box: np.ndarray) -> np.ndarray:
        """Return positions (N, 3), nm, with virtual sites at the images nearest to their first particles."""
        sites = np.fromiter(self._frames, dtype=np.int64, count=len(self._frames))
        first = np.array([self._first(site) for site in sites.tolist()], dtype=np.int64)
        arms = positions[sites] - positions[first]
        shifts = wrapped(arms, box, np.round) - arms
        cut = (np.linalg.norm(arms, axis=1) > LONGEST_BOND) & shifts.any(axis=1)
        if not cut.any():
            return positions
        x = positions.copy()
        x[sites[cut]] += shifts[cut]
        return x

    def _first(self, site: int) -> int:
        """Return the first particle of a virtual site; of one that other sites place, that of the first of these."""
        first = self._frames[site][0]
        return self._first(first) if first in self._frames else first

    def refuse_cut(self, positions: np.ndarray, kinds: Sequence[np.ndarray], describe: Callable[[Any], str]) -> None:
        """Refuse positions at which a body is not whole, since they would become its shape.

        Args:
            positions: (N, 3), nm.
            kinds: particle indices of the bodies of each kind, (m, k).
            describe: names particle indices in messages.

        Raises:
            RigidityError: the boundary cuts a body, or a bond within it is broken.
        """
        whole = self.whole(positions, [cluster for clusters in kinds for cluster in clusters])
        shifts = whole - positions
        cut = next((clusters for clusters in kinds if (np.ptp(shifts[clusters], axis=1) > SHIFTED).any()), None)
        if cut is None:
            refuse_broken(self._within(kinds), positions, None, self._topology)
            return
        worst = cut[np.ptp(shifts[cut], axis=1).max(axis=1).argmax()]
        extent, whole_extent = (float(np.linalg.norm(np.ptp(x[worst], axis=0))) for x in (positions, whole))
        raise RigidityError(
            f"the periodic boundary cuts {describe(worst)}: it extends over {extent:.3g} nm at these positions, but "
            f"over {whole_extent:.3g} nm when it is whole. Take positions = make_whole(system, positions, topology, "
            "bodies)"
        )

    def _within(self, kinds: Sequence[np.ndarray]) -> Bonds:
        """Return the bonds within bodies whose length the System has."""
        owner, number = np.full(self._particles, -1), 0
        for clusters in kinds:
            owner[clusters] = np.arange(number, number + len(clusters))[:, None]
            number += len(clusters)
        ends = owner[self.bonds.pairs]
        return self.bonds.selected((ends[:, 0] == ends[:, 1]) & (ends[:, 0] >= 0) & ~np.isnan(self.bonds.lengths))


def _gathered(
    clusters: Sequence[Any] | np.ndarray, fragment: np.ndarray, positions: np.ndarray, box: np.ndarray
) -> np.ndarray:
    """Return positions at which the fragments of each cluster are nearest to its first atom, (N, 3), nm.

    Args:
        clusters: particle indices of each cluster.
        fragment: number of the fragment of each atom, which bonds join, (N,).
        positions: (N, 3), nm.
        box: box vectors as rows, (3, 3), nm.

    Raises:
        RigidityError: a cluster has moved, and is longer than half the box.
    """
    if not _are_scattered(clusters, fragment, positions, box):
        return positions
    x, fragment, inverse = positions.copy(), fragment.copy(), np.linalg.inv(box)
    order = np.argsort(fragment, kind="stable")
    present, starts = np.unique(fragment[order], return_index=True)
    members = dict(zip(present.tolist(), np.split(order, starts[1:]), strict=True))
    for cluster in clusters:
        atoms = np.asarray(cluster)
        numbers, first = np.unique(fragment[atoms], return_index=True)
        if len(numbers) == 1:
            continue
        arms = x[atoms[first]] - x[atoms[0]]
        shifts = wrapped(arms, box, np.round) - arms
        for number, shift in zip(numbers.tolist(), shifts, strict=True):
            if shift.any():
                x[members[number]] += shift
        if shifts.any() and np.ptp(x[atoms] @ inverse, axis=0).max() >= 0.5:
            raise RigidityError(
                f"the atoms {as_ranges(atoms)} of a body or a virtual site are further apart than half the box, and no "
                "bonds join them, so that nobody knows whether the periodic boundary is between them: join them by a "
                "HarmonicBondForce with a strength above 0, which does no work in a rigid body"
            )
        # Bodies that share a fragment move together from here on.
        together = np.concatenate([members.pop(number) for number in numbers.tolist()])
        members[int(numbers[0])] = together
        fragment[together] = numbers[0]
    return x


def _are_scattered(
    clusters: Sequence[Any] | np.ndarray, fragment: np.ndarray, positions: np.ndarray, box: np.ndarray
) -> bool:
    """Return whether a fragment of a cluster is nearer to its first atom at another image; see `_gathered`."""
    sizes = np.array(list(map(len, clusters)), dtype=np.int64)
    if not len(sizes):
        return False
    atoms = np.concatenate([np.asarray(cluster, dtype=np.int64) for cluster in clusters])
    number = np.repeat(np.arange(len(sizes)), sizes)
    _, first = np.unique(number * len(fragment) + fragment[atoms], return_index=True)
    starts = np.cumsum(sizes) - sizes
    arms = positions[atoms[first]] - positions[atoms[starts[number[first]]]]
    return bool((wrapped(arms, box, np.round) != arms).any())


# --- molecules that are cut -------------------------------------------------------------------------------------------


def refuse_cut_molecules(system: openmm.System, positions: np.ndarray, box: Any, bonds: Bonds | None = None) -> None:
    """Refuse positions at which the boundary cuts a constraint, or a bond that ignores the box.

    It would pull its atoms together through everything between them.

    Args:
        system: openmm.System.
        positions: (N, 3), nm.
        box: box vectors as rows, (3, 3), nm.
        bonds: bonds of the System, if they have been read already.

    Raises:
        RigidityError: a molecule is cut; the message names the two atoms that are furthest apart.
    """
    if not system.usesPeriodicBoundaryConditions():
        return
    bonds = Bonds.of_system(system) if bonds is None else bonds
    lengths = bonds.measured(positions, np.array(box))
    long = np.flatnonzero(lengths > bonds.longest)
    arms = positions[bonds.pairs[long, 1]] - positions[bonds.pairs[long, 0]]
    cut = long[np.linalg.norm(wrapped(arms, np.array(box), np.round), axis=1) <= bonds.longest[long]]
    if not cut.size:
        return
    worst = cut[np.argmax(lengths[cut])]
    one, other = bonds.pairs[worst].tolist()
    count = f" ({len(cut)} bonds or constraints are cut)" if len(cut) > 1 else ""
    raise RigidityError(
        f"atoms {one} and {other} belong {bonds.lengths[worst]:.4f} nm apart, but are {lengths[worst]:.4g} nm apart: "
        f"the periodic boundary cuts their molecule{count}. {MAKE_WHOLE}"
    )
