"""Identify the hydrogens of a System, which stores no elements."""

from collections.abc import Mapping

import numpy as np
import openmm

from openmm_sier.system import tables
from openmm_sier.system.links import Links, links_of
from openmm_sier.system.tables import HEAVIEST_HYDROGEN

#: Maximum length in nm of a bond to hydrogen: those to iodine and silicon have 0.16 and 0.15. Longer ones are
#: restraints.
LONGEST_TO_HYDROGEN = 0.17


def hydrogens(system: openmm.System) -> dict[int, list[int]]:
    """Return the hydrogens of a System, grouped by the atom they are bonded to.

    A hydrogen has a mass of at most `HEAVIEST_HYDROGEN`. Its partners are the atoms joined to it by bonds or
    constraints of at most `LONGEST_TO_HYDROGEN`; the nearest partner is heavier or has more partners, and is joined to
    all other partners. (After mass repartitioning a methyl carbon can be lighter than its hydrogens.) Without such a
    bond, custom bonds count instead. Frozen atoms, virtual sites, Drude particles and H2 are left out.
    """
    masses = tables.masses(system)
    return hydrogens_among(masses, partners_of(masses, links_of(system)))


def hydrogens_among(masses: np.ndarray, partners: Mapping[int, Mapping[int, float]]) -> dict[int, list[int]]:
    """Return hydrogens as `hydrogens` does, from masses (N,) in dalton and the result of `partners_of`."""
    by_centre: dict[int, list[int]] = {}
    for atom in sorted(atom for atom in partners if masses[atom] <= HEAVIEST_HYDROGEN):
        lengths = partners[atom]
        near = sorted((i for i in lengths if 0 < lengths[i] <= LONGEST_TO_HYDROGEN), key=lengths.__getitem__)
        joined = near or [i for i in lengths if not lengths[i]]
        if not joined:
            continue
        centre = joined[0]
        is_centre = masses[centre] > masses[atom] or len(partners[centre]) > len(lengths)
        if is_centre and set(joined) <= {centre, *partners[centre]}:
            by_centre.setdefault(centre, []).append(atom)
    return by_centre


def partners_of(masses: np.ndarray, links: Links) -> dict[int, dict[int, float]]:
    """Return the partners of each moving particle by bonds and constraints, with lengths in nm; 0 for custom bonds."""
    lengths = dict(zip(map(tuple, np.sort(links.bonds).tolist()), links.lengths.tolist(), strict=True))
    lengths |= links.constraints.by_pair()
    partners: dict[int, dict[int, float]] = {}
    for first, second in np.sort(links.covalent()).tolist():
        if masses[first] > 0 and masses[second] > 0:
            length = lengths.get((first, second), 0.0)
            partners.setdefault(first, {})[second] = length
            partners.setdefault(second, {})[first] = length
    return partners
