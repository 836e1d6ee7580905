"""The split of PME between its two sums, where an integrator of high order needs better than OpenMM's rule."""

from __future__ import annotations

import math

import openmm
from openmm import unit

#: How much smaller than the tolerance of the mesh that of the direct sum is. By OpenMM's rule they are equal, and the
#: error of the direct sum is some ten times the other. In water the forces are most exact with 20, for tolerances from
#: 1e-5 to 5e-4 and cut-offs from 0.9 to 1.2 nm.
DIRECT_SHARE = 20

_METHODS = (openmm.NonbondedForce.PME, openmm.NonbondedForce.LJPME)


def balance_ewald(system) -> None:
    """Make both sums of a System's PME equally exact, with the mesh that OpenMM would choose.

    The direct sum ends at the cut-off, where the energy has a step that no force knows of: with OpenMM's rule for
    `ewaldErrorTolerance` this step limits the conservation of energy. A larger Ewald parameter makes it some twenty
    times smaller. The mesh stays as fine as it was, and so does the cost; forces in water have a fifth to an eighth of
    the error before (cut-offs of 0.9 nm or more; half of it at 0.55 nm).

    Parameters are set by `NonbondedForce.setPMEParameters`, from the Force's tolerance and cut-off and the System's
    default box; those set before are replaced.

    Args:
        system: openmm.System that no Context has been created of yet.

    Raises:
        ValueError: no NonbondedForce of the System has PME, or one has no tolerance below 0.5.
    """
    forces = [force for force in system.getForces() if isinstance(force, openmm.NonbondedForce)]
    meshed = [force for force in forces if force.getNonbondedMethod() in _METHODS]
    if not meshed:
        raise ValueError("balance_ewald needs a NonbondedForce with PME or LJPME, and the System has none")
    edges = [vector[axis] for axis, vector in enumerate(_box(system))]
    parameters = [_parameters(force, edges) for force in meshed]
    for force, (alpha, mesh) in zip(meshed, parameters, strict=True):
        force.setPMEParameters(alpha, *mesh)


def _box(system) -> list:
    return [vector.value_in_unit(unit.nanometer) for vector in system.getDefaultPeriodicBoxVectors()]


def _parameters(force, edges: list[float]) -> tuple[float, list[int]]:
    """Ewald parameter in 1/nm and mesh."""
    tolerance = force.getEwaldErrorTolerance()
    cutoff = force.getCutoffDistance().value_in_unit(unit.nanometer)
    if not 0 < tolerance < 0.5:
        raise ValueError(f"the ewaldErrorTolerance of a NonbondedForce must be between 0 and 0.5, got {tolerance:g}")
    usual = math.sqrt(-math.log(2 * tolerance)) / cutoff
    # The formulas of OpenMM's user guide, "Coulomb interaction with particle mesh Ewald".
    mesh = [math.ceil(2 * usual * edge / (3 * tolerance**0.2)) for edge in edges]
    return math.sqrt(-math.log(2 * tolerance / DIRECT_SHARE)) / cutoff, mesh
