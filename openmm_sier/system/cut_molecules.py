"""Molecules and bodies that the periodic boundary cuts: found by bonds or by gaps, made whole, and refused."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import openmm
from openmm import app, unit

from openmm_sier.dynamics.bodies import RigidityError
from openmm_sier.dynamics.constraints.graph import joined
from openmm_sier.system import tables
from openmm_sier.system.bonded_terms import harmonic_bonds
from openmm_sier.system.boxes import widths, wrapped
from openmm_sier.system.inner_forces import all_forces

#: kJ/mol. A bond that is longer than its own length and has more energy than this is broken: bonds dissociate with 400.
BREAKING = 1000.0

#: nm. A constraint is broken beyond its length by this much: bonds of hydrogen have then more energy than `BREAKING`.
#: Between two places for the boundary, gaps that differ by less do not decide.
STRETCH = 0.1

#: nm. The longest bond whose length no force field tells; those of iodine and of heavy metals have 0.3.
LONGEST_BOND = 0.4

#: Advice, for messages.
MAKE_WHOLE = "Make molecules whole: context.setPositions(make_whole(system, positions))"
IF_CUT = f"Does the periodic boundary cut the molecule? {MAKE_WHOLE}"


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
    def of_pairs(
        cls, pairs: Any, lengths: Any = math.nan, longest: Any = LONGEST_BOND, periodic: bool = False
    ) -> Bonds:
        """Make bonds from pairs of particles (b, 2); a single number is that of all bonds."""
        pairs = np.array(pairs, dtype=np.int64).reshape(-1, 2)
        each = np.broadcast_to(np.array(lengths, dtype=float), len(pairs))
        return cls(pairs, each, np.broadcast_to(longest, len(pairs)), np.broadcast_to(periodic, len(pairs)))

    @classmethod
    def of_topology(cls, topology: app.Topology) -> Bonds:
        """Read the bonds of an openmm.app.Topology."""
        return cls.of_pairs([(bond[0].index, bond[1].index) for bond in topology.bonds()])

    @classmethod
    def guessed(cls, topology: app.Topology) -> Bonds:
        """Read the bonds of a topology, and join atoms without bonds to the first atom of their residue."""
        bonds = cls.of_topology(topology)
        known, pairs = set(bonds.pairs.ravel().tolist()), []
        for residue in topology.residues():
            first, *others = (atom.index for atom in residue.atoms())
            pairs += [(first, other) for other in others if other not in known]
        return cls.merged(bonds, cls.of_pairs(pairs))

    @classmethod
    def of_system(cls, system: openmm.System) -> Bonds:
        """Read constraints, harmonic bonds that do work, and bonds of virtual sites to their first particles."""
        pairs, lengths = tables.constraints(system)
        kinds = [cls.of_pairs(pairs, lengths, lengths + STRETCH)]
        for force in _harmonic_bond_forces(system):
            pairs, lengths, strengths = harmonic_bonds(force)
            acts = strengths > 0
            longest = lengths[acts] + np.sqrt(2 * BREAKING / strengths[acts])
            kinds.append(cls.of_pairs(pairs[acts], lengths[acts], longest, force.usesPeriodicBoundaryConditions()))
        sites = [i for i in range(system.getNumParticles()) if system.isVirtualSite(i)]
        kinds.append(cls.of_pairs([(i, system.getVirtualSite(i).getParticle(0)) for i in sites]))
        return cls.merged(*kinds)

    @classmethod
    def without_strength(cls, system: openmm.System) -> Bonds:
        """Read harmonic bonds that do no work, by which OpenMM knows its molecules; their lengths may be wrong."""
        kinds = [cls.of_pairs([])]
        for force in _harmonic_bond_forces(system):
            pairs, lengths, strengths = harmonic_bonds(force)
            idle = strengths <= 0
            kinds.append(cls.of_pairs(pairs[idle], lengths[idle], lengths[idle] + STRETCH))
        return cls.merged(*kinds)

    @classmethod
    def merged(cls, *kinds: Bonds) -> Bonds:
        """Return the bonds of several kinds. Of two bonds between the same atoms the earlier one counts."""
        pairs, *others = map(np.concatenate, zip(*kinds, strict=True))
        pairs = np.sort(pairs, axis=1)
        _, first = np.unique(pairs, axis=0, return_index=True)
        return cls(*(column[np.sort(first)] for column in (pairs, *others)))

    def selected(self, mask: np.ndarray) -> Bonds:
        """Return some of the bonds, by a mask (b,)."""
        return Bonds(*(column[mask] for column in self))

    def measured(self, positions: np.ndarray, box: np.ndarray | None) -> np.ndarray:
        """Return lengths at positions (N, 3) in nm, (b,), nm."""
        arms = positions[self.pairs[:, 1]] - positions[self.pairs[:, 0]]
        if box is not None:
            arms[self.periodic] = wrapped(arms[self.periodic], box, np.round)
        return np.linalg.norm(arms, axis=1)


def _harmonic_bond_forces(system: openmm.System) -> Iterator[openmm.HarmonicBondForce]:
    """Give all HarmonicBondForces of a System, also those within other Forces."""
    for part in all_forces(system):
        if isinstance(part.force, openmm.HarmonicBondForce):
            yield part.force


def joined_by(bonds: Bonds, positions: np.ndarray, box: np.ndarray | None) -> np.ndarray:
    """Return positions at which no bond is cut, (N, 3), nm: atoms move next to those that they are bonded to.

    Molecules that are whole stay where they are, even if another image of an atom is nearer.

    Args:
        bonds: that keep molecules together.
        positions: (N, 3), nm.
        box: vectors as rows, (3, 3), nm; None without a box.
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

    The first of each molecule has the particle n next, and no bond, -1; and so has the particle n. Short bonds are
    taken before long ones: a restraint between two molecules must not decide before their bonds.
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


