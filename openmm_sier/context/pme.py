"""A better balanced split of PME between its direct and its mesh sum than OpenMM's, for integrators of high order."""

from __future__ import annotations

import math

import openmm
from openmm import unit

#: How much smaller than the tolerance of the mesh that of the direct sum is. By OpenMM's rule they are equal, and the
#: error of the direct sum is 15 to 25 times the other. In water the forces are most exact with 10 to 20, for tolerances
#: from 1e-5 to 5e-4 and cut-offs of 0.9 and 1.2 nm.
DIRECT_SHARE = 20

#: Tolerances for which this is of use. OpenMM's default is 5e-4; with 1e-2 and a short cut-off forces would become
#: worse, and from 2e-2 on meshes too small for OpenMM's splines.
TOLERANCES = (1e-10, 1e-3)

_METHODS = (openmm.NonbondedForce.PME, openmm.NonbondedForce.LJPME)


def balance_pme(system: openmm.System) -> None:
    """Split electrostatics between the two sums of PME better than OpenMM does, with the mesh that OpenMM would choose.

    The direct sum ends at the cut-off, where the energy has a step that no force knows of. By OpenMM's rule for
    `ewaldErrorTolerance` this step limits how well energy can be conserved, and the direct sum has most of the error. A
    larger Ewald parameter makes the step some twenty times smaller, and the error of the mesh two to three times
    larger, with it the small net force of PME on the whole box. Forces in water take as long and are five to eight
    times as exact (cut-offs of 0.9 and 1.2 nm, tolerances from 1e-5 to 5e-4; twice as exact at 0.55 nm).

    Call it when box, cut-off and tolerance of the System are set, before a Context is created, and again if they
    change: parameters are those of `NonbondedForce.setPMEParameters`, and earlier ones are replaced. The Lennard-Jones
    part of LJPME stays as it is.

    Args:
        system: openmm.System.

    Raises:
        ValueError: no NonbondedForce of the System has PME or LJPME, or one has a cut-off that is not positive or a
            tolerance out of `TOLERANCES`. Nothing has been changed then.
    """
    forces = meshed_forces(system)
    if not forces:
        raise ValueError("balance_pme needs a NonbondedForce with PME or LJPME, and the System has none")
    box = system.getDefaultPeriodicBoxVectors()
    edges = [vector.value_in_unit(unit.nanometer)[axis] for axis, vector in enumerate(box)]
    parameters = [_parameters(force, edges) for force in forces]
    for force, (alpha, mesh) in zip(forces, parameters, strict=True):
        force.setPMEParameters(alpha, *mesh)


def meshed_forces(system: openmm.System) -> list[openmm.NonbondedForce]:
    """The NonbondedForces of a System that have PME or LJPME."""
    forces = [force for force in system.getForces() if isinstance(force, openmm.NonbondedForce)]
    return [force for force in forces if force.getNonbondedMethod() in _METHODS]


def _parameters(force: openmm.NonbondedForce, edges: list[float]) -> tuple[float, list[int]]:
    """Ewald parameter in 1/nm and mesh."""
    tolerance = force.getEwaldErrorTolerance()
    cutoff = force.getCutoffDistance().value_in_unit(unit.nanometer)
    least, largest = TOLERANCES
    if not least <= tolerance <= largest:
        raise ValueError(f"balance_pme needs an ewaldErrorTolerance from {least:g} to {largest:g}, got {tolerance:g}")
    if not 0 < cutoff < math.inf:
        raise ValueError(f"balance_pme needs a positive cut-off distance, got {cutoff:g} nm")
    usual = math.sqrt(-math.log(2 * tolerance)) / cutoff
    # The formulas of OpenMM's user guide, "Coulomb interaction with particle mesh Ewald".
    mesh = [math.ceil(2 * usual * edge / (3 * tolerance**0.2)) for edge in edges]
    return math.sqrt(-math.log(2 * tolerance / DIRECT_SHARE)) / cutoff, mesh
