"""Distances of atoms from the constraints of a System."""

from __future__ import annotations

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import RigidityError
from openmm_sier.engines.snapshot import Snapshot
from openmm_sier.system.tables import Constraints

#: Atoms further than this off their constraints, in nm or nm/ps, were put there from outside and are moved onto them.
#: OpenMM's own constraints leave errors of up to 5e-9 nm, since SETTLE works with lengths in single precision.
OFF = 1e-7

#: Atoms still further off than this afterwards, in nm, have not converged.
NOT_CONVERGED = 1e-4


def satisfy(constraints: Constraints, context: openmm.Context, tolerance: float) -> None:
    """Move the atoms of a Context, and their velocities, onto the constraints of its System.

    Atoms that satisfy them are unchanged, bit for bit.

    Args:
        constraints: of the System.
        context: openmm.Context.
        tolerance: relative, of the distances.

    Raises:
        RigidityError: OpenMM cannot satisfy them.
    """
    if not len(constraints.pairs):
        return
    errors, speeds = _errors(constraints, context)
    if not errors.max() <= OFF:
        context.applyConstraints(tolerance)
        errors, speeds = _errors(constraints, context)
        worst = int(np.argmax(np.where(np.isfinite(errors), errors, np.inf)))
        if not errors[worst] <= NOT_CONVERGED:
            i, j = constraints.pairs[worst].tolist()
            raise RigidityError(
                f"the constraint of atoms {i} and {j} wants them {constraints.lengths[worst]:.4f} nm apart, and OpenMM "
                f"could move them no nearer to that than {errors[worst]:.2g} nm: give positions that satisfy the "
                "constraints"
            )
    if not speeds.max() <= OFF:
        context.applyVelocityConstraints(tolerance)


def _errors(constraints: Constraints, context: openmm.Context) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the distances, nm, and velocities along the constraints, nm/ps, each (c,)."""
    now, (first, second) = Snapshot(context), constraints.pairs.T
    arms, velocities = (vectors[second] - vectors[first] for vectors in (now.positions, now.velocities))
    errors = np.abs(np.linalg.norm(arms, axis=1) - constraints.lengths)
    return errors, np.abs((arms * velocities).sum(axis=1)) / constraints.lengths
