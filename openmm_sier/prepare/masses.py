"""Hydrogen mass repartitioning: the fastest motions become slower, and averages of positions hardly change.

Source: Bennett, J. Comput. Phys. 19, 267 (1975); Feenstra, Hess and Berendsen, J. Comput. Chem. 20, 786 (1999), who
also repartition the masses of water.
"""

from collections import Counter
from typing import Any

import openmm
from openmm import unit

from openmm_sier.system import tables
from openmm_sier.system.arguments import quantity_to_float
from openmm_sier.system.hydrogens import hydrogens_among, partners_of
from openmm_sier.system.links import links_of
from openmm_sier.system.tables import HEAVIEST_HYDROGEN, HEAVIEST_IN_CHAINS
from openmm_sier.system.user_warnings import warn

#: Minimum mass left to an atom bonded to hydrogens, dalton.
LIGHTEST_CENTRE = 6.0

#: Minimum mass of repartitioned hydrogens, dalton; hydrogens that would get less are not changed, as in HD.
LIGHTEST_HYDROGEN = 1.0


def checked_mass(mass: Any) -> float:
    """Return a mass of hydrogens in dalton, from a quantity or a number.

    Raises:
        ValueError: the mass is not from `LIGHTEST_HYDROGEN` to `HEAVIEST_HYDROGEN`.
        TypeError: `mass` is not a mass.
    """
    value = quantity_to_float("hydrogenMass", mass, unit.dalton, "dalton")
    if not LIGHTEST_HYDROGEN <= value <= HEAVIEST_HYDROGEN:
        raise ValueError(
            f"hydrogenMass must be from {LIGHTEST_HYDROGEN:g} to {HEAVIEST_HYDROGEN:g} dalton, got {value:g}"
        )
    return value


def set_hydrogen_masses(system: openmm.System, mass: float) -> str:
    """Set the mass of all hydrogens, in water too, at the expense of the atoms they are bonded to.

    The mass of every molecule is conserved. Hydrogens of an atom that is bonded to another heavy atom get at most
    `HEAVIEST_IN_CHAINS`, and hydrogens of an atom that would become lighter than `LIGHTEST_CENTRE` get less. Previous
    masses of hydrogens do not matter.

    Args:
        system: openmm.System; its masses are changed.
        mass: dalton, from `checked_mass`.

    Returns:
        A sentence on the change.
    """
    masses, counts = tables.masses(system).copy(), Counter[float]()
    partners = partners_of(masses, links_of(system))
    for centre, hydrogens in hydrogens_among(masses, partners).items():
        total = masses[centre] + masses[hydrogens].sum()
        spared = (total - LIGHTEST_CENTRE) / len(hydrogens)
        most = mass if partners[centre].keys() <= set(hydrogens) else min(mass, HEAVIEST_IN_CHAINS)
        if spared < LIGHTEST_HYDROGEN < mass:
            continue
        share = min(most, max(spared, LIGHTEST_HYDROGEN))
        counts[round(share, 2)] += len(hydrogens)
        masses[hydrogens] = share
        masses[centre] = total - share * len(hydrogens)
        for atom in (centre, *hydrogens):
            system.setParticleMass(int(atom), float(masses[atom]))
    tables.forget()
    if not counts:
        warn("hydrogenMass has no effect: the System has no hydrogens whose mass could be changed")
        return "There are no hydrogens whose mass could be changed."
    counted = " and ".join(f"{count} hydrogens have {each:g} dalton" for each, count in sorted(counts.items()))
    return (
        f"{counted}: averages of positions do not change, but of angles between constrained bonds slightly, and motion "
        "is slower."
    )
