"""Estimate how stiffly the surroundings of an atom hold it, by the charges and Lennard-Jones terms of a System.

It is estimated before any position is known.
"""

from collections.abc import Iterator

import numpy as np
import openmm
from openmm import unit

from openmm_sier.system import tables
from openmm_sier.system.forces import kind_of
from openmm_sier.system.inner_forces import SystemForce, all_forces

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


def holding(system: openmm.System) -> Iterator[tuple[SystemForce, np.ndarray]]:
    """Give each Force with charges, also within others, and how stiffly it is taken to hold each atom.

    A Force within another counts by the constant factor that its energy has there, and not where it has none.
    Stiffnesses are in kJ/mol/nm^2, (N,).
    """
    for part in all_forces(system):
        if kind_of(part.force).charges and (weight := part.weight) is not None:
            yield part, abs(weight) * _stiffness(part.force)


def slow_share(held: np.ndarray, atoms: tuple[int, ...], strength: float, mobility: np.ndarray) -> float:
    """Return the stiffness with which the surroundings may hold a bond, by its ends, over that of the bond itself.

    Args:
        held: stiffness of the surroundings of each atom, (N,), kJ/mol/nm^2.
        atoms: particle indices of the ends.
        strength: of the bond, kJ/mol/nm^2.
        mobility: inverse effective masses, (N,), 1/dalton.
    """
    moved = mobility[list(atoms)]
    return float(held[list(atoms)] @ moved**2 / (strength * moved.sum() ** 2))


def _stiffness(force: openmm.Force) -> np.ndarray:
    """Return the stiffness with which a Force with charges is taken to hold each atom, (N,), kJ/mol/nm^2."""
    if not isinstance(force, openmm.NonbondedForce):
        least = CHARGED if kind_of(force).charges == "points" else CHARGED_MULTIPOLE
        return np.where(np.abs(_charges(force)) >= least, HYDROGEN_BOND, 0.0)
    charge, sigma, epsilon = tables.atom_parameters(force).T
    bonding = np.where(np.abs(charge) >= CHARGED, HYDROGEN_BOND, 0.0)
    dispersion = np.divide(LENNARD_JONES * epsilon, sigma**2, out=np.zeros_like(sigma), where=sigma > 0)
    return np.maximum(bonding, dispersion)


def _charges(force: openmm.Force) -> np.ndarray:
    """Return the charges of the particles of a Force without Lennard-Jones terms, (N,), e."""
    if isinstance(force, openmm.AmoebaMultipoleForce):
        found = [force.getMultipoleParameters(i)[0] for i in range(force.getNumMultipoles())]
    elif isinstance(force, openmm.HippoNonbondedForce):
        found = [force.getParticleParameters(i)[0] for i in range(force.getNumParticles())]
    else:
        found = [force.getParticleParameters(i) for i in range(force.getNumParticles())]
    in_e = [each.value_in_unit(unit.elementary_charge) if unit.is_quantity(each) else each for each in found]
    return np.array(in_e, dtype=float)
