"""Constraints at the start of a run: OpenMM moves atoms onto them that were set elsewhere."""

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import RigidityError
from openmm_sier.engines.snapshot import Snapshot
from openmm_sier.system.cut_molecules import IF_CUT
from openmm_sier.system.find_bodies import BodyPlan
from openmm_sier.system.tables import Constraints

#: Atoms whose constraints have larger errors than this, in nm or nm/ps, were set by a user and are moved onto them.
#: OpenMM's own constraints leave errors of up to 5e-9 nm, since SETTLE works with lengths in single precision.
OFF = 1e-7

#: Atoms still further off than this afterwards, in nm, have not converged.
NOT_CONVERGED = 1e-4


def satisfy_constraints(context: openmm.Context, constraints: Constraints, tolerance: float) -> None:
    """Move atoms and velocities onto the constraints; those that satisfy them are unchanged, bit for bit.

    Args:
        context: openmm.Context.
        constraints: of its System, at least one.
        tolerance: relative, for OpenMM's solvers.

    Raises:
        RigidityError: OpenMM cannot satisfy them, or they contradict each other.
    """
    errors, speeds = _errors(context, constraints)
    if not errors.max() <= OFF:
        openmm.Context.applyConstraints(context, tolerance)
        errors, speeds = _errors(context, constraints)
        worst = int(np.argmax(np.where(np.isfinite(errors), errors, np.inf)))
        if not errors[worst] <= NOT_CONVERGED:
            # Lengths that contradict each other are refused where the bodies are found.
            BodyPlan(context.getSystem())
            i, j = constraints.pairs[worst].tolist()
            raise RigidityError(
                f"OpenMM could not satisfy the constraint of atoms {i} and {j} of {constraints.lengths[worst]:.4f} nm: "
                f"their distance is still off by {errors[worst]:.2g} nm. Give positions that satisfy the constraints. "
                f"{IF_CUT}"
            )
    if not speeds.max() <= OFF:
        openmm.Context.applyVelocityConstraints(context, tolerance)


def are_satisfied(constraints: Constraints, positions: np.ndarray) -> bool:
    """Return whether the solution of constraints has converged, at positions (N, 3), nm."""
    # A comparison with NaN is false.
    return bool((_distance_errors(constraints, positions) <= NOT_CONVERGED).all())


def _distance_errors(constraints: Constraints, positions: np.ndarray) -> np.ndarray:
    """Return errors of the distances, (c,), nm."""
    first, second = constraints.pairs.T
    return np.abs(np.linalg.norm(positions[second] - positions[first], axis=1) - constraints.lengths)


def _errors(context: openmm.Context, constraints: Constraints) -> tuple[np.ndarray, np.ndarray]:
    """Return errors of the distances, nm, and velocities along the constraints, nm/ps, each (c,)."""
    now, (first, second) = Snapshot.of(context), constraints.pairs.T
    arms, velocities = (vectors[second] - vectors[first] for vectors in (now.positions, now.velocities))
    errors = _distance_errors(constraints, now.positions)
    return errors, np.abs((arms * velocities).sum(axis=1)) / constraints.lengths
