"""Nonbonded interactions of atoms a few bonds apart, which act within drifts and not in the kicks.

Atoms up to four bonds apart feel steep nonbonded forces while angles bend, with periods of 20 fs for hydrogen. In the
kicks these forces limit the step of a peptide; with them inside the drifts its energy error at 6 fs is a seventh.

The NonbondedForce stays as it is. A force of its own computes the close pairs once more, in the fast group, and another
one subtracts them in the kicks. The two cancel whatever is done to the other Forces later, so that the System remains
what it was: if charges are scaled after that, only the division into fast and slow forces becomes less good.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Iterator

import numpy as np
import openmm

from openmm_sier.prepare.joined_bodies import NAME as BODIES
from openmm_sier.system import tables
from openmm_sier.system.forces import kind_of
from openmm_sier.system.inner_forces import all_forces

#: Largest number of bonds between atoms of a close pair. Those further apart make no difference.
REACH = 4

#: 1/(4 pi epsilon_0) in kJ/mol nm/e^2, as OpenMM has it.
COULOMB = 138.93545764438198

#: Names of the two Forces. XML and copies keep them, and a prepared System is recognized by them.
NAME = "openmm_sier: close pairs"
OPPOSITE = "openmm_sier: close pairs, subtracted"

#: Coulomb's law and Lennard-Jones by powers of r alone, which take half as long as with sigma and epsilon.
ENERGY = "coulomb*u + (repulsion*u6 - attraction)*u6; u6 = u^6; u = 1/r"


def own_forces(system: openmm.System) -> list[int]:
    """Return numbers of the Forces that preparation added to a System."""
    return [i for i, force in enumerate(system.getForces()) if force.getName() in (NAME, OPPOSITE, BODIES)]


def fast_force_groups(system: openmm.System) -> int:
    """Return the bit mask of the fast force groups of a prepared System; 0 for any other System."""
    return sum({1 << force.getForceGroup() for force in system.getForces() if force.getName() == NAME})


def add_close_pairs(system: openmm.System, edges: np.ndarray, owner: np.ndarray, group: int, periodic: bool) -> int:
    """Add the interactions of close pairs to a fast group, and subtract them from that of the NonbondedForce.

    They are those of the NonbondedForces and ConstantPotentialForces as they are now, also within other Forces, with
    global parameters at their defaults, and without cut-off and switch. The potential energy is unchanged. Without a
    close pair there is an empty Force in the fast group, by which the System is recognized, and nothing is subtracted.

    Args:
        system: openmm.System, which has none of `own_forces`.
        edges: bonded pairs of particles, (b, 2), all of which may act within drifts.
        owner: for each particle the number of its body, (N,); pairs within one body do no work, and are left out.
        group: the fast force group.
        periodic: whether distances are those of the nearest images.

    Returns:
        How many pairs there are.
    """
    # Forces of multipoles are softer at close distance, by Thole's damping.
    pairwise = [entry for entry in all_forces(system) if kind_of(entry.force).charges == "points"]
    found = [(entry, weight) for entry in pairwise if (weight := entry.weight)]
    close = _close(edges, owner)
    fast = _pair_force(NAME, "", group, periodic)
    opposite = _pair_force(OPPOSITE, "-", found[0][0].group if found else 0, periodic)
    for entry, weight in found:
        for a, b, (q, sigma, epsilon) in _interactions(entry.force, close):
            parameters = [weight * COULOMB * q, 4 * weight * epsilon * sigma**12, 4 * weight * epsilon * sigma**6]
            fast.addBond(a, b, parameters)
            opposite.addBond(a, b, parameters)
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


def _interactions(force: openmm.Force, close: list[tuple[int, int]]) -> Iterator[tuple[int, int, np.ndarray]]:
    """Return the close pairs that a Force lets interact: both atoms, and charge product, sigma and epsilon."""
    if isinstance(force, openmm.ConstantPotentialForce):
        force = _of_charges(force)
    offsets = _offsets(force, force.getNumParticleParameterOffsets(), force.getParticleParameterOffset)
    atoms = {
        i: tables.numbers(force.getParticleParameters(i), tables.ATOM_UNITS) + offsets[i]
        for i in {i for pair in close for i in pair}
    }
    offsets = _offsets(force, force.getNumExceptionParameterOffsets(), force.getExceptionParameterOffset)
    exceptions, wanted = {}, set(close)
    for number in range(force.getNumExceptions()):
        a, b, *parameters = force.getExceptionParameters(number)
        if (pair := (min(a, b), max(a, b))) in wanted:
            exceptions[pair] = tables.numbers(parameters, tables.PAIR_UNITS) + offsets[number]
    for a, b in close:
        found = exceptions.get((a, b))
        if found is None:
            (q, sigma, epsilon), (other_q, other_sigma, other_epsilon) = atoms[a], atoms[b]
            found = np.array([q * other_q, (sigma + other_sigma) / 2, math.sqrt(max(0.0, epsilon * other_epsilon))])
        if found[0] or found[2]:
            yield a, b, found


def _of_charges(force: openmm.ConstantPotentialForce) -> openmm.NonbondedForce:
    """Make a NonbondedForce of the charges and exceptions of a ConstantPotentialForce."""
    charges = openmm.NonbondedForce()
    for i in range(force.getNumParticles()):
        charges.addParticle(force.getParticleParameters(i), 1, 0)
    for i in range(force.getNumExceptions()):
        a, b, product = force.getExceptionParameters(i)
        charges.addException(a, b, product, 1, 0)
    return charges


def _offsets(force: openmm.NonbondedForce, count: int, get: Callable) -> dict[int, np.ndarray]:
    """Return the offsets of the parameters of particles or exceptions at defaults of global parameters."""
    names = range(force.getNumGlobalParameters())
    defaults = {force.getGlobalParameterName(i): force.getGlobalParameterDefaultValue(i) for i in names}
    found: dict[int, np.ndarray] = defaultdict(lambda: np.zeros(3))
    for parameter, index, *scales in map(get, range(count)):
        found[index] += defaults[parameter] * np.array(scales)
    return found


def _close(edges: np.ndarray, owner: np.ndarray) -> list[tuple[int, int]]:
    """Find pairs (smaller, larger) of two bodies' particles that are up to `REACH` edges (b, 2) apart, ascending."""
    # Rigid molecules have none, such as water, of which there is most.
    near = _near_others(edges, owner)
    edges = edges[near[edges].any(axis=1)]
    if not len(edges):
        return []
    # Most systems have no solute, and need not import this.
    from scipy import sparse

    particles = len(owner)
    joined = sparse.coo_array((np.ones(len(edges), dtype=bool), tuple(edges.T)), (particles, particles)).tocsr()
    step = joined + joined.T + sparse.eye_array(particles, dtype=bool, format="csr")
    reached = step
    for _ in range(REACH - 1):
        reached = reached @ step
    one, other = sparse.triu(reached, k=1).nonzero()
    apart = owner[one] != owner[other]
    return sorted(zip(one[apart].tolist(), other[apart].tolist(), strict=True))


def _near_others(edges: np.ndarray, owner: np.ndarray) -> np.ndarray:
    """Tell which particles are ends of bonds between bodies, or fewer than `REACH` edges from one, (N,)."""
    near = np.zeros(len(owner), dtype=bool)
    near[edges[owner[edges[:, 0]] != owner[edges[:, 1]]]] = True
    for _ in range(REACH - 1):
        near[edges[near[edges].any(axis=1)]] = True
    return near
