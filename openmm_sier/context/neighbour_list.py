"""The CPU platform's neighbour list, of which its forces bear traces.

Forces of the CPU platform are sums in single precision, in the order of a list of neighbours. The list is built anew
where atoms have moved far since it was built, so that the last bits of a force depend on earlier positions, which are
in no checkpoint. With one thread nothing else of the past acts on them; with several the order of the sums is left to
chance, and no two evaluations agree. `docs/determinism.md` has the measurements.
"""

from __future__ import annotations

import openmm
from openmm import unit

#: nm; farther than atoms may move before the list is built anew, which is some tenths of the cut-off.
FAR = 1000.0


def is_remembered(context: openmm.Context) -> bool:
    """Whether forces depend on a list with a past, and on nothing else that is not in the Context's state."""
    platform = context.getPlatform()
    if platform.getName() != "CPU" or platform.getPropertyValue(context, "Threads") != "1":
        return False
    system = context.getSystem()
    forces = (system.getForce(i) for i in range(system.getNumForces()))
    # In every Force that has methods 0 is the one without a cut-off.
    return any(force.getNonbondedMethod() != 0 for force in forces if hasattr(force, "getNonbondedMethod"))


def forget(context: openmm.Context) -> None:
    """Have the next force evaluation of a Context build the list anew; nothing else changes.

    The list is looked at wherever forces are asked for, those of no force group included. It costs two constructions of
    the list, a fifth of a force evaluation.
    """
    positions = context.getState(positions=True).getPositions(asNumpy=True).value_in_unit(unit.nanometer)
    try:
        context.setPositions(positions + FAR)
        context.getState(forces=True, groups=0)
    finally:
        context.setPositions(positions)
