"""Detect molecules H-X-H without an angle term or constraint, such as rigid water that lost a constraint."""

from itertools import combinations

import numpy as np
import openmm

from openmm_sier.system import tables
from openmm_sier.system.bonded_terms import bonded_terms, harmonic_bonds
from openmm_sier.system.forces import kind_of
from openmm_sier.system.user_warnings import warn


def warn_about_unconstrained_angles(system: openmm.System) -> None:
    """Warn if molecules H-X-H have two bonds or constraints, but no term between the hydrogens.

    Charges pull the hydrogens to one side, and the temperature rises by hundreds of kelvins with any integrator.
    """
    kinds = [kind_of(force) for force in system.getForces()]
    # Any other Force may restrain angles by an expression.
    if not all(kind.terms or kind.acts_on in ("pairs", "particles", "nothing") for kind in kinds):
        return
    molecules = _hydrogens_on_one_atom(system)
    loose = molecules[~_held(system, molecules)]
    if len(loose):
        first, centre, second = loose[0].tolist()
        warn(
            f"Nothing fixes the angle of atoms {first}, {centre} and {second}, nor that of {len(loose) - 1} other "
            "molecules: there is no constraint between the hydrogens and no angle term. Rigid water has three "
            "constraints, but files of other programs may have only two: call createSystem with rigidWater=True"
        )


def _hydrogens_on_one_atom(system: openmm.System) -> np.ndarray:
    """Return the molecules of one heavy atom with two hydrogens as atoms H, X, H, (m, 3)."""
    bonds = [harmonic_bonds(force)[0] for force in system.getForces() if isinstance(force, openmm.HarmonicBondForce)]
    pairs = np.unique(np.sort(np.concatenate([tables.constraints(system).pairs, *bonds]), axis=1), axis=0)
    masses = tables.masses(system)
    is_hydrogen = (masses > 0) & (masses <= tables.HEAVIEST_HYDROGEN)
    partners = np.bincount(pairs.ravel(), minlength=len(masses))
    first, second = pairs.T
    # Each bond as hydrogen and heavy atom.
    hydrogen = np.where(is_hydrogen[first], first, second)
    heavy = np.where(is_hydrogen[first], second, first)
    fits = is_hydrogen[hydrogen] & ~is_hydrogen[heavy] & (partners[hydrogen] == 1) & (partners[heavy] == 2)
    hydrogen, heavy = hydrogen[fits], heavy[fits]
    order = np.argsort(heavy, kind="stable")
    hydrogen, heavy = hydrogen[order], heavy[order]
    starts = np.flatnonzero(heavy[1:] == heavy[:-1])
    return np.stack([hydrogen[starts], heavy[starts], hydrogen[starts + 1]], axis=1)


def _held(system: openmm.System, molecules: np.ndarray) -> np.ndarray:
    """Return whether a bonded term acts on both hydrogens of each molecule, (m,)."""
    is_held = np.zeros(len(molecules), bool)
    if not len(molecules):
        return is_held
    owner = np.full(system.getNumParticles(), -1)
    owner[molecules[:, 0]] = owner[molecules[:, 2]] = np.arange(len(molecules))
    for force in system.getForces():
        if kind_of(force).terms is None:
            continue
        for one, other in combinations(bonded_terms(force).T, 2):
            same = (owner[one] == owner[other]) & (owner[one] >= 0) & (one != other)
            is_held[owner[one[same]]] = True
    return is_held
