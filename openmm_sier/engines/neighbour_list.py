"""The CPU platform's neighbour list, on whose history the rounding of its forces depends.

Forces of the CPU platform are sums in single precision, in the order of a list of neighbours. The list is rebuilt when
atoms have moved far since it was built, so that the last bits of a force depend on earlier positions, which are in no
checkpoint. With one thread nothing else of the past affects them; with several the order of the sums is random, and no
two evaluations agree.
"""

import numpy as np
import openmm

from openmm_sier.engines.snapshot import box_of
from openmm_sier.system.forces import kind_of
from openmm_sier.system.inner_forces import all_forces

#: Distance in nm, farther than atoms may move before the list is rebuilt, which is a few tenths of the cut-off.
FAR = 1000.0


def is_remembered(context: openmm.Context) -> bool:
    """Return whether the neighbour list is all that forces depend on besides the state of the Context."""
    platform = context.getPlatform()
    if platform.getName() != "CPU" or platform.getPropertyValue(context, "Threads") != "1":
        return False
    return any(_has_cutoff(part.force) for part in all_forces(context.getSystem()))


def forget(context: openmm.Context) -> None:
    """Make the next force evaluation of a Context rebuild the list; nothing else changes.

    OpenMM checks the list at every request for forces, even for no force group. Along a line, where no atoms are
    neighbours, and in a box that is narrow beside it, that costs little. Forces within other Forces have lists of their
    own, which OpenMM checks only where it evaluates these.
    """
    parts = all_forces(context.getSystem())
    inner = {part.group for part in parts if part.containers and _has_cutoff(part.force)}
    groups = sum(1 << group for group in inner)
    state = openmm.Context.getState(context, positions=True)
    positions = np.empty((context.getSystem().getNumParticles(), 3))
    state._getVectorAsNumpy(openmm.State.Positions, positions)
    box = box_of(state)
    # The shortest edge is at least twice the cut-off.
    apart = min(box[0].x, box[1].y, box[2].z)
    line = np.full_like(positions, FAR)
    line[:, 0] += apart * np.arange(len(line))
    try:
        openmm.Context.setPeriodicBoxVectors(
            context, openmm.Vec3(apart * (len(line) + 1), 0, 0), openmm.Vec3(0, apart, 0), openmm.Vec3(0, 0, apart)
        )
        openmm.Context.setPositions(context, line)
        openmm.Context.getState(context, forces=True, groups=groups)
    finally:
        openmm.Context.setPeriodicBoxVectors(context, *box)
        openmm.Context.setPositions(context, positions)


def _has_cutoff(force: openmm.Force) -> bool:
    # In every Force that has nonbonded methods, 0 is the one without a cut-off.
    is_cut = hasattr(force, "getNonbondedMethod") and force.getNonbondedMethod() != 0
    return is_cut or kind_of(force).meshes == ()
