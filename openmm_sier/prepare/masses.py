"""Heavy hydrogens: averages of positions do not depend on masses, and the fastest motions become slower.

Source: Bennett, J. Comput. Phys. 19, 267 (1975); Feenstra, Hess and Berendsen, J. Comput. Chem. 20, 786 (1999), who
make the hydrogens of water heavier too.
"""

from collections import Counter
from typing import Any

import openmm
from openmm import unit

from openmm_sier.system import tables
from openmm_sier.system.arguments import quantity_to_float
from openmm_sier.system.find_bodies import Links
from openmm_sier.system.hydrogens import hydrogens_among, partners_of
from openmm_sier.system.tables import HEAVIEST_HYDROGEN, HEAVIEST_IN_CHAINS
from openmm_sier.system.user_warnings import warn

#: Dalton, below which no atom is made lighter for its hydrogens.
LIGHTEST_CENTRE = 6.0

#: Dalton. The least that may be asked for; hydrogens that would get less are left as they are, as in HD.
LIGHTEST_HYDROGEN = 1.0


def checked_mass(mass: Any) -> float:
    """Return a mass of hydrogens in dalton, from a quantity or a number.

    Raises:
        ValueError: it is not from `LIGHTEST_HYDROGEN` to `HEAVIEST_HYDROGEN`.
        TypeError: it is no mass.
    """
    found = quantity_to_float("hydrogenMass", mass, unit.dalton, "dalton")
    if not LIGHTEST_HYDROGEN <= found <= HEAVIEST_HYDROGEN:
        raise ValueError(
            f"hydrogenMass must be from {LIGHTEST_HYDROGEN:g} to {HEAVIEST_HYDROGEN:g} dalton, got {found:g}"
        )
    return found


def set_hydrogen_masses(system: openmm.System, mass: float) -> str:
    """Set the mass of all hydrogens, in water too, and take the difference from the atoms that they are bonded to.

    The mass of every molecule stays. Hydrogens of an atom that is bonded to another heavy atom get no more than
    `HEAVIEST_IN_CHAINS`, and those of one that would become lighter than `LIGHTEST_CENTRE` get less. It does not
    matter which masses hydrogens had before.

    Args:
        system: openmm.System; its masses are changed.
        mass: dalton, as `checked_mass` gives it.

    Returns:
        What was done, in a sentence.
    """
    masses, given = tables.masses(system), Counter[float]()
    partners = partners_of(masses, Links(system))
    for centre, found in hydrogens_among(masses, partners).items():
        total = masses[centre] + masses[found].sum()
        spared = (total - LIGHTEST_CENTRE) / len(found)
        most = mass if partners[centre].keys() <= set(found) else min(mass, HEAVIEST_IN_CHAINS)
        if spared < LIGHTEST_HYDROGEN < mass:
            continue
        share = min(most, max(spared, LIGHTEST_HYDROGEN))
        given[round(share, 2)] += len(found)
        masses[found] = share
        masses[centre] = total - share * len(found)
        for atom in (centre, *found):
            system.setParticleMass(int(atom), float(masses[atom]))
    if not given:
        warn("hydrogenMass has no effect: the System has no hydrogens whose mass could be changed")
        return "There are no hydrogens whose mass could be changed."
    said = " and ".join(f"{count} hydrogens have {each:g} dalton" for each, count in sorted(given.items()))
    return f"{said}: averages of positions do not change, but motion is slower."