def refuse_broken(bonds: Bonds, positions: np.ndarray, box: np.ndarray | None, topology: app.Topology | None) -> None:
    """Refuse bonds that are too long at positions (N, 3) in nm.

    Raises:
        RigidityError: a bond is too long; the message has the longest, with residues if there is a topology.
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
    images = "" if box is None else ", at the nearest images"
    wrong_box = "has a box cut them that the System lacks" if box is None else "is the box that of another system"
    more = f" ({len(broken)} bonds are too long)" if len(broken) > 1 else ""
    stale = ", is the bond left from another file (a record CONECT)" if by_topology else ""
    raise RigidityError(
        f"a molecule is broken: {names} {expected}, but are {lengths[worst]:.4g} nm apart{images}{more}. Is an atom "
        f"misplaced, are residues missing between the two{stale}, or {wrong_box}?"
    )


# --- bodies and groups without bonds ----------------------------------------------------------------------------------


class Wholeness:
    """Make the molecules and bodies of a System whole.

    Atoms that bonds join are next to each other. Atoms that belong together without such bonds, those of a rigid body
    and those that bonds without strength join, are on one side of the widest gap between them along each edge of the
    box. So a body without bonds that is longer than half the box is whole as long as its own gaps are narrower than the
    one around it. A bond without strength whose length is that of the gap bridges a wider one.

    Attributes:
        bonds: of the System and of the topology.
        box: default box vectors as rows, (3, 3), nm; None in a System that is not periodic.
    """

    def __init__(self, system: openmm.System, topology: app.Topology | None = None):
        self._topology = topology
        self._particles = system.getNumParticles()
        self.bonds = Bonds.of_system(system)
        if topology is not None:
            self.bonds = Bonds.merged(self.bonds, Bonds.of_topology(topology))
        self._idle = Bonds.without_strength(system)
        vectors = [vector.value_in_unit(unit.nanometer) for vector in system.getDefaultPeriodicBoxVectors()]
        self.box = np.array(vectors) if system.usesPeriodicBoundaryConditions() else None

    def whole(self, positions: np.ndarray, clusters: Sequence[Any] | np.ndarray = (), box: Any = None) -> np.ndarray:
        """Return positions at which nothing is cut, (N, 3), nm; molecules that are whole keep theirs to the last bit.

        Args:
            positions: (N, 3), nm.
            clusters: particle indices of each body.
            box: vectors, if they are not the default ones, nm.
        """
        if self.box is None:
            return positions
        box = self.box if box is None else np.array(box)
        # In a body the nearest images of two atoms are not enough.
        bonds = self.bonds._replace(periodic=self.bonds.periodic & (len(clusters) == 0))
        x = joined_by(bonds, positions, box)
        agree = np.abs(self._idle.measured(x, None) - self._idle.lengths) <= STRETCH
        pairs = np.concatenate([self.bonds.pairs, self._idle.pairs[agree]])
        if len(clusters):
            x = _gathered(clusters, joined(len(x), pairs), x, box)
            pairs = np.concatenate([pairs, *(np.column_stack([each[:-1], each[1:]]) for each in clusters)])
        if not len(self._idle.pairs):
            return x
        part = joined(len(x), pairs)
        return _gathered(_groups(part, self._idle.pairs), part, x, box)

    def refuse_cut(
        self, positions: np.ndarray, clusters: np.ndarray, describe: Callable[[Any], str], box: Any = None
    ) -> None:
        """Refuse positions at which a body is not whole: they would become its shape.

        Args:
            positions: (N, 3), nm.
            clusters: particle indices of each body, (m, k).
            describe: gives a name to particle indices, for messages.
            box: vectors, if they are not the default ones, nm.

        Raises:
            RigidityError: the boundary cuts a body, or a bond within it is broken.
        """
        whole = self.whole(positions, clusters, box)
        moved = np.ptp((whole - positions)[clusters], axis=1).max(axis=1)
        if not moved.any():
            refuse_broken(self._within(clusters), positions, None, self._topology)
            return
        worst = clusters[moved.argmax()]
        here, there = (float(np.linalg.norm(np.ptp(x[worst], axis=0))) for x in (positions, whole))
        raise RigidityError(
            f"the periodic boundary cuts {describe(worst)}: it extends over {here:.3g} nm at these positions, and over "
            f"{there:.3g} nm when it is whole. Take positions = make_whole(system, positions, topology, bodies). If "
            "the body is longer than half the box and has a gap as wide, add a bond of the gap's length without "
            "strength (HarmonicBondForce)"
        )

    def _within(self, clusters: np.ndarray) -> Bonds:
        """Return the bonds within bodies that have a length in the System."""
        owner = np.full(self._particles, -1)
        owner[clusters] = np.arange(len(clusters))[:, None]
        ends = owner[self.bonds.pairs]
        return self.bonds.selected((ends[:, 0] == ends[:, 1]) & (ends[:, 0] >= 0) & ~np.isnan(self.bonds.lengths))


def _groups(part: np.ndarray, pairs: np.ndarray) -> list[np.ndarray]:
    """Return the atoms of each group of parts that pairs join; `part` has a number for each atom, (N,)."""
    group = joined(len(part), np.concatenate([part[pairs], np.column_stack([np.arange(len(part)), part])]))
    several = np.unique(group[pairs[part[pairs[:, 0]] != part[pairs[:, 1]]]])
    return [np.flatnonzero(group == each) for each in several.tolist()]


def _gathered(
    clusters: Sequence[Any] | np.ndarray, part: np.ndarray, positions: np.ndarray, box: np.ndarray
) -> np.ndarray:
    """Return positions at which the parts of each cluster are on the same side of its widest gaps, (N, 3), nm.

    Args:
        clusters: particle indices of each.
        part: for each atom a number that atoms joined by bonds share, (N,).
        positions: (N, 3), nm.
        box: vectors as rows, (3, 3), nm.
    """
    several = [atoms for each in clusters if (part[(atoms := np.asarray(each))] != part[atoms[0]]).any()]
    x, inverse, narrow = positions, np.linalg.inv(box), STRETCH / widths(box)
    # Clusters that share a part move it in turn.
    for _ in several:
        before = x
        for atoms in several:
            fractions = x[atoms] @ inverse
            if np.ptp(fractions, axis=0).max() < 0.5:
                continue
            _, first, number = np.unique(part[atoms], return_index=True, return_inverse=True)
            periods = np.column_stack(list(map(_periods, fractions.T, narrow)))[first]
            periods -= periods[number[0]]
            for each, shift in zip(part[atoms[first]].tolist(), periods, strict=True):
                if shift.any():
                    x = x + np.where((part == each)[:, None], shift @ box, 0.0)
        if x is before:
            break
    return x


def _periods(fractions: np.ndarray, narrow: float) -> np.ndarray:
    """Return by how many periods points move to the same side of their widest gap, (k,).

    Args:
        fractions: of the edge of the box at which the points are, (k,).
        narrow: by which fraction of the edge the gap must be wider than the one around the points as they are.
    """
    on_circle = fractions % 1.0
    ordered = np.sort(on_circle)
    gaps = np.diff(ordered, append=ordered[0] + 1)
    widest = int(gaps.argmax())
    if gaps[widest] <= 1 - np.ptp(fractions) + narrow:
        return np.zeros(len(fractions))
    start = ordered[(widest + 1) % len(ordered)]
    return np.round(on_circle + (on_circle < start) - fractions)


# --- molecules that pull themselves together --------------------------------------------------------------------------


def refuse_cut_molecules(system: openmm.System, positions: np.ndarray, box: Any, bonds: Bonds | None = None) -> None:
    """Refuse positions at which the boundary cuts a constraint or a bond that does not know the box.

    They would pull the two parts together, through everything that is between them.

    Args:
        system: openmm.System.
        positions: (N, 3), nm.
        box: box vectors as rows, (3, 3), nm.
        bonds: those of the System, if they have been read already.

    Raises:
        RigidityError: a molecule is cut; the message has the two atoms that are furthest apart.
    """
    if not system.usesPeriodicBoundaryConditions():
        return
    bonds = Bonds.of_system(system) if bonds is None else bonds
    # Virtual sites have no lengths, and are put in their places.
    pulling = bonds.selected(~np.isnan(bonds.lengths))
    lengths = pulling.measured(positions, np.array(box))
    long = np.flatnonzero(lengths > pulling.longest)
    arms = positions[pulling.pairs[long, 1]] - positions[pulling.pairs[long, 0]]
    cut = long[np.linalg.norm(wrapped(arms, np.array(box), np.round), axis=1) <= pulling.longest[long]]
    if not cut.size:
        return
    worst = cut[np.argmax(lengths[cut])]
    one, other = pulling.pairs[worst].tolist()
    more = f" ({len(cut)} bonds or constraints are cut)" if len(cut) > 1 else ""
    raise RigidityError(
        f"atoms {one} and {other} belong {pulling.lengths[worst]:.4f} nm apart, but are {lengths[worst]:.4g} nm apart: "
        f"the periodic boundary cuts their molecule{more}. {MAKE_WHOLE}"
    )
