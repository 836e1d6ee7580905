"""Molecules that the periodic boundary cuts: constraints know nothing of the box, and would pull them together."""

from typing import Any

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import RigidityError
from openmm_sier.system import tables
from openmm_sier.system.boxes import wrapped

#: nm. A constraint whose atoms are further than this beyond its length is cut if their nearest images are nearer by as
#: much. What is nearer to its length can be mended.
CUT = 0.1

#: Advice, for messages.
MAKE_WHOLE = "Make molecules whole: context.setPositions(make_whole(system, positions))"
IF_CUT = f"Does the periodic boundary cut the molecule? {MAKE_WHOLE}"


def refuse_cut_molecules(system: openmm.System, positions: np.ndarray, box: Any) -> None:
    """Refuse positions at which the boundary cuts a constraint, see `cut_molecules`.

    Raises:
        RigidityError: a molecule is cut.
    """
    if found := cut_molecules(system, positions, box):
        raise RigidityError(found)


def cut_molecules(system: openmm.System, positions: np.ndarray, box: Any) -> str:
    """Return a message if the boundary cuts a constraint, with the two atoms that are furthest apart; empty if not.

    Args:
        system: openmm.System.
        positions: (N, 3), nm.
        box: box vectors as rows, (3, 3), nm.
    """
    if not system.usesPeriodicBoundaryConditions():
        return ""
    pairs, lengths = tables.constraints(system)
    arms = positions[pairs[:, 1]] - positions[pairs[:, 0]]
    found = np.linalg.norm(arms, axis=1)
    far = np.flatnonzero(found - lengths > CUT)
    nearest = np.linalg.norm(wrapped(arms[far], np.array(box), np.round), axis=1)
    cut = far[found[far] - nearest > CUT]
    if not cut.size:
        return ""
    worst = cut[np.argmax(found[cut])]
    one, other = pairs[worst].tolist()
    more = f" ({len(cut)} constraints are cut)" if len(cut) > 1 else ""
    return (
        f"atoms {one} and {other} are {found[worst]:.4g} nm apart, but their constraint has the length "
        f"{lengths[worst]:.4f} nm: the periodic boundary cuts their molecule{more}. {MAKE_WHOLE}"
    )
