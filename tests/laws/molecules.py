"""Kinds of molecules from which the laws mix Systems.

Each kind is a frozen dataclass whose options are plain values, so that its `repr` is Python that makes it again. The
method `parts` says what the molecule puts into a System. The first value of each option is the simplest, to which
Hypothesis shrinks.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np
import openmm

from tests.laws.parts import (
    ANGLE,
    BOND,
    CARBON,
    HYDROGEN,
    NITROGEN,
    OXYGEN,
    Parts,
)

#: Of bonds to anchors, and of beads that represent residues.
TETHER, COARSE = 500.0, 8000.0

#: Lengths of rigid water, nm. They are numbers of single precision, to which OpenMM's SETTLE rounds.
OH, HH = 98 / 1024, 155 / 1024


def _alternating(number: int, size: float = 0.2) -> float:
    return size * (-1) ** number


# --- small molecules --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Ion:
    """A point; a frozen one has no mass."""

    charge: float = 1.0
    frozen: bool = False

    def parts(self) -> Parts:
        parts = Parts()
        parts.add(0.0 if self.frozen else 22.99, np.zeros(3), self.charge)
        return parts


@dataclass(frozen=True)
class Water:
    """Water of three sites: rigid, with constrained bonds to hydrogens, or flexible."""

    held: str = "rigid"

    def parts(self) -> Parts:
        parts = Parts()
        height = np.sqrt(OH**2 - HH**2 / 4)
        oxygen = parts.add(OXYGEN, [0, 0, 0], -0.8)
        hydrogens = [parts.add(HYDROGEN, [x, height, 0], 0.4) for x in (HH / 2, -HH / 2)]
        for hydrogen in hydrogens:
            parts.join(oxygen, hydrogen, self.held != "flexible")
        if self.held == "rigid":
            parts.constraints.append((hydrogens[0], hydrogens[1]))
        else:
            parts.angles.append((hydrogens[0], oxygen, hydrogens[1], ANGLE))
        return parts


@dataclass(frozen=True)
class Chain:
    """Heavy atoms in a zigzag or in line, each with hydrogens.

    Attributes:
        atoms: number of heavy atoms.
        hydrogens: on each.
        held: which bonds are constraints: "nothing", "hydrogens" or "bonds".
        bends: whether there are angles and torsions.
        straight: whether the heavy atoms are in line; then there are no torsions.
    """

    atoms: int = 2
    hydrogens: int = 0
    held: str = "nothing"
    bends: bool = True
    straight: bool = False

    def parts(self) -> Parts:
        parts = Parts()
        backbone, bonded = [], []
        for i in range(self.atoms):
            side = 0.0 if self.straight else (-1.0) ** i
            place = np.array([0.13 * i, 0.035 * side, 0.0 if self.straight else 0.02 * (i % 3)])
            atom = parts.add((CARBON, NITROGEN, OXYGEN)[i % 3], place, _alternating(i))
            if backbone:
                bonded.append((backbone[-1], atom))
                parts.join(backbone[-1], atom, self.held == "bonds")
            for h in range(self.hydrogens):
                turn = 2 * np.pi * h / 3
                out = [0.1 * (i - (self.atoms - 1) / 2) / self.atoms, np.cos(turn) * (side or 1.0), np.sin(turn)]
                hydrogen = parts.add(HYDROGEN, place + 0.109 * np.array(out) / np.linalg.norm(out), 0.05)
                bonded.append((atom, hydrogen))
                parts.join(atom, hydrogen, self.held != "nothing")
            backbone.append(atom)
        if self.bends:
            parts.bend(bonded)
            if not self.straight:
                parts.torsions += [tuple(backbone[i : i + 4]) for i in range(self.atoms - 3)]
        return parts


#: Directions from the centre of a tetrahedron to its corners.
CORNERS = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3)


@dataclass(frozen=True)
class Star:
    """A heavy atom with constrained bonds to light ones, as a methyl or an amine, and a bond to a heavy atom or none.

    Attributes:
        leaves: number of constrained bonds.
        stem: "none", "bond" or "constraint" to a heavy atom.
        bends: whether there are angles.
    """

    leaves: int = 1
    stem: str = "none"
    bends: bool = True

    def parts(self) -> Parts:
        parts = Parts()
        centre = parts.add((NITROGEN, CARBON)[self.leaves > 2], [0, 0, 0], -0.1 * self.leaves)
        bonded = []
        for corner in CORNERS[: self.leaves]:
            bonded.append((centre, parts.add(HYDROGEN, 0.109 * corner, 0.1)))
            parts.join(*bonded[-1], held=True)
        if self.stem != "none":
            bonded.append((centre, parts.add(CARBON, 0.15 * CORNERS[3], 0.1)))
            parts.join(*bonded[-1], held=self.stem == "constraint")
        if self.bends:
            parts.bend(bonded)
        return parts


@dataclass(frozen=True)
class Ring:
    """A ring of heavy atoms; three that are held are a rigid triangle that is no water."""

    atoms: int = 3
    held: bool = True
    bends: bool = False

    def parts(self) -> Parts:
        parts = Parts()
        angles = 2 * np.pi * np.arange(self.atoms) / self.atoms
        radius = 0.075 / np.sin(np.pi / self.atoms)
        for i, angle in enumerate(angles):
            place = [radius * np.cos(angle), radius * np.sin(angle) * 1.1, 0.01 * (-1) ** i]
            parts.add((CARBON, NITROGEN, OXYGEN)[i % 3], place, _alternating(i))
        bonded = [(i, (i + 1) % self.atoms) for i in range(self.atoms)]
        for i, j in bonded:
            parts.join(i, j, self.held)
        if self.bends:
            parts.bend(bonded)
        return parts


# --- rigid bodies -----------------------------------------------------------------------------------------------------

#: Masses and places of rigid bodies, from the simplest.
SHAPES = {
    "pair": ([14.0, 16.0], [[0, 0, 0], [0.12, 0, 0]]),
    "bent": ([16.0, 2.0, 12.0], [[0, 0, 0], [0.11, 0, 0], [-0.04, 0.13, 0]]),
    "line": ([16.0, 12.0, 16.0], [[-0.12, 0, 0], [0, 0, 0], [0.12, 0, 0]]),
    "crooked line": ([16.0, 12.0, 32.0, 1.0], [[-0.12, 0, 0], [0, 0, 0], [0.15, 0, 0], [0.26, 0, 0]]),
    "handed": ([12.0, 1.0, 35.0, 80.0], [[0, 0, 0], [0.11, 0, 0], [-0.03, 0.17, 0], [-0.03, -0.08, 0.18]]),
    "mirrored": ([12.0, 1.0, 35.0, 80.0], [[0, 0, 0], [0.11, 0, 0], [-0.03, 0.17, 0], [-0.03, -0.08, -0.18]]),
    "plane": ([12.0, 1.0, 16.0, 16.0], [[0, 0, 0], [0.11, 0, 0], [-0.06, 0.11, 0], [-0.06, -0.11, 0]]),
    "square": (4 * [12.0], [[0.1, 0, 0], [0, 0.1, 0], [-0.1, 0, 0], [0, -0.1, 0]]),
    "top": (
        [14.0, 3.0, 3.0, 3.0],
        [[0, 0, 0.04], [0.1, 0, 0], [-0.05, 0.0866025403784, 0], [-0.05, -0.0866025403784, 0]],
    ),
    "ball": (5 * [12.0], np.concatenate([np.zeros((1, 3)), 0.12 * CORNERS]).tolist()),
    "blob": (
        [20.0, 5.0, 14.0, 9.0, 30.0, 12.0],
        [[0, 0, 0], [0.2, 0.05, 0], [0.1, 0.2, -0.1], [-0.15, 0.1, 0.2], [-0.1, -0.2, 0.05], [0.05, -0.1, 0.2]],
    ),
}

#: Those that OpenMM's solvers of constraints hold: they are singular for atoms in line, and for four in a plane.
HELD_BY_CONSTRAINTS = ("pair", "bent", "handed", "mirrored", "top")


def _add_shape(parts: Parts, shape: str, origin=(0.0, 0.0, 0.0), factor: float = 1.0) -> list[int]:
    """Add the particles of a shape, at its places times a factor from an origin; return them."""
    masses, places = SHAPES[shape]
    body = [
        parts.add(mass, np.add(origin, factor * np.array(place)), _alternating(i))
        for i, (mass, place) in enumerate(zip(masses, places, strict=True))
    ]
    parts.links += list(combinations(body, 2))
    return body


def _make_rigid(parts: Parts, body: list[int], named: bool) -> None:
    """Name a body, or hold it by constraints between all its particles."""
    if named:
        parts.bodies.append(body)
    else:
        parts.constraints += list(combinations(body, 2))


@dataclass(frozen=True)
class Body:
    """A rigid body, named or held by constraints."""

    shape: str = "pair"
    named: bool = True

    def parts(self) -> Parts:
        parts = Parts()
        body = _add_shape(parts, self.shape)
        _make_rigid(parts, body, self.named)
        return parts


@dataclass(frozen=True)
class Alike:
    """Two rigid bodies whose shapes differ by a little more than their positions may be off.

    Attributes:
        shape: of the first.
        stretched: factor on the places of the second.
    """

    shape: str = "pair"
    named: bool = True
    stretched: float = 1.03

    def parts(self) -> Parts:
        parts = Parts()
        for origin, factor in ((0.0, 1.0), (0.6, self.stretched)):
            body = _add_shape(parts, self.shape, [0.0, 0.0, origin], factor)
            _make_rigid(parts, body, self.named)
        return parts


@dataclass(frozen=True)
class Jointed:
    """A named body with a flexible tail, at whose end there may be another body.

    Attributes:
        shape: of the first.
        beads: number of atoms between.
        other: shape of the second; "none" for an atom.
        coarse: whether bonds are as soft as those of beads that represent residues.
        bends: whether there are angles.
    """

    shape: str = "pair"
    beads: int = 0
    other: str = "none"
    coarse: bool = False
    bends: bool = False

    def parts(self) -> Parts:
        parts = Parts()
        parts.bodies.append(_add_shape(parts, self.shape))
        reach = max(place[0] for place in SHAPES[self.shape][1])
        path = [int(np.argmax([place[0] for place in SHAPES[self.shape][1]]))]
        origin = parts.places[path[0]]
        for i in range(self.beads):
            path.append(parts.add(CARBON, np.add(origin, [0.15 * (i + 1), 0.04 * (i % 2), 0]), _alternating(i)))
        start = np.add(origin, [0.15 * (self.beads + 1), 0.03, 0.02])
        if self.other == "none":
            path.append(parts.add(CARBON, start, 0.1))
        else:
            places = SHAPES[self.other][1]
            leftmost = int(np.argmin([place[0] for place in places]))
            body = _add_shape(parts, self.other, start - np.array(places[leftmost]) + [0.0, 0.0, 0.1 * (reach < 0)])
            parts.bodies.append(body)
            path.append(body[leftmost])
        bonded = list(pairwise(path))
        parts.bonds += [(i, j, COARSE if self.coarse else BOND) for i, j in bonded]
        if self.bends:
            parts.angles += [
                (i, j, k, 10.0 if self.coarse else ANGLE) for i, j, k in zip(path, path[1:], path[2:], strict=False)
            ]
        return parts


# --- additions to any molecule ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Tethered:
    """A molecule whose first atom has a bond to a particle without mass, which may have a charge."""

    molecule: Molecule
    charge: float = 0.0
    stiff: bool = False

    def parts(self) -> Parts:
        parts = self.molecule.parts()
        centre = np.mean(parts.places, axis=0)
        out = parts.places[0] - centre
        out = out / np.linalg.norm(out) if np.linalg.norm(out) > 1e-3 else np.array([0.0, 0.0, 1.0])
        anchor = parts.add(0.0, parts.places[0] + 0.2 * out, self.charge)
        parts.bonds.append((0, anchor, BOND if self.stiff else TETHER))
        return parts


def _two(i, j):
    return openmm.TwoParticleAverageSite(i, j, 0.7, 0.3)


def _three(i, j, k):
    return openmm.ThreeParticleAverageSite(i, j, k, 0.7, 0.15, 0.15)


def _out(i, j, k):
    return openmm.OutOfPlaneSite(i, j, k, -0.3, -0.3, 4.0)


def _local(i, j, k):
    return openmm.LocalCoordinatesSite([i, j, k], [1, 0, 0], [-1, 0.5, 0.5], [0, -1, 1], [0.02, -0.03, 0.01])


def _shifted(i):
    rows = [openmm.Vec3(1, 0, 0), openmm.Vec3(0, 1, 0), openmm.Vec3(0, 0, 1)]
    return openmm.SymmetrySite(i, *rows, openmm.Vec3(0.01, -0.02, 0.02), False)


#: Number of particles on which a virtual site depends, and a function that makes it, by the kind of site.
SITES = {"two": (2, _two), "three": (3, _three), "out": (3, _out), "local": (3, _local), "shifted": (1, _shifted)}


@dataclass(frozen=True)
class WithSite:
    """A molecule with a charge on a virtual site, as four-site water, whose site may have terms as in files of AMBER.

    Attributes:
        molecule: one whose first atoms have masses.
        site: a kind of `SITES`.
        bond: whether a bond joins it to the first atom.
        angle: whether there is an angle of it with the first and second atom.
        twice: whether there are two such sites, the second for the parents in another order.
    """

    molecule: Molecule
    site: str = "three"
    bond: bool = False
    angle: bool = False
    twice: bool = False

    def parts(self) -> Parts:
        parts = self.molecule.parts()
        count, make = SITES[self.site]
        orders = [tuple(range(count))]
        if self.twice and count > 1:
            orders.append((0, *reversed(range(1, count))) if count > 2 else (1, 0))
        for parents in orders:
            site = parts.add_site(parents, make, -0.2)
            if self.bond:
                parts.bonds.append((parents[0], site, BOND))
            if self.angle:
                parts.angles.append((site, 0, 1, 100.0))
        return parts


@dataclass(frozen=True)
class Frozen:
    """A molecule whose atoms have no mass, with the constraints between them."""

    molecule: Molecule

    def parts(self) -> Parts:
        parts = self.molecule.parts()
        parts.masses = len(parts.masses) * [0.0]
        return parts


Molecule = Ion | Water | Chain | Star | Ring | Body | Alike | Jointed | Tethered | WithSite | Frozen
