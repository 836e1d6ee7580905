"""Hydrogens of a System, which knows no elements."""

from collections.abc import Mapping

import numpy as np
import openmm

from openmm_sier.system import tables
from openmm_sier.system.find_bodies import Links
from openmm_sier.system.tables import HEAVIEST_HYDROGEN

#: nm. The longest bonds of hydrogen, to iodine and silicon, have 0.16 and 0.15; what is further away is restrained.
LONGEST_TO_HYDROGEN = 0.17


def hydrogens(system: openmm.System) -> dict[int, list[int]]:
    """Return hydrogens of a System, which knows no elements, by the atom that each is bonded to.

    A hydrogen is an atom of no more than `HEAVIEST_HYDROGEN`. Of the atoms that bonds and constraints of up to
    `LONGEST_TO_HYDROGEN` join to it, the nearest is heavier or is joined to more atoms than it is, and all the others
    are joined to that one. So a methyl's carbon, which heavy hydrogens may have made lighter than they are, is none. An
    atom without such a bond is judged by its custom bonds. Frozen atoms, virtual sites, Drude particles and H2 are left
    out.
    """
    masses = tables.masses(system)
    return hydrogens_among(masses, partners_of(masses, Links(system)))


def hydrogens_among(masses: np.ndarray, partners: Mapping[int, Mapping[int, float]]) -> dict[int, list[int]]:
    """Find hydrogens, as `hydrogens` does, from masses, (N,), dalton, and the result of `partners_of`."""
    found: dict[int, list[int]] = {}
    for atom in sorted(atom for atom in partners if masses[atom] <= HEAVIEST_HYDROGEN):
        lengths = partners[atom]
        near = sorted((i for i in lengths if 0 < lengths[i] <= LONGEST_TO_HYDROGEN), key=lengths.__getitem__)
        joined = near or [i for i in lengths if not lengths[i]]
        if not joined:
            continue
        centre = joined[0]
        is_centre = masses[centre] > masses[atom] or len(partners[centre]) > len(lengths)
        if is_centre and set(joined) <= {centre, *partners[centre]}:
            found.setdefault(centre, []).append(atom)
    return found


def partners_of(masses: np.ndarray, links: Links) -> dict[int, dict[int, float]]:
    """Find the partners of each moving particle by bonds and constraints, with distances in nm; 0 for custom bonds."""
    lengths = dict(zip(map(tuple, np.sort(links.bonds).tolist()), links.lengths.tolist(), strict=True))
    lengths |= links.constraints.by_pair()
    found: dict[int, dict[int, float]] = {}
    for first, second in np.sort(links.covalent()).tolist():
        if masses[first] > 0 and masses[second] > 0:
            length = lengths.get((first, second), 0.0)
            found.setdefault(first, {})[second] = length
            found.setdefault(second, {})[first] = length
    return found
