"""Balance the direct and reciprocal sums of PME for integrators of high order."""

import math
from typing import NamedTuple

import numpy as np
import openmm
from openmm import unit

from openmm_sier.system import tables
from openmm_sier.system.bound_systems import refuse_bound
from openmm_sier.system.forces import kind_of
from openmm_sier.system.inner_forces import all_forces, pme_parameters
from openmm_sier.system.user_warnings import warn


class Split(NamedTuple):
    """Hold the division of PME between its two sums.

    By OpenMM's rule both numbers are 1, and the error of the direct sum is 15 to 25 times that of the mesh.

    Attributes:
        direct_share: ratio of the mesh's tolerance to that of the direct sum.
        finer: mesh points along an edge over OpenMM's choice for a rectangular box with such an edge.
    """

    direct_share: float
    finer: float


#: In a bath. In water forces are most accurate with a share of 10 to 20, for tolerances from 1e-5 to 5e-4 and cut-offs
#: of 0.9 and 1.2 nm.
IN_BATH = Split(20, 1.0)

#: At constant energy each pair that crosses the cut-off changes the energy by the jump of its force, and over a run the
#: energy performs a random walk: with a share of 20, at 4 fs and a tolerance of 1e-4, twice as fast as with 200; larger
#: shares do not slow it further. The mesh is as exact as with a share of 20.
AT_CONSTANT_ENERGY = Split(200, 1.1)

#: The same for Forces of multipoles: with a mesh a tenth finer their forces in water would be half as exact again as
#: OpenMM's.
MULTIPOLES = Split(200, 1.5)

#: Range of tolerances for which balancing helps. OpenMM's default is 5e-4. With 1e-2 and a short cut-off forces would
#: become worse; from 2e-2 on meshes would be too small for OpenMM's splines.
TOLERANCES = (1e-10, 1e-3)


#: Errors of forces by a mesh of spacing h and splines of order 5. A charge alone has SELF alpha^2 (alpha h)^5.5,
#: and independent ones have PAIRS (alpha density)^0.5 (alpha h)^5, within a tenth for alpha h from 0.12 to 0.4.
SELF, PAIRS = 0.058, 0.077


class Sums(NamedTuple):
    """Hold the parameters of PME.

    Attributes:
        alpha: Ewald parameter, 1/nm.
        mesh: mesh points along each box vector.
    """

    alpha: float
    mesh: tuple[int, ...]


def balance_pme(system: openmm.System, constantEnergy: bool = True) -> bool:
    """Balance the two sums of PME better than OpenMM does.

    `prepare_system` calls this function. Call it only if you need nothing else of the preparation, after box, cut-off
    and tolerance of the System are set and before a Context is created.

    >>> is_balanced = balance_pme(system)

    At the cut-off the energy jumps, and the forces do not account for it. With OpenMM's rule for `ewaldErrorTolerance`
    this jump limits energy conservation. A larger Ewald parameter makes it two hundred times smaller, with a mesh a
    tenth finer. In return the error of the mesh, and the small net force of PME on the box, are two to three times
    larger. Forces in water are four to seven times as accurate (cut-off of 0.9 nm, tolerances from 1e-5 to 5e-4).

    In a heat bath and in hybrid Monte Carlo a jump twenty times smaller is enough, which takes no more mesh points than
    OpenMM's rule. Forces in water are then eight to nine times as accurate (tolerances from 1e-4 to 5e-4).

    In a triclinic box the mesh follows the lengths of the box vectors, where OpenMM takes the diagonal of their matrix.
    So a dodecahedron gets 1.4 times as many points, along its third vector. With OpenMM's mesh a larger Ewald parameter
    would make forces less accurate there.

    In a box that is nearly empty hardly any pairs are at the cut-off, and OpenMM's rule has smaller errors: around a
    single molecule of water 0.03 kJ/mol/nm at the default tolerance, where a balanced sum has 0.15. The errors of both
    are estimated from the charges, and a NonbondedForce for which OpenMM's is smaller is left as it is. From a few ions
    or molecules within the cut-off on it is balanced, also at the surface of a liquid.

    The function calls `setPMEParameters` of each NonbondedForce, ConstantPotentialForce, AmoebaMultipoleForce and
    HippoNonbondedForce with PME, also inside an ATMForce or a CustomCVForce, and replaces earlier parameters. The
    dispersion of LJPME and of a HippoNonbondedForce is not changed.

    Args:
        system: the System, which changes.
        constantEnergy: whether it is simulated at constant energy. False takes OpenMM's mesh, except for multipoles and
            in triclinic boxes.

    Returns:
        Whether the sums of a Force are balanced now.

    Raises:
        ValueError: no Force of the System uses PME or LJPME; a cut-off is not positive or a tolerance outside
            `TOLERANCES`; or the System already has a Context. The System is unchanged then.
    """
    refuse_bound(system)
    forces = meshed_forces(system)
    if not forces:
        raise ValueError(
            "balance_pme requires a Force with PME or LJPME, such as a NonbondedForce, but the System has none"
        )
    box = _box(system)
    split = AT_CONSTANT_ENERGY if constantEnergy else IN_BATH
    balanced = [(force, sums) for force in forces if (sums := _balanced(force, box, split))]
    for force, (alpha, mesh) in balanced:
        force.setPMEParameters(alpha, *mesh)
    return bool(balanced)


