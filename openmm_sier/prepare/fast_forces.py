"""Find the Forces of a System that can act within drifts, and their force groups."""

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.prepare.close_pairs import NAME, added_forces, fast_force_groups
from openmm_sier.prepare.joined_bodies import NAME as BODIES
from openmm_sier.prepare.joined_bodies import refuse_torn_bodies, remembered_pairs
from openmm_sier.system import tables
from openmm_sier.system.arguments import GROUPS, Bodies
from openmm_sier.system.bonded_terms import working_terms
from openmm_sier.system.find_bodies import BodyPlan
from openmm_sier.system.forces import kind_of
from openmm_sier.system.inner_forces import all_forces
from openmm_sier.system.links import linked


class FastForces:
    """Fast and slow Forces of a System, for the given bodies.

    A Force can be fast if it is bonded, does work, and acts only on rigid and point bodies, not on virtual sites or
    frozen atoms. Forces added by the preparation are left out.

    Attributes:
        owner: body index of each particle, (N,); -1 without a body; frozen atoms share an index, and virtual sites
            placed by one body belong to it.
        moving: whether each particle moves with a body, (N,).
        acting: Forces that exert forces, by index.
        fast: Forces that can be fast, by index.
        slow: bonded Forces that do work but cannot be fast.
        inner: names of bonded Forces that cannot be fast only because another Force contains them.
    """

    def __init__(self, system: openmm.System, bodies: Bodies | BodyPlan):
        owner = _owners(system, bodies)
        self.moving = owner >= 0
        # Terms between frozen atoms do no work, like those inside one body.
        owner[tables.frozen_without(system, owner)] = owner.max(initial=-1) + 1
        added = added_forces(system)
        self.acting = {
            i: force for i, force in enumerate(system.getForces()) if i not in added and kind_of(force).exerts_forces
        }
        working = {i: between for i, force in self.acting.items() if len(between := working_terms(force, owner))}
        self.owner = tables.with_sites(system, owner)
        self.fast = {i: self.acting[i] for i, between in working.items() if self.moving[between].all()}
        others = [self.acting[i] for i in working if i not in self.fast]
        self.slow = [force for force in others if len(working_terms(force, self.owner))]
        inner = [
            (entry, working_terms(entry.force, owner))
            for entry in all_forces(system)
            if entry.containers and not entry.is_variable
        ]
        self.inner = [entry.name for entry, between in inner if len(between) and self.moving[between].all()]

    def others_in(self, group: int) -> list[openmm.Force]:
        """Return the Forces of a group that cannot be fast."""
        return [force for i, force in self.acting.items() if group in _groups(force) and i not in self.fast]

    def free_group(self) -> int:
        """Return a group for the fast forces: 1 or, if that has other forces, the first group without any."""
        return next(group for group in (*range(1, GROUPS), 0) if not self.others_in(group))


def find_fast_groups(system: openmm.System, bodies: Bodies) -> int:
    """Return the bit mask of the fast force groups of a System; 0 if it is not prepared.

    Forces added after the preparation stay in the kicks.

    Args:
        system: openmm.System.
        bodies: the bodies of the integrator.

    Raises:
        openmm.OpenMMException: force groups were changed after the preparation.
    """
    marked = fast_force_groups(system)
    names = [force.getName() for force in system.getForces()]
    end = names.index(NAME) if marked else 0
    sorted_forces = None
    for i, force in enumerate(system.getForces() if marked else ()):
        kind = kind_of(force)
        if not kind.exerts_forces or names[i] in (NAME, BODIES):
            continue
        is_marked = any(marked >> group & 1 for group in _groups(force))
        if is_marked == (i < end and kind.terms is not None):
            continue
        # Bonded Forces on virtual sites and frozen atoms are slow. Usually there are none, and bodies are not needed.
        sorted_forces = sorted_forces or FastForces(system, bodies)
        if is_marked != (i < end and i in sorted_forces.fast):
            raise openmm.OpenMMException(
                f"The force group of {names[i]} was changed after prepare_system. Set force groups first, or call "
                "prepare_system(system) again"
            )
    return marked


def refuse_other_bodies(system: openmm.System, bodies: Bodies) -> None:
    """Refuse an integrator's bodies in a System prepared for other bodies.

    Raises:
        RigidityError: atoms of a body in the preparation are in no body, or in several.
    """
    if len(pairs := remembered_pairs(system)):
        refuse_torn_bodies(pairs, _owners(system, bodies))


def _groups(force: openmm.Force) -> set[int]:
    """Return the force groups of a Force, including that of its reciprocal space."""
    groups = {force.getForceGroup()}
    if isinstance(force, openmm.NonbondedForce) and (reciprocal := force.getReciprocalSpaceForceGroup()) >= 0:
        groups.add(reciprocal)
    return groups


def _owners(system: openmm.System, bodies: Bodies | BodyPlan) -> np.ndarray:
    """Return the body index of each particle, (N,); -1 without a body."""
    if isinstance(bodies, BodySet):
        return linked(system, bodies).owners.copy()
    plan = bodies if isinstance(bodies, BodyPlan) else BodyPlan(system, rigid=bodies)
    owner = np.full(system.getNumParticles(), -1)
    clusters = (cluster for kind in plan.kinds for cluster in kind.clusters)
    for number, cluster in enumerate(clusters):
        owner[list(cluster)] = number
    return owner
