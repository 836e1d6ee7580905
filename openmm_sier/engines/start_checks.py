"""Refuse to begin in a Context where positions, velocities or the energy are not finite."""

import numpy as np
import openmm
from openmm import unit

from openmm_sier.engines.snapshot import Snapshot, potential_of

#: Relative tolerance of constraints, which are solved before a minimization.
TOLERANCE = 1e-5

#: Atoms at no larger distance, nm, are named as a pair that overlaps.
OVERLAP = 0.05


def refuse_what_is_not_finite(now: Snapshot) -> None:
    """Refuse positions or velocities that are infinite or NaN.

    Raises:
        openmm.OpenMMException: the message names the first such atom.
    """
    for name, vectors in (("position", now.positions), ("velocity", now.velocities)):
        is_finite = np.isfinite(vectors).all(axis=1)
        if not is_finite.all():
            atom = int(is_finite.argmin())
            raise openmm.OpenMMException(f"The {name} of atom {atom} in the Context is {vectors[atom]}, and not finite")


def refuse_hopeless_start(context: openmm.Context) -> None:
    """Refuse positions from which OpenMM's minimizer would never come back.

    It never terminates if the energy is infinite or NaN. Positions are as before in any case.

    Raises:
        openmm.OpenMMException: positions are not finite, OpenMM cannot satisfy the constraints from there, or the
            energy is not finite. The message names the atoms.
    """
    now = Snapshot.of(context)
    refuse_what_is_not_finite(now)
    groups = context.getIntegrator().getIntegrationForceGroups()
    try:
        # The minimizer does so first.
        openmm.Context.applyConstraints(context, TOLERANCE)
        context.computeVirtualSites()
        constrained = Snapshot.of(context).positions
        is_finite = np.isfinite(constrained).all(axis=1)
        if not is_finite.all():
            raise openmm.OpenMMException(
                "No minimization can begin here, since OpenMM cannot satisfy the constraints of "
                f"{_named(int(is_finite.argmin()), now.positions)}: give other positions"
            )
        state = openmm.Context.getState(context, energy=True, forces=True, groups=groups)
    finally:
        openmm.Context.setPositions(context, now.positions)
    energy = potential_of(state)
    if not np.isfinite(energy):
        forces = state.getForces(asNumpy=True).value_in_unit(unit.kilojoule_per_mole / unit.nanometer)
        atom = int(np.isfinite(forces).all(axis=1).argmin())
        raise openmm.OpenMMException(
            f"No minimization can begin here, since the energy is {energy}, and the force on "
            f"{_named(atom, constrained)} is not finite: give other positions"
        )


def _named(atom: int, positions: np.ndarray) -> str:
    """Return an atom by its number, with its neighbour where that is too near."""
    distances = np.linalg.norm(positions - positions[atom], axis=1)
    distances[atom] = np.inf
    if distances.min(initial=np.inf) > OVERLAP:
        return f"atom {atom}"
    other = int(distances.argmin())
    return f"atom {atom} ({distances[other]:.2g} nm from atom {other})"
