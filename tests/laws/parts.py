"""Particles, constraints and terms of which molecules are made."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
import openmm

CARBON, NITROGEN, OXYGEN, HYDROGEN = 12.011, 14.007, 15.999, 1.008

#: kJ/mol/nm^2 and kJ/mol/rad^2, as in force fields.
BOND, BOND_TO_HYDROGEN, ANGLE, ANGLE_OF_HYDROGEN = 2.5e5, 2.8e5, 500.0, 300.0


@dataclass
class Parts:
    """Particles, constraints and terms of a molecule, by its own numbers of particles.

    Attributes:
        masses: dalton.
        places: nm; those of virtual sites are near their particles.
        charges: elementary charges.
        constraints: pairs, whose lengths are those in `places`.
        bonds: pairs with constants, kJ/mol/nm^2.
        angles: triples with constants, kJ/mol/rad^2.
        torsions: four particles each.
        sites: by particle, those it depends on and a function of their numbers in the System.
        bodies: particles of each named body.
        links: pairs whose nonbonded interaction bonds would exclude, in addition to `constraints` and `bonds`.
    """

    masses: list[float] = field(default_factory=list)
    places: list[np.ndarray] = field(default_factory=list)
    charges: list[float] = field(default_factory=list)
    constraints: list[tuple[int, int]] = field(default_factory=list)
    bonds: list[tuple[int, int, float]] = field(default_factory=list)
    angles: list[tuple[int, int, int, float]] = field(default_factory=list)
    torsions: list[tuple[int, int, int, int]] = field(default_factory=list)
    sites: dict[int, tuple[tuple[int, ...], Callable[..., openmm.VirtualSite]]] = field(default_factory=dict)
    bodies: list[list[int]] = field(default_factory=list)
    links: list[tuple[int, int]] = field(default_factory=list)

    def add(self, mass: float, place, charge: float) -> int:
        """Add a particle; return its number."""
        self.masses.append(mass)
        self.places.append(np.array(place, dtype=float))
        self.charges.append(charge)
        return len(self.masses) - 1

    def add_site(self, parents: tuple[int, ...], make: Callable[..., openmm.VirtualSite], charge: float) -> int:
        """Add a virtual site; return its number."""
        site = self.add(0.0, np.mean([self.places[i] for i in parents], axis=0) + 0.01, charge)
        self.sites[site] = (parents, make)
        self.links += [(i, site) for i in parents]
        return site

    def join(self, i: int, j: int, held: bool) -> None:
        """Add a bond or a constraint."""
        if held:
            self.constraints.append((i, j))
        else:
            light = min(self.masses[i], self.masses[j]) < 2
            self.bonds.append((i, j, BOND_TO_HYDROGEN if light else BOND))

    def bend(self, bonded: list[tuple[int, int]]) -> None:
        """Add an angle for each two bonds of an atom."""
        for one, other in combinations(bonded, 2):
            if shared := set(one) & set(other):
                (centre,) = shared
                i, k = (set(one) - shared).pop(), (set(other) - shared).pop()
                light = min(self.masses[i], self.masses[k]) < 2
                self.angles.append((i, centre, k, ANGLE_OF_HYDROGEN if light else ANGLE))
