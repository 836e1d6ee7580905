"""Move nonbonded interactions of atoms a few bonds apart from the kicks to the drifts.

Atoms up to four bonds apart feel steep nonbonded forces while angles bend, with periods of 20 fs for hydrogen. In the
kicks these forces limit the step of a peptide; inside the drifts its energy error at 6 fs is a seventh.

The NonbondedForce is not changed. A separate Force computes the close pairs once more, in the fast group, and another
one subtracts them in the kicks. The two cancel whatever happens to other Forces later, so that the potential energy is
unchanged: if charges are scaled afterwards, only the division into fast and slow forces becomes less accurate.
"""

from collections.abc import Callable

import numpy as np
import openmm

from openmm_sier.dynamics.index_ranges import distinct, of_ranges
from openmm_sier.prepare.joined_bodies import NAME as BODIES
from openmm_sier.system import tables
from openmm_sier.system.inner_forces import all_forces

#: Maximum number of bonds between atoms of a close pair; pairs further apart make no difference.
REACH = 4

#: 1/(4 pi epsilon_0) in kJ/mol nm/e^2, OpenMM's value.
COULOMB = 138.93545764438198

#: Names of the two Forces, which survive XML and copies and identify a prepared System.
NAME = "openmm_sier: close pairs"
OPPOSITE = "openmm_sier: close pairs, subtracted"

#: Coulomb and Lennard-Jones energies as powers of r, twice as fast as with sigma and epsilon.
ENERGY = "coulomb*u + (repulsion*u6 - attraction)*u6; u6 = u^6; u = 1/r"


def added_forces(system: openmm.System) -> list[int]:
    """Return the indices of Forces added to a System by preparation."""
    return [i for i, force in enumerate(system.getForces()) if force.getName() in (NAME, OPPOSITE, BODIES)]


def fast_force_groups(system: openmm.System) -> int:
    """Return the bit mask of the fast force groups of a prepared System; 0 for any other System."""
    return sum({1 << force.getForceGroup() for force in system.getForces() if force.getName() == NAME})


def add_close_pairs(system: openmm.System, edges: np.ndarray, owner: np.ndarray, group: int, periodic: bool) -> int:
    """Add the interactions of close pairs to a fast group, and subtract them from the group of the NonbondedForce.

    Interactions are those of the present NonbondedForces, including those inside an ATMForce, with global parameters at
    their defaults, and without cut-off and switch. The potential energy is unchanged. Without close pairs the fast
    group gets an empty Force, which identifies the System, and nothing is subtracted.

    Args:
        system: openmm.System without `added_forces`.
        edges: bonded pairs of particles, (b, 2), all of which may act within drifts.
        owner: body index of each particle, (N,); pairs within one body do no work, and are left out.
        group: the fast force group.
        periodic: whether distances are between nearest images.

    Returns:
        Number of pairs.
    """
    nonbonded = [
        entry
        for entry in all_forces(system)
        if isinstance(entry.force, openmm.NonbondedForce) and not entry.is_variable
    ]
    close = _close(edges, owner)
    fast = _pair_force(NAME, "", group, periodic)
    opposite = _pair_force(OPPOSITE, "-", nonbonded[0].group if nonbonded else 0, periodic)
    for entry in nonbonded:
        pairs, parameters = _interactions(entry.force, close)
        for (a, b), (q, sigma, epsilon) in zip(pairs.tolist(), parameters.tolist(), strict=True):
            values = [COULOMB * q, 4 * epsilon * sigma**12, 4 * epsilon * sigma**6]
            fast.addBond(a, b, values)
            opposite.addBond(a, b, values)
    system.addForce(fast)
    if opposite.getNumBonds():
        system.addForce(opposite)
    return fast.getNumBonds()


