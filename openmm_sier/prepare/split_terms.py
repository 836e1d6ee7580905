"""Bonded Forces with terms on frozen atoms or virtual sites, divided: the others become a Force of their own.

Fast forces move only bodies. Without this a single bond to a frozen atom would keep the bonds of a whole protein in the
kicks. The terms on bodies move to the new Force, and stay in the old one without strength: nothing is computed twice,
and who holds the old Force still has it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import openmm

from openmm_sier.system.bonded_terms import DIVISIBLE, bonded_terms, do_work

#: What the name of a Force of terms on bodies ends with.
OF_BODIES = " of moving bodies"


class Terms(NamedTuple):
    """Read and write the terms of a kind of Force.

    Attributes:
        get: (Force, number) -> particles and parameters.
        add: (Force, particles and parameters), adds a term.
        change: (Force, number, particles and parameters), changes one.
        atoms: number of particles of a term.
        strengths: places of the parameters that make the energy 0 if they are.
    """

    get: Callable[..., Any]
    add: Callable[..., Any]
    change: Callable[..., Any]
    atoms: int
    strengths: tuple[int, ...]


_BOND, _ANGLE, _TORSION, _RB = DIVISIBLE

_TERMS = {
    _BOND: Terms(_BOND.getBondParameters, _BOND.addBond, _BOND.setBondParameters, 2, (3,)),
    _ANGLE: Terms(_ANGLE.getAngleParameters, _ANGLE.addAngle, _ANGLE.setAngleParameters, 3, (4,)),
    _TORSION: Terms(_TORSION.getTorsionParameters, _TORSION.addTorsion, _TORSION.setTorsionParameters, 4, (6,)),
    _RB: Terms(_RB.getTorsionParameters, _RB.addTorsion, _RB.setTorsionParameters, 4, (4, 5, 6, 7, 8, 9)),
}


def divided(force: openmm.Force, owner: np.ndarray, moving: np.ndarray) -> openmm.Force | None:
    """Move the terms of a Force that act on bodies alone to a new one; None if it has none, or cannot be divided.

    Args:
        force: openmm.Force; the terms that are moved lose their strength.
        owner: for each particle the number of its body, (N,); terms within one body do no work, and stay.
        moving: for each particle whether it moves with a body, (N,).

    Returns:
        The Force of these terms, which is to be added to the System.
    """
    kind = next((kind for kind in DIVISIBLE if isinstance(force, kind)), None)
    if kind is None:
        return None
    terms, found = _TERMS[kind], kind()
    every = bonded_terms(force)
    numbers = np.flatnonzero(do_work(every, owner) & moving[every].all(axis=1))
    for number in numbers.tolist():
        parameters = list(terms.get(force, number))
        if all(parameters[place] == 0 * parameters[place] for place in terms.strengths):
            continue
        terms.add(found, *parameters)
        for place in terms.strengths:
            parameters[place] *= 0
        terms.change(force, number, *parameters)
    found.setName(force.getName() + OF_BODIES)
    found.setForceGroup(force.getForceGroup())
    found.setUsesPeriodicBoundaryConditions(force.usesPeriodicBoundaryConditions())
    return found if len(bonded_terms(found)) else None
