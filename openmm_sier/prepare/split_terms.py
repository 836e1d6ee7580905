"""Split bonded Forces with terms on frozen atoms or virtual sites: the other terms move to a new Force.

Fast forces move only bodies. Otherwise a single bond to a frozen atom would keep the bonds of a whole protein in the
kicks. Moved terms stay in the old Force with zero strength: nothing is computed twice, and references to the old Force
remain valid.
"""

from __future__ import annotations

import numpy as np
import openmm

from openmm_sier.system.bonded_terms import bonded_terms, do_work
from openmm_sier.system.forces import kind_of

#: Suffix of the names of new Forces.
OF_BODIES = " of moving bodies"


def divided(force: openmm.Force, owner: np.ndarray, moving: np.ndarray) -> openmm.Force | None:
    """Move the terms of a Force that act only on bodies to a new Force.

    Args:
        force: openmm.Force; its moved terms get zero strength.
        owner: body index of each particle, (N,); terms within one body do no work, and stay.
        moving: whether each particle moves with a body, (N,).

    Returns:
        The new Force, not yet added to the System; None if there are no such terms, or the Force cannot be divided.
    """
    kind = kind_of(force)
    if kind.terms is None or not kind.is_divisible:
        return None
    element, strengths = kind.terms.element, kind.terms.strengths
    second = type(force)()
    term_atoms = bonded_terms(force)
    numbers = np.flatnonzero(do_work(term_atoms, owner) & moving[term_atoms].all(axis=1))
    for number in numbers.tolist():
        parameters = list(getattr(force, f"get{element}Parameters")(number))
        if all(parameters[place] == 0 * parameters[place] for place in strengths):
            continue
        getattr(second, f"add{element}")(*parameters)
        for place in strengths:
            parameters[place] *= 0
        getattr(force, f"set{element}Parameters")(number, *parameters)
    second.setName(force.getName() + OF_BODIES)
    second.setForceGroup(force.getForceGroup())
    second.setUsesPeriodicBoundaryConditions(force.usesPeriodicBoundaryConditions())
    return second if len(bonded_terms(second)) else None