def warn_about_pme(system: openmm.System, scheme: str) -> None:
    """Warn about unbalanced PME with a fourth-order integrator, whose scheme has the given name."""
    loose = [force for force in meshed_forces(system) if not pme_parameters(force)[0]]
    if any(_is_better(force, _box(system), AT_CONSTANT_ENERGY) for force in loose):
        warn(
            "Call prepare_system(system) before the Context is made. Otherwise the energy of PME jumps at the "
            f"cut-off, and {scheme} is hardly better than Verlet: at OpenMM's defaults the energy error of water "
            "within 1 ps is 1.2 to 1.6 %, but 0.1 % on a prepared System, at the same cost. The ewaldErrorTolerance "
            f"of this System is {loose[0].getEwaldErrorTolerance():g}"
        )


def meshed_forces(system: openmm.System) -> list[openmm.Force]:
    """Return the Forces of a System that use PME or LJPME, including Forces inside other Forces."""
    return [entry.force for entry in all_forces(system) if _has_mesh(entry.force)]


def mesh_of(force: openmm.Force, system: openmm.System) -> tuple[int, ...]:
    """Return the numbers of mesh points of a Force along the box vectors: its own, or those that OpenMM will choose."""
    alpha, *mesh = pme_parameters(force)
    return tuple(mesh) if alpha else _by_rule(force, _box(system).diagonal(), Split(1, 1.0)).mesh


def _has_mesh(force: openmm.Force) -> bool:
    methods = kind_of(force).meshes
    return methods is not None and (not methods or force.getNonbondedMethod() in methods)


def _box(system: openmm.System) -> np.ndarray:
    """Return the box vectors, (3, 3), nm."""
    return np.array([vector.value_in_unit(unit.nanometer) for vector in system.getDefaultPeriodicBoxVectors()])


def _balanced(force: openmm.Force, box: np.ndarray, split: Split) -> Sums | None:
    """Return balanced sums, or None if OpenMM's are more accurate."""
    tolerance = force.getEwaldErrorTolerance()
    cutoff = force.getCutoffDistance().value_in_unit(unit.nanometer)
    least, largest = TOLERANCES
    if not least <= tolerance <= largest:
        raise ValueError(f"ewaldErrorTolerance must be from {least:g} to {largest:g}, got {tolerance:g}")
    if not 0 < cutoff < math.inf:
        raise ValueError(f"the cut-off distance must be positive, got {cutoff:g} nm")
    return _sums(force, box, split) if _is_better(force, box, split) else None


def _sums(force: openmm.Force, box: np.ndarray, split: Split) -> Sums:
    """Return balanced sums; multipoles have a split of their own."""
    if kind_of(force).charges == "multipoles":
        split = MULTIPOLES
    # A mesh resolves the Fourier terms along a box vector by its spacing along that vector.
    return _by_rule(force, np.linalg.norm(box, axis=1), split)


def _by_rule(force: openmm.Force, edges: np.ndarray, split: Split) -> Sums:
    """Return sums by the formulas of OpenMM's user guide, "Coulomb interaction with particle mesh Ewald"."""
    tolerance = force.getEwaldErrorTolerance()
    cutoff = force.getCutoffDistance().value_in_unit(unit.nanometer)
    usual = math.sqrt(-math.log(2 * tolerance)) / cutoff
    mesh = tuple(math.ceil(split.finer * 2 * usual * edge / (3 * tolerance**0.2)) for edge in edges.tolist())
    return Sums(math.sqrt(-math.log(2 * tolerance / split.direct_share)) / cutoff, mesh)


@tables.read_once()
def _is_better(force: openmm.Force, box: np.ndarray, split: Split) -> bool:
    """Return whether balanced sums are at least as accurate as OpenMM's, which follow the diagonal of the box vectors.

    Only charges of a NonbondedForce are known; all others are taken for dense.
    """
    if not isinstance(force, openmm.NonbondedForce):
        return True
    usual = _by_rule(force, box.diagonal(), Split(1, 1.0))
    return _squared_error(force, box, _sums(force, box, split)) <= _squared_error(force, box, usual)


def _squared_error(force: openmm.NonbondedForce, box: np.ndarray, sums: Sums) -> float:
    """Return the expected square of the errors of forces on independent charges, but for a constant factor.

    The direct sum: Kolafa and Perram, Mol. Simul. 9, 351 (1992). The mesh: `SELF` and `PAIRS`.
    """
    squares = tables.atom_parameters(force)[:, 0] ** 2
    cutoff = force.getCutoffDistance().value_in_unit(unit.nanometer)
    by_spacing = sums.alpha * np.linalg.norm(box, axis=1) / sums.mesh
    direct = 4 / cutoff * math.exp(-2 * (sums.alpha * cutoff) ** 2)
    pairs = PAIRS**2 * sums.alpha * np.mean(by_spacing**10)
    alone = SELF**2 * sums.alpha**4 * np.mean(by_spacing**11)
    return float(squares.sum() ** 2 / abs(np.linalg.det(box)) * (direct + pairs) + (squares**2).sum() * alone)
