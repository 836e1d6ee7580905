"""Find the Forces of a System that can act within drifts, and give them force groups."""

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import RigidBodies
from openmm_sier.prepare.close_pairs import NAME, OPPOSITE, fast_force_groups, own_forces
from openmm_sier.prepare.joined_bodies import NAME as BODIES
from openmm_sier.prepare.joined_bodies import refuse_torn_bodies, remembered_pairs
from openmm_sier.system import tables
from openmm_sier.system.arguments import GROUPS, Bodies, groups_of
from openmm_sier.system.bonded_terms import WITHOUT_FORCES, bonded_kind, working_terms
from openmm_sier.system.find_bodies import BodyPlan, linked
from openmm_sier.system.inner_forces import parts
from openmm_sier.system.notices import notify


class FastForces:
    """Sort the Forces of a System into those that can be fast, with some bodies, and those that cannot.

    A Force can be fast if it is a bonded one, does work, and acts on nothing but bodies, rigid ones and points: no
    virtual site or frozen atom. Forces that the preparation added are left out.

    Attributes:
        owner: for each particle the number of its body, (N,), -1 where it has none; frozen atoms have one together.
        moving: for each particle whether it moves with a body, (N,).
        acting: Forces that exert forces, by their numbers.
        fast: those that can be fast, by their numbers.
        slow: bonded Forces that do work and cannot be fast.
        inner: names of bonded Forces that another Force contains, and that could be fast if none did.
    """

    def __init__(self, system: openmm.System, bodies: Bodies | BodyPlan):
        owner = _owners(system, bodies)
        self.moving = owner >= 0
        # Terms between frozen atoms do no work, like those inside one body.
        owner[tables.frozen_atoms(system)] = owner.max(initial=-1) + 1
        own = own_forces(system)
        self.acting = {
            i: force
            for i, force in enumerate(system.getForces())
            if i not in own and not isinstance(force, WITHOUT_FORCES)
        }
        working = {i: between for i, force in self.acting.items() if len(between := working_terms(force, owner))}
        self.owner = owner
        self.fast = {i: self.acting[i] for i, between in working.items() if self.moving[between].all()}
        self.slow = [self.acting[i] for i in working if i not in self.fast]
        inner = [(part, working_terms(part.force, owner)) for part in parts(system) if part.within and part.weight]
        self.inner = [part.name for part, between in inner if len(between) and self.moving[between].all()]

    def others_in(self, group: int) -> list[openmm.Force]:
        """Return the Forces of a group that cannot be fast."""
        return [force for i, force in self.acting.items() if group in _groups(force) and i not in self.fast]

    def free_group(self) -> int:
        """Return a group for the fast forces: 1 or, if that has other forces, the first that has none.

        Raises:
            ValueError: all groups have other forces.
        """
        for group in (*range(1, GROUPS), 0):
            if not self.others_in(group):
                return group
        raise ValueError(
            f"all {GROUPS} force groups are taken, and fast forces need their own: join other groups by setForceGroup"
        )


def find_fast_groups(system: openmm.System, bodies: Bodies, says: bool = False) -> int:
    """Return the bit mask of the fast force groups of a System; 0 if it is not prepared.

    They are those of the preparation. If somebody has regrouped the Forces since, they are all groups that hold only
    what the preparation made fast. Forces that were added later stay in the kicks.

    Args:
        system: openmm.System.
        bodies: those of the integrator.
        says: whether to warn of fast forces that now share a group with others.
    """
    marked = fast_force_groups(system)
    names = [force.getName() for force in system.getForces()]
    if not marked or not _may_be_regrouped(system, marked, names.index(NAME)):
        return marked
    known = FastForces(system, bodies)
    fast = {i: force for i, force in known.fast.items() if i < names.index(NAME)}
    fast |= {i: system.getForce(i) for i, name in enumerate(names) if name == NAME}
    taken = {force.getForceGroup() for force in system.getForces() if force.getName() == OPPOSITE}
    taken |= {group for i, force in known.acting.items() if i not in fast for group in _groups(force)}
    groups = {force.getForceGroup() for force in fast.values()} - taken
    mask = sum(1 << group for group in groups)
    if says and (left := [force.getName() for force in fast.values() if force.getForceGroup() in taken]):
        notify(
            f"Force groups were changed after prepare_system: {', '.join(left)} now share a group with slow forces, so "
            f"that they act as slow forces and limit the step (fast force groups: {groups_of(mask) or 'none'}). Set "
            "force groups before you call prepare_system(system), or give these Forces groups of their own"
        )
    return mask


def refuse_other_bodies(system: openmm.System, bodies: Bodies) -> None:
    """Refuse an integrator's bodies in a System that was prepared for others.

    Raises:
        RigidityError: atoms of a body for which it was prepared are in none, or in several.
    """
    if len(pairs := remembered_pairs(system)):
        refuse_torn_bodies(pairs, _owners(system, bodies))


def _may_be_regrouped(system: openmm.System, marked: int, end: int) -> bool:
    """Tell whether a Force before the number `end` is bonded and not in a marked group, or in one and not bonded.

    Most often no Force is, and then nobody has to know the bodies.
    """
    for i, force in enumerate(system.getForces()):
        if isinstance(force, WITHOUT_FORCES) or force.getName() == NAME:
            continue
        is_marked = any(marked >> group & 1 for group in _groups(force))
        is_bonded = bonded_kind(force) is not None and force.getName() not in (OPPOSITE, BODIES)
        if is_marked != (is_bonded and i < end):
            return True
    return False


def _groups(force: openmm.Force) -> set[int]:
    """Return the force groups of a Force, with that of its reciprocal space."""
    found = {force.getForceGroup()}
    if isinstance(force, openmm.NonbondedForce) and (reciprocal := force.getReciprocalSpaceForceGroup()) >= 0:
        found.add(reciprocal)
    return found


def _owners(system: openmm.System, bodies: Bodies | BodyPlan) -> np.ndarray:
    """Return for each particle the number of its body, (N,), -1 where it has none."""
    if isinstance(bodies, RigidBodies):
        return linked(system, bodies).owners.copy()
    plan = bodies if isinstance(bodies, BodyPlan) else BodyPlan(system, rigid=bodies)
    owner = np.full(system.getNumParticles(), -1)
    clusters = (cluster for kind in plan.kinds for cluster in kind.clusters)
    for number, cluster in enumerate(clusters):
        owner[list(cluster)] = number
    return owner
