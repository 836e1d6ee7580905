"""Preparation of a System for long steps: fast forces in their own group, and balanced PME sums."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import RigidBodies
from openmm_sier.prepare import close_pairs
from openmm_sier.prepare.pme import balance_pme, meshed_forces
from openmm_sier.system import tables
from openmm_sier.system.arguments import GROUPS, whole_number
from openmm_sier.system.bonded_terms import WITHOUT_FORCES, bonded_kind, bonded_terms
from openmm_sier.system.find_bodies import BodyPlan, constraint_lengths, tied
from openmm_sier.system.links import Links


@dataclass(frozen=True)
class Preparation:
    """What `prepare_system` did; print it.

    Attributes:
        fastForceGroups: to pass to the integrator; empty if no force is fast.
        done: a sentence for each thing that was done or left as it was.
    """

    fastForceGroups: frozenset[int]
    done: tuple[str, ...]

    def __str__(self) -> str:
        return "\n".join(self.done)


def prepare_system(system: openmm.System, bodies: RigidBodies | None = None, fastForceGroup: int = 1) -> Preparation:
    """Prepare a System for steps that are long compared with the vibrations of its molecules.

    Bonds, angles and torsions of molecules that are not rigid get their own force group, which the integrator takes as
    `fastForceGroups`. Nonbonded interactions between atoms of these molecules up to four bonds apart become a
    CustomBondForce in that group, where the NonbondedForce allows it; the potential energy is unchanged. The sums of
    PME are balanced, see `balance_pme`. A Force keeps its group if one of its terms joins a rigid body to another body
    or acts on a virtual site, since fast forces move only points.

    >>> system = openmm.System()
    >>> print(prepare_system(system))
    No bonded force acts on a molecule that is not rigid.

    Args:
        system: openmm.System; its force groups, PME parameters and exceptions are changed. Call this before a Context
            is created.
        bodies: the bodies that the integrator will be given; None: those of the System's constraints.
        fastForceGroup: force group for the fast forces, from 0 to 31.

    Returns:
        The fast force groups, and sentences about what was done.

    Raises:
        ValueError: the group is out of range or already has other forces, or `balance_pme` refuses. The System is
            unchanged then.
        RigidityError: see `RigidBodies.from_system`; the System is unchanged then too.
    """
    if (group := whole_number("fastForceGroup", fastForceGroup)) >= GROUPS:
        raise ValueError(f"fastForceGroup must be from 0 to {GROUPS - 1}, got {group}")
    acting = [force for force in system.getForces() if not isinstance(force, WITHOUT_FORCES)]
    owner, point = _owners(system, bodies)
    # Terms between frozen atoms do no work, like those inside one body.
    owner[tables.frozen_atoms(system)] = owner.max(initial=-1) + 1
    fast = [force for force in acting if _is_fast(force, owner, point)]
    for force in acting:
        if force.getForceGroup() == group and force not in fast:
            raise ValueError(
                f"{force.getName()} is in force group {group}, which is to be that of the fast forces: give another "
                "fastForceGroup"
            )
    done = [_balanced(system)] if meshed_forces(system) else []
    for force in fast:
        force.setForceGroup(group)
    names = ", ".join(force.getName() for force in fast)
    if fast:
        done.append(_separated(system, owner, point, group))
    moved = f"Force group {group} has the fast forces now, for fastForceGroups={{{group}}}: {names}."
    done.append(moved if fast else "No bonded force acts on a molecule that is not rigid.")
    left = [
        force.getName() for force in acting if force not in fast and bonded_kind(force) and _has_terms(force, owner)
    ]
    if left:
        why = "they act on rigid bodies, virtual sites or frozen atoms"
        done.append(f"These stay in the kicks, since {why}: {', '.join(left)}.")
    return Preparation(frozenset({group} if fast else ()), tuple(done))


def _balanced(system: openmm.System) -> str:
    balance_pme(system)
    return "The sums of PME are balanced."


def _separated(system: openmm.System, owner: np.ndarray, point: np.ndarray, group: int) -> str:
    if (reason := close_pairs.why_not(system)) is not None:
        return f"Nonbonded interactions of atoms a few bonds apart stay in the kicks, since {reason}."
    links = Links(system, constraint_lengths(system))
    edges = np.concatenate([links.pairs, links.bonds, links.custom])
    count = close_pairs.move_close_pairs(system, edges[point[edges].all(axis=1)], point, group)
    return (
        f"Nonbonded interactions of {count} pairs up to {close_pairs.REACH} bonds apart are a force of their own now."
    )


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


def _between(terms: np.ndarray, owner: np.ndarray) -> np.ndarray:
    """The terms that do not lie in one body."""
    found = owner[terms]
    return terms[(found != found[:, :1]).any(axis=1) | (found[:, 0] < 0)]


def _has_terms(force: openmm.Force, owner: np.ndarray) -> bool:
    return bool(len(_between(bonded_terms(force), owner)))


def _is_fast(force: openmm.Force, owner: np.ndarray, point: np.ndarray) -> bool:
    """Whether a Force is a bonded one, and all of its terms between bodies are between points."""
    if bonded_kind(force) is None:
        return False
    between = _between(bonded_terms(force), owner)
    return bool(len(between)) and bool(point[between].all())
