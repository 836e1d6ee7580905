"""Preparation of a System for long steps: fast forces in their own group, and balanced PME sums."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.bodies import RigidBodies
from openmm_sier.prepare import close_pairs
from openmm_sier.prepare.pme import balance_pme, meshed_forces
from openmm_sier.system import tables
from openmm_sier.system.arguments import GROUPS, whole_number
from openmm_sier.system.bonded_terms import WITHOUT_FORCES, bonded_kind, bonded_terms
from openmm_sier.system.find_bodies import BodyPlan, Links, tied

#: Largest ewaldErrorTolerance that serves every scheme.
TOLERANCE = 1e-4


@dataclass(frozen=True)
class Preparation:
    """What `prepare_system` did; print it.

    Attributes:
        fastForceGroups: the fast force groups, which integrators find in the System; empty if no force is fast.
        done: a sentence for each thing that was done or left as it was.
        limits: a sentence for each thing that still limits how well energy is conserved, with its remedy.
    """

    fastForceGroups: frozenset[int]
    done: tuple[str, ...]
    limits: tuple[str, ...] = ()

    def __str__(self) -> str:
        return "\n".join(self.done + self.limits)


def prepare_system(system: openmm.System, bodies: RigidBodies | None = None, fastForceGroup: int = 1) -> Preparation:
    """Prepare a System, of water alone or with solutes, for long steps.

    The potential energy stays what it is, but for the accuracy of PME:

    - The sums of PME are balanced, see `balance_pme`.
    - Bonds, angles and torsions of molecules that are not rigid get a force group of their own, in which every SIER
      integrator finds them. A Force keeps its group if one of its terms joins a rigid body to another body or acts on a
      virtual site, since fast forces move only points.
    - If there are such forces, nonbonded interactions between atoms of these molecules up to four bonds apart are added
      to that group by one CustomBondForce and subtracted in the group of the NonbondedForce by another one. The
      NonbondedForce is not changed. Whatever is done to charges, exceptions and other Forces afterwards, the sum of all
      forces is that of the System without preparation.

    Preparing a System again for the same bodies renews all of this; for other bodies prepare a new System. A Context
    must be created after the preparation: the integrator refuses the next step if its System was changed.

    >>> system = openmm.System()
    >>> print(prepare_system(system))
    No bonded force acts on a molecule that is not rigid.

    Args:
        system: openmm.System; its force groups and PME parameters are changed, and two Forces may be added.
        bodies: the bodies that the integrator will be given; None: those of the System's constraints.
        fastForceGroup: force group for the fast forces, from 0 to 31.

    Returns:
        The fast force groups, what was done, and what still limits the energy; print it.

    Raises:
        ValueError: the group is out of range or already has other forces, or `balance_pme` refuses. The System is
            unchanged then.
        RigidityError: see `RigidBodies.from_system`; the System is unchanged then too.
    """
    if (group := whole_number("fastForceGroup", fastForceGroup)) >= GROUPS:
        raise ValueError(f"fastForceGroup must be from 0 to {GROUPS - 1}, got {group}")
    own = close_pairs.own_forces(system)
    forces = [force for i, force in enumerate(system.getForces()) if i not in own]
    acting = [force for force in forces if not isinstance(force, WITHOUT_FORCES)]
    owner, point = _owners(system, bodies)
    # Terms between frozen atoms do no work, like those inside one body.
    owner[tables.frozen_atoms(system)] = owner.max(initial=-1) + 1
    bonded = [(force, between) for force in acting if len(between := _between(force, owner))]
    fast = [force for force, between in bonded if point[between].all()]
    for force in acting:
        if force.getForceGroup() == group and force not in fast:
            raise ValueError(
                f"{force.getName()} is in force group {group}, which is to be that of the fast forces: give another "
                "fastForceGroup or, if it was prepared for other bodies, prepare a new System"
            )
    done = []
    if meshed_forces(system):
        balance_pme(system)
        done.append("The sums of PME are balanced.")
    for i in reversed(own):
        system.removeForce(i)
    for force in fast:
        force.setForceGroup(group)
    if fast:
        done.append(f"Force group {group} has the fast forces now: {', '.join(force.getName() for force in fast)}.")
        periodic = any(force.usesPeriodicBoundaryConditions() for force in fast)
        links = Links(system)
        edges = np.concatenate([links.constraints.pairs, links.bonds, links.custom])
        edges = edges[point[edges].all(axis=1)]
        if count := close_pairs.add_close_pairs(system, edges, group, periodic):
            done.append(
                f"Nonbonded interactions of {count} pairs up to {close_pairs.REACH} bonds apart act there too, and are "
                "subtracted in the kicks."
            )
    else:
        done.append("No bonded force acts on a molecule that is not rigid.")
    if left := [force.getName() for force, _ in bonded if force not in fast]:
        why = "they act on rigid bodies, virtual sites or frozen atoms"
        done.append(f"These stay in the kicks, since {why}: {', '.join(left)}.")
    return Preparation(frozenset({group} if fast else ()), tuple(done), _energy_limits(system))


def _owners(system: openmm.System, bodies: RigidBodies | None) -> tuple[np.ndarray, np.ndarray]:
    """For each particle the number of its body, and whether that is a point."""
    if bodies is not None:
        found = tied(system, bodies)
        return found.owners, found.point_particles
    owner, point = np.full(system.getNumParticles(), -1), np.zeros(system.getNumParticles(), dtype=bool)
    number = 0
    for kind in BodyPlan(system).kinds:
        for cluster in kind.clusters:
            owner[cluster], point[cluster], number = number, len(cluster) == 1, number + 1
    return owner, point


def _between(force: openmm.Force, owner: np.ndarray) -> np.ndarray:
    """The terms of a Force that do not lie in one body; none if it is not a bonded one."""
    if bonded_kind(force) is None:
        return np.empty((0, 0), dtype=np.int64)
    terms = bonded_terms(force)
    found = owner[terms]
    return terms[(found != found[:, :1]).any(axis=1) | (found[:, 0] < 0)]


def _energy_limits(system: openmm.System) -> tuple[str, ...]:
    """A sentence for each limit that another way to create the System would remove, see docs/accuracy.md."""
    found = [
        f"{force.getName()} ends with a jump of the energy at {cutoff:.3g} nm, "
        "which in water at 0.9 nm leaves SIER4G 0.2 to 0.3 % of rms(H)/rms(V) in place of 0.1 %: create the System "
        f"with switchDistance={5 / 6 * cutoff:.2g}*nanometer."
        for force in system.getForces()
        if _jumps(force)
        for cutoff in [force.getCutoffDistance().value_in_unit(unit.nanometer)]
    ]
    if any(force.getEwaldErrorTolerance() > TOLERANCE for force in meshed_forces(system)):
        found.append(
            f"This ewaldErrorTolerance serves SIER4G. For SIER4P take {TOLERANCE:g}, which in water at 6 fs has "
            "0.0145 % in place of 0.056 %."
        )
    return tuple(dict.fromkeys(found))


def _jumps(force: openmm.Force) -> bool:
    """Whether the van der Waals energy of a Force is cut off and not switched off."""
    if isinstance(force, openmm.CustomNonbondedForce):
        return force.getNonbondedMethod() != force.NoCutoff and not force.getUseSwitchingFunction()
    if not isinstance(force, openmm.NonbondedForce) or force.getUseSwitchingFunction():
        return False
    parameters = map(force.getParticleParameters, range(force.getNumParticles()))
    epsilons = (epsilon.value_in_unit(unit.kilojoule_per_mole) for _, _, epsilon in parameters)
    return force.getNonbondedMethod() not in (force.NoCutoff, force.LJPME) and any(epsilons)
