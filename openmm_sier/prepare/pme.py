"""Balance the direct and reciprocal sums of PME for integrators of high order."""

import math

import openmm
from openmm import unit

from openmm_sier.system.bound_systems import refuse_bound
from openmm_sier.system.forces import kind_of
from openmm_sier.system.inner_forces import all_forces, pme_parameters
from openmm_sier.system.user_warnings import warn

#: Ratio of the mesh's tolerance to that of the direct sum. By OpenMM's rule it is 1, and the error of the direct sum is
#: 15 to 25 times that of the mesh. In water forces are most accurate with 10 to 20, for tolerances from 1e-5 to 5e-4
#: and cut-offs of 0.9 and 1.2 nm. But each pair that crosses the cut-off changes the energy by the jump of its force,
#: and over a run the energy performs a random walk: with 20, at 4 fs and a tolerance of 1e-4, twice as fast as with
#: 200; larger ratios do not slow it further.
DIRECT_SHARE = 200

#: Mesh points along an edge over OpenMM's choice, for a mesh as exact as with a share of 20.
FINER = 1.1

#: Range of tolerances for which balancing helps. OpenMM's default is 5e-4. With 1e-2 and a short cut-off forces would
#: become worse; from 2e-2 on meshes would be too small for OpenMM's splines.
TOLERANCES = (1e-10, 1e-3)

#: The same for Forces of multipoles: with `FINER` their forces in water would be half as exact again as OpenMM's.
FINER_MULTIPOLES = 1.5


def balance_pme(system: openmm.System) -> None:
    """Balance the two sums of PME better than OpenMM does, with a mesh a tenth finer.

    `prepare_system` calls this function. Call it only if you need nothing else of the preparation, after box, cut-off
    and tolerance of the System are set and before a Context is created.

    >>> balance_pme(system)

    At the cut-off the energy jumps, and the forces do not account for it. With OpenMM's rule for `ewaldErrorTolerance`
    this jump limits energy conservation. A larger Ewald parameter makes it two hundred times smaller. In return the
    error of the mesh, and the small net force of PME on the box, are two to three times larger. Forces in water take as
    long and are four to seven times as accurate (cut-off of 0.9 nm, tolerances from 1e-5 to 5e-4).

    The function calls `setPMEParameters` of each NonbondedForce, ConstantPotentialForce, AmoebaMultipoleForce and
    HippoNonbondedForce with PME, also inside an ATMForce or a CustomCVForce, and replaces earlier parameters. The
    dispersion of LJPME and of a HippoNonbondedForce is not changed.

    Args:
        system: the System, which changes.

    Raises:
        ValueError: no Force of the System uses PME or LJPME; a cut-off is not positive or a tolerance outside
            `TOLERANCES`; or the System already has a Context with a SIER integrator. The System is unchanged then.
    """
    refuse_bound(system)
    forces = meshed_forces(system)
    if not forces:
        raise ValueError(
            "balance_pme requires a Force with PME or LJPME, such as a NonbondedForce, but the System has none"
        )
    box = system.getDefaultPeriodicBoxVectors()
    edges = [vector.value_in_unit(unit.nanometer)[axis] for axis, vector in enumerate(box)]
    parameters = [_parameters(force, edges) for force in forces]
    for force, (alpha, mesh) in zip(forces, parameters, strict=True):
        force.setPMEParameters(alpha, *mesh)


def warn_about_pme(system: openmm.System, scheme: str) -> None:
    """Warn about unbalanced PME with a fourth-order integrator, whose scheme has the given name."""
    loose = [force for force in meshed_forces(system) if not pme_parameters(force)[0]]
    if loose:
        warn(
            "Call prepare_system(system) before the Context is made. Otherwise the energy of PME jumps at the "
            f"cut-off, and {scheme} is hardly better than Verlet: at OpenMM's defaults the energy error of water "
            "within 1 ps is 1.2 to 1.6 %, but 0.1 % on a prepared System, at the same cost. The ewaldErrorTolerance "
            f"of this System is {loose[0].getEwaldErrorTolerance():g}"
        )


def meshed_forces(system: openmm.System) -> list[openmm.Force]:
    """Return the Forces of a System that use PME or LJPME, including Forces inside other Forces."""
    return [entry.force for entry in all_forces(system) if _has_mesh(entry.force)]


def _has_mesh(force: openmm.Force) -> bool:
    methods = kind_of(force).meshes
    return methods is not None and (not methods or force.getNonbondedMethod() in methods)


def _parameters(force: openmm.Force, edges: list[float]) -> tuple[float, list[int]]:
    """Return the Ewald parameter in 1/nm and the mesh."""
    tolerance = force.getEwaldErrorTolerance()
    cutoff = force.getCutoffDistance().value_in_unit(unit.nanometer)
    least, largest = TOLERANCES
    if not least <= tolerance <= largest:
        raise ValueError(f"ewaldErrorTolerance must be from {least:g} to {largest:g}, got {tolerance:g}")
    if not 0 < cutoff < math.inf:
        raise ValueError(f"the cut-off distance must be positive, got {cutoff:g} nm")
    usual = math.sqrt(-math.log(2 * tolerance)) / cutoff
    # The formulas of OpenMM's user guide, "Coulomb interaction with particle mesh Ewald".
    finer = FINER_MULTIPOLES if kind_of(force).charges == "multipoles" else FINER
    mesh = [math.ceil(finer * 2 * usual * edge / (3 * tolerance**0.2)) for edge in edges]
    return math.sqrt(-math.log(2 * tolerance / DIRECT_SHARE)) / cutoff, mesh
