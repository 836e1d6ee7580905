"""Find the Forces of a System that can act within drifts, and give them force groups."""

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.prepare.close_pairs import NAME, fast_force_groups, own_forces
from openmm_sier.prepare.joined_bodies import NAME as BODIES
from openmm_sier.prepare.joined_bodies import refuse_torn_bodies, remembered_pairs
from openmm_sier.system import tables
from openmm_sier.system.arguments import GROUPS, Bodies
from openmm_sier.system.bonded_terms import working_terms
from openmm_sier.system.find_bodies import BodyPlan, linked
from openmm_sier.system.forces import kind_of
from openmm_sier.system.inner_forces import all_forces


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
            i: force for i, force in enumerate(system.getForces()) if i not in own and kind_of(force).exerts_forces
        }
        working = {i: between for i, force in self.acting.items() if len(between := working_terms(force, owner))}
        self.owner = owner
        self.fast = {i: self.acting[i] for i, between in working.items() if self.moving[between].all()}
        self.slow = [self.acting[i] for i in working if i not in self.fast]
        inner = [
            (entry, working_terms(entry.force, owner))
            for entry in all_forces(system)
            if entry.containers and entry.weight
        ]
        self.inner = [entry.name for entry, between in inner if len(between) and self.moving[between].all()]

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


def find_fast_groups(system: openmm.System, bodies: Bodies) -> int:
    """Return the bit mask of the fast force groups of a System; 0 if it is not prepared.

    Forces that were added after the preparation stay in the kicks.

    Args:
        system: openmm.System.
        bodies: those of the integrator.

    Raises:
        openmm.OpenMMException: force groups were changed after the preparation.
    """
    marked = fast_force_groups(system)
    names = [force.getName() for force in system.getForces()]
    end = names.index(NAME) if marked else 0
    known = None
    for i, force in enumerate(system.getForces() if marked else ()):
        kind = kind_of(force)
        if not kind.exerts_forces or names[i] in (NAME, BODIES):
            continue
        is_marked = any(marked >> group & 1 for group in _groups(force))
        if is_marked == (i < end and kind.terms is not None):
            continue
        # Forces on virtual sites and frozen atoms are bonded but slow. Most often there are none, and then nobody has
        # to know the bodies.
        known = known or FastForces(system, bodies)
        if is_marked != (i < end and i in known.fast):
            raise openmm.OpenMMException(
                f"The force group of {names[i]} was changed after prepare_system. Set force groups first, or call "
                "prepare_system(system) again"
            )
    return marked


def refuse_other_bodies(system: openmm.System, bodies: Bodies) -> None:
    """Refuse an integrator's bodies in a System that was prepared for others.

    Raises:
        RigidityError: atoms of a body for which it was prepared are in none, or in several.
    """
    if len(pairs := remembered_pairs(system)):
        refuse_torn_bodies(pairs, _owners(system, bodies))


def _groups(force: openmm.Force) -> set[int]:
    """Return the force groups of a Force, with that of its reciprocal space."""
    found = {force.getForceGroup()}
    if isinstance(force, openmm.NonbondedForce) and (reciprocal := force.getReciprocalSpaceForceGroup()) >= 0:
        found.add(reciprocal)
    return found


def _owners(system: openmm.System, bodies: Bodies | BodyPlan) -> np.ndarray:
    """Return for each particle the number of its body, (N,), -1 where it has none."""
    if isinstance(bodies, BodySet):
        return linked(system, bodies).owners.copy()
    plan = bodies if isinstance(bodies, BodyPlan) else BodyPlan(system, rigid=bodies)
    owner = np.full(system.getNumParticles(), -1)
    clusters = (cluster for kind in plan.kinds for cluster in kind.clusters)
    for number, cluster in enumerate(clusters):
        owner[list(cluster)] = number
    return owner