def _pair_force(name: str, sign: str, group: int, periodic: bool) -> openmm.CustomBondForce:
    energy, definitions = ENERGY.split(";", 1)
    force = openmm.CustomBondForce(f"{sign}({energy});{definitions}")
    for parameter in ("coulomb", "repulsion", "attraction"):
        force.addPerBondParameter(parameter)
    force.setName(name)
    force.setForceGroup(group)
    force.setUsesPeriodicBoundaryConditions(periodic)
    return force


def _interactions(force: openmm.NonbondedForce, close: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the interacting ones of close pairs, (p, 2), and charge product, sigma and epsilon of each, (p, 3)."""
    atoms = _with_offsets(
        force, tables.atom_parameters(force), force.getNumParticleParameterOffsets(), force.getParticleParameterOffset
    )
    (q, sigma, epsilon), (other_q, other_sigma, other_epsilon) = atoms[close[:, 0]].T, atoms[close[:, 1]].T
    mixed = np.sqrt(np.maximum(0.0, epsilon * other_epsilon))
    parameters = np.column_stack([q * other_q, (sigma + other_sigma) / 2, mixed])
    pairs, excepted = tables.exceptions(force)
    excepted = _with_offsets(
        force, excepted, force.getNumExceptionParameterOffsets(), force.getExceptionParameterOffset
    )
    base = [force.getNumParticles(), 1]
    numbers, wanted = np.sort(pairs, axis=1) @ base, close @ base
    is_close = np.isin(numbers, wanted)
    parameters[np.searchsorted(wanted, numbers[is_close])] = excepted[is_close]
    acting = (parameters[:, 0] != 0) | (parameters[:, 2] != 0)
    return close[acting], parameters[acting]


def _with_offsets(force: openmm.NonbondedForce, parameters: np.ndarray, count: int, get: Callable) -> np.ndarray:
    """Return parameters (m, 3) of particles or exceptions with offsets at the defaults of global parameters."""
    if not count:
        return parameters
    names = range(force.getNumGlobalParameters())
    defaults = {force.getGlobalParameterName(i): force.getGlobalParameterDefaultValue(i) for i in names}
    offsets = np.zeros_like(parameters)
    for parameter, index, *scales in map(get, range(count)):
        offsets[index] += defaults[parameter] * np.array(scales)
    return parameters + offsets


def _close(edges: np.ndarray, owner: np.ndarray) -> np.ndarray:
    """Return pairs of particles of two bodies up to `REACH` edges (b, 2) apart, the smaller first, in order, (p, 2)."""
    # Rigid molecules such as water, usually the majority, have none.
    near = _near_others(edges, owner)
    edges = edges[near[edges].any(axis=1)]
    if not len(edges):
        return np.empty((0, 2), dtype=np.int64)
    # Pairs are numbers, and go further by the edges of their second particles.
    particles = len(owner)
    ends = np.concatenate([edges, edges[:, ::-1]])
    ends = ends[np.argsort(ends[:, 0], kind="stable")]
    starts = np.searchsorted(ends[:, 0], np.arange(particles + 1))
    reached = distinct(ends @ [particles, 1])
    for _ in range(REACH - 1):
        one, middle = np.divmod(reached, particles)
        rows = of_ranges(starts[middle], starts[middle + 1])
        further = particles * np.repeat(one, starts[middle + 1] - starts[middle]) + ends[rows, 1]
        reached = distinct(np.concatenate([reached, further]))
    one, other = np.divmod(reached, particles)
    apart = (one < other) & (owner[one] != owner[other])
    return np.column_stack([one[apart], other[apart]])


def _near_others(edges: np.ndarray, owner: np.ndarray) -> np.ndarray:
    """Return which particles are ends of bonds between bodies, or fewer than `REACH` edges from one, (N,)."""
    near = np.zeros(len(owner), dtype=bool)
    near[edges[owner[edges[:, 0]] != owner[edges[:, 1]]]] = True
    for _ in range(REACH - 1):
        near[edges[near[edges].any(axis=1)]] = True
    return near
