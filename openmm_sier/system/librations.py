"""How fast the forces between molecules turn and shake them, estimated before any position is known.

An atom that can move with an inverse mass u, its body's rotation included, and that the surroundings hold with a
stiffness k swings with the angular frequency sqrt(k u). For the hydrogens of rigid water u is 1/m, since out of the
plane of the molecule they move as if they were free. Heavier hydrogens, and those of larger bodies, are slower.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import RigidBodies
from openmm_sier.dynamics.constraints.graph import joined
from openmm_sier.system import tables

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

#: By the table above energy grows from this share of the stability limit on, since some librations are faster.
HEATING = 0.8

#: Charge in e, of either sign, of an atom with hydrogen bonds. TIP5P's hydrogens have 0.24, those of amides 0.27, and
#: those on carbon up to 0.15.
CHARGED = 0.2

#: Stiffness of a Lennard-Jones atom's surroundings in units of epsilon/sigma^2: the second derivative at the minimum,
#: 72/2^(1/3), for twelve neighbours, a third of which counts in each direction. For liquid argon it gives 6.7/ps; its
#: Einstein frequency is 7.5/ps.
LENNARD_JONES = 4 * 72 / 2 ** (1 / 3)

#: A step is refused at so many times the stability limit. There all librations of water are unstable, since the slowest
#: have half the frequency of the fastest.
HOPELESS = 2.0

#: So many bodies of one kind are looked at, since charges of one kind of body are most often the same.
SAMPLED = 100


class Libration(NamedTuple):
    """The fastest motion of an atom in the field of other molecules.

    Attributes:
        period: ps.
        atom: particle index.
        group: the force group that moves it.
    """

    period: float
    atom: int
    group: int


def fastest_librations(system: openmm.System, bodies: RigidBodies, mobility: np.ndarray) -> list[Libration]:
    """For each NonbondedForce the fastest motion that it causes; none if there is only one body.

    Other Forces between molecules are expressions, from which no stiffness can be read.

    Args:
        system: openmm.System.
        bodies: its bodies.
        mobility: for each particle its largest inverse effective mass in any direction, (N,), 1/dalton.
    """
    forces = [force for force in system.getForces() if isinstance(force, openmm.NonbondedForce)]
    if not forces or not bodies.n or _is_alone(system, bodies):
        return []
    found = []
    for force in forces:
        squares = {atom: _stiffness(force, atom) * mobility[atom] for atom in _sample(bodies)}
        atom = max(squares, key=squares.__getitem__)
        if (square := squares[atom]) > 0:
            found.append(Libration(2 * math.pi / math.sqrt(square), atom, force.getForceGroup()))
    return found


def _is_alone(system: openmm.System, bodies: RigidBodies) -> bool:
    """Whether all that has a place of its own is one molecule held by constraints; it is taken to be a small one."""
    if bodies.n > SAMPLED or tables.frozen_atoms(system).size:
        return False
    first = joined(bodies.n_particles, tables.constraints(system).pairs)
    return bodies.n <= 1 or not np.ptp(first[bodies.owners >= 0])


def _sample(bodies: RigidBodies) -> Iterator[int]:
    """Atoms of some bodies of every kind."""
    for species in bodies.species:
        for atoms in species.atoms[:SAMPLED].T.tolist():
            yield from atoms


def _stiffness(force: openmm.NonbondedForce, atom: int) -> float:
    """kJ/mol/nm^2."""
    charge, sigma, epsilon = (value._value for value in force.getParticleParameters(atom))
    dispersion = LENNARD_JONES * epsilon / sigma**2 if sigma > 0 else 0.0
    return max(HYDROGEN_BOND if abs(charge) >= CHARGED else 0.0, dispersion)
