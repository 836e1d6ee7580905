"""Estimate how stiffly the surroundings of an atom hold it, by the charges and Lennard-Jones terms of a System.

It is estimated before any position is known.
"""

from collections.abc import Callable, Iterator

import numpy as np
import openmm
from openmm import unit

from openmm_sier.system import tables
from openmm_sier.system.inner_forces import Part, parts

#: Stiffness of a charged atom's surroundings, kJ/mol/nm^2. Librations of water have 400 to 900 cm^-1, with a tail. This
#: value, 1060 cm^-1 for its hydrogens, gives SIER2 a stability limit of 10.0 fs, SIER2V2 12.8, SIER2P3 23.4, SIER4G
#: 17.4, SIER4 15.1, SIER4V and SIER4P 15.8. In 64 molecules of liquid the energy grew within 1.2 ps by this share of
#: the kinetic energy:
#:     TIP3P     SIER2   9 fs 0.03, 10 fs 0.14, 11 fs 0.8     SIER4G  13 fs 0.04, 16 fs 0.11, 18 fs 0.6, 20 fs 1.7
#:     SPC/E     SIER2   8 fs 0.03, 10 fs 0.28, 11 fs 3.6     SIER4G  14 fs 0.06, 16 fs 0.37, 18 fs 1.0, 20 fs 2.9
#:     TIP4P-Ew  SIER2   8 fs 0.06, 10 fs 0.97, 11 fs 1e20    SIER4G  13 fs 0.02, 16 fs 0.54, 18 fs 1.1, 20 fs 3.3
#:     TIP3P     SIER4  13 fs 0.06, 16 fs 0.31, 18 fs 3.0     SIER4P  18 fs 0.04, 20 fs 0.07     SIER4V  20 fs 0.05
#:     TIP3P     SIER2V2  10 fs 0, 12 fs 0.04, 14 fs 0.35       SIER2P3  20 fs 0, 23 fs 0.10, 26 fs 0.77
#: At the accuracy limits of the schemes of fourth order, 11 to 15 fs, rms(H) is 0.02 to 0.06 rms(V), and at SIER2's,
#: 3.0 fs, it is 0.02.
HYDROGEN_BOND = 4.0e4

#: Charge in e, of either sign, of an atom with hydrogen bonds. TIP5P's hydrogens have 0.24, those of amides 0.27, and
#: those on carbon up to 0.15.
CHARGED = 0.2

#: Stiffness of a Lennard-Jones atom's surroundings in units of epsilon/sigma^2: the second derivative at the minimum,
#: 72/2^(1/3), for twelve neighbours, a third of which counts in each direction. For liquid argon it gives 6.7/ps; its
#: Einstein frequency is 7.5/ps.
LENNARD_JONES = 4 * 72 / 2 ** (1 / 3)

#: The same in Forces of multipoles, where dipoles share the work. Hydrogens of water have 0.19 in HIPPO, and 0.26 to
#: 0.30 in AMOEBA.
CHARGED_MULTIPOLE = 0.18

#: Forces whose atoms have charges.
WITH_CHARGES = (
    *(openmm.NonbondedForce, openmm.ConstantPotentialForce),
    *(openmm.AmoebaMultipoleForce, openmm.HippoNonbondedForce),
)

#: The stiffness in kJ/mol/nm^2 with which a Force is taken to hold an atom, by the number of that.
Stiffness = Callable[[int], float]


def holding(system: openmm.System) -> Iterator[tuple[Part, Stiffness]]:
    """Give each Force with charges, also within others, and how stiffly it is taken to hold an atom.

    A Force within another counts by the constant factor that its energy has there, and not where it has none.
    """
    for part in parts(system):
        if isinstance(part.force, WITH_CHARGES) and (weight := part.weight) is not None:
            yield part, _stiffness(part.force, abs(weight))


def slow_share(system: openmm.System, atoms: tuple[int, ...], strength: float, mobility: np.ndarray) -> float:
    """Return the stiffness with which the surroundings may hold a bond, by its ends, over that of the bond itself.

    Args:
        system: openmm.System.
        atoms: particle indices of the ends.
        strength: of the bond, kJ/mol/nm^2.
        mobility: inverse effective masses, (N,), 1/dalton.
    """
    moved = mobility[list(atoms)]
    forces = [stiffness for _, stiffness in holding(system)]
    held = np.array([max((stiffness(i) for stiffness in forces), default=0.0) for i in atoms])
    return float(held @ moved**2 / (strength * moved.sum() ** 2))


def _stiffness(force: openmm.Force, weight: float) -> Stiffness:
    least = CHARGED if isinstance(force, openmm.NonbondedForce | openmm.ConstantPotentialForce) else CHARGED_MULTIPOLE

    def stiffness(atom: int) -> float:
        bonding = HYDROGEN_BOND if abs(_charge(force, atom)) >= least else 0.0
        return weight * max(bonding, _dispersion(force, atom))

    return stiffness


def _charge(force: openmm.Force, atom: int) -> float:
    """Return the charge of an atom in e."""
    is_multipole = isinstance(force, openmm.AmoebaMultipoleForce)
    charge, *_ = force.getMultipoleParameters(atom) if is_multipole else _listed(force.getParticleParameters(atom))
    return charge.value_in_unit(unit.elementary_charge) if unit.is_quantity(charge) else charge


def _dispersion(force: openmm.Force, atom: int) -> float:
    """Return the stiffness by the Lennard-Jones terms of a NonbondedForce, kJ/mol/nm^2."""
    if not isinstance(force, openmm.NonbondedForce):
        return 0.0
    _, sigma, epsilon = tables.numbers(force.getParticleParameters(atom), tables.ATOM_UNITS)
    return LENNARD_JONES * epsilon / sigma**2 if sigma > 0 else 0.0


def _listed(parameters: object) -> list:
    """Return parameters as a list; those of a ConstantPotentialForce are its charge alone."""
    return list(parameters) if isinstance(parameters, list | tuple) else [parameters]
