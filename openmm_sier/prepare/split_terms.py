"""Bonded Forces with terms on frozen atoms or virtual sites, divided: the others become a Force of their own.

Fast forces move only bodies. Without this a single bond to a frozen atom would keep the bonds of a whole protein in the
kicks. The terms on bodies move to the new Force, and stay in the old one without strength: nothing is computed twice,
and who holds the old Force still has it.
"""

from __future__ import annotations

import numpy as np
import openmm

from openmm_sier.system.bonded_terms import bonded_terms, do_work
from openmm_sier.system.forces import kind_of

#: What the name of a Force of terms on bodies ends with.
OF_BODIES = " of moving bodies"


def divided(force: openmm.Force, owner: np.ndarray, moving: np.ndarray) -> openmm.Force | None:
    """Move the terms of a Force that act on bodies alone to a new one; None if it has none, or cannot be divided.

    Args:
        force: openmm.Force; the terms that are moved lose their strength.
        owner: for each particle the number of its body, (N,); terms within one body do no work, and stay.
        moving: for each particle whether it moves with a body, (N,).

    Returns:
        The Force of these terms, which is to be added to the System.
    """
    kind = kind_of(force)
    if kind.terms is None or not kind.is_divisible:
        return None
    element, strengths = kind.terms.element, kind.terms.strengths
    found = type(force)()
    every = bonded_terms(force)
    numbers = np.flatnonzero(do_work(every, owner) & moving[every].all(axis=1))
    for number in numbers.tolist():
        parameters = list(getattr(force, f"get{element}Parameters")(number))
        if all(parameters[place] == 0 * parameters[place] for place in strengths):
            continue
        getattr(found, f"add{element}")(*parameters)
        for place in strengths:
            parameters[place] *= 0
        getattr(force, f"set{element}Parameters")(number, *parameters)
    found.setName(force.getName() + OF_BODIES)
    found.setForceGroup(force.getForceGroup())
    found.setUsesPeriodicBoundaryConditions(force.usesPeriodicBoundaryConditions())
    return found if len(bonded_terms(found)) else None
