"""Prepare a System for long steps: fast forces in a separate group, and balanced PME sums."""

from dataclasses import dataclass

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.prepare import close_pairs
from openmm_sier.prepare.contacts import describe_contacts
from openmm_sier.prepare.cutoff_discontinuities import describe_discontinuities
from openmm_sier.prepare.fast_forces import FastForces
from openmm_sier.prepare.joined_bodies import join_bodies
from openmm_sier.prepare.masses import checked_mass, set_hydrogen_masses
from openmm_sier.prepare.pme import balance_pme, meshed_forces
from openmm_sier.prepare.split_terms import divided
from openmm_sier.prepare.stiffness import Stiffest, describe_coarse, stiffest
from openmm_sier.system import tables
from openmm_sier.system.arguments import (
    GROUPS,
    Bodies,
    Positions,
    Quantity,
    checked_bodies,
    checked_positions,
    checked_system,
    whole_number,
)
from openmm_sier.system.bound_systems import refuse_bound
from openmm_sier.system.checks import refuse_sites_without_place
from openmm_sier.system.find_bodies import BodyPlan
from openmm_sier.system.links import links_of


@dataclass(frozen=True)
class Preparation:
    """Result of `prepare_system`. Print it for a summary.

    Attributes:
        fastForceGroups: the fast force groups, which integrators find in the System; empty if no force is fast.
        done: sentences on changes, and on forces left unchanged.
        limits: sentences on remaining limits of energy conservation, with remedies.
    """

    fastForceGroups: frozenset[int]
    done: tuple[str, ...]
    limits: tuple[str, ...] = ()

    def __str__(self) -> str:
        return "\n".join(self.done + self.limits)


def prepare_system(
    system: openmm.System,
    bodies: Bodies = None,
    fastForceGroup: int | None = None,
    hydrogenMass: Quantity | None = None,
    positions: Positions | None = None,
) -> Preparation:
    """Prepare a System, of water or with solutes, for long steps.

    Call this function before the Context is created: OpenMM reads a System only then. A System can be prepared again
    for the same bodies; for other bodies prepare a new System.

    >>> print(prepare_system(system))
    The sums of PME are balanced.
    All molecules with bonded forces are rigid, so there are no fast forces.
    ...

    The forces on bodies and the potential energy do not change, apart from the errors of PME, which become smaller:

    - The two sums of PME are balanced, also in an ATMForce or a CustomCVForce; see `balance_pme`. They are balanced for
      constant energy, or with a `hydrogenMass` for a heat bath, with OpenMM's mesh in a rectangular box.
    - Bonds, angles and torsions of molecules that are not rigid get a separate force group, where every SIER integrator
      finds them. Rigid bodies on which they act turn in the inner steps too. Terms on virtual sites or frozen atoms
      stay slow. A Force with such terms is divided into two, unless its energy is an expression or it is inside another
      Force; then the whole Force stays slow.
    - Bonds of zero strength join the atoms of bodies without constraints, so that OpenMM keeps bodies together in
      trajectories and with barostats. These bonds record the bodies in the System, so that an integrator without the
      bodies is refused. OpenMM's own integrators ignore them: use the System of `with_frames` there.
    - If all bonds and angles are slow, as between beads that represent residues, no force becomes fast unless you give
      a `fastForceGroup`, since inner steps would only cost time.
    - Nonbonded interactions between atoms up to four bonds apart become fast too. One CustomBondForce adds them to the
      fast group, and another one subtracts them from the group of the NonbondedForce, which is not changed. The sum of
      all forces is that of the unprepared System, even if charges or exceptions change later.

    Args:
        system: the System. Its force groups and PME parameters change, and Forces may be added.
        bodies: the same bodies as for the integrator; None for those defined by the System's constraints.
        fastForceGroup: advanced: force group of the fast forces, from 0 to 31. None chooses 1 or, if that has other
            forces, the first empty one.
        hydrogenMass: mass of all hydrogens, in water too, a quantity or a number in dalton from 1 to 4.5; None leaves
            masses unchanged. With 4 use a step of 9 fs in a heat bath or by hybrid Monte Carlo. Averages of positions
            do not change, but motion slows down: water diffuses 10 to 20 % slower. So do not use it at constant energy.
        positions: positions of the particles, (N, 3), nm or a Quantity, at which the fastest motion of `RigidBodies`
            without fast forces is measured, by up to 43 evaluations of each Force: the result says which steps they can
            take, and why. None leaves this out.

    Returns:
        The fast force groups, changes, and remaining limits of energy conservation; print it.

    Raises:
        TypeError: `system` is not a System, or `bodies` have the wrong type.
        ValueError: the group is out of range or has other forces; `hydrogenMass` is out of range or given with
            `RigidBodies`, which have masses already; `balance_pme` refuses; a site of a molecule is frozen, being no
            virtual site; or the System already has a Context. The System is unchanged then.
        RigidityError: `RigidBodies.from_system` refuses the bodies. The System is unchanged then too.
    """
    system = checked_system(system)
    refuse_bound(system)
    places = None if positions is None else checked_positions(positions, system.getNumParticles())
    group = None if fastForceGroup is None else whole_number("fastForceGroup", fastForceGroup, most=GROUPS - 1)
    heavy = None if hydrogenMass is None else checked_mass(hydrogenMass)
    with tables.read_once():
        refuse_sites_without_place(system)
        bodies = checked_bodies(bodies)
        membership = _membership(system, bodies)
        forces = FastForces(system, membership)
        group = forces.free_group() if group is None else group
        _refuse_others_in(group, forces)
        if heavy is not None and isinstance(bodies, BodySet):
            raise ValueError(
                "The masses in `bodies` would not change with hydrogenMass: call prepare_system(system, "
                "hydrogenMass=…) before RigidBodies.from_system"
            )
        sentences = _balance(system, constant_energy=heavy is None)
        _remove_added_forces(system)
        # Bodies that have masses already are refused above.
        if heavy is not None:
            sentences.append(set_hydrogen_masses(system, heavy))
            # The kinds of bodies have the new masses.
            membership = _membership(system, bodies)
        coarse = _coarse_motion(system, membership, forces.owner) if fastForceGroup is None else None
        fast, gathered = _gather_fast_forces(system, forces, group, coarse)
        sentences += _join(system, forces) + gathered
        if places is not None and isinstance(bodies, BodySet) and not fast:
            sentences.append(describe_contacts(system, bodies, places))
        limits = describe_discontinuities(system)
    groups = frozenset({group} if fast else ())
    return Preparation(groups, tuple(sentences), limits)


def _membership(system: openmm.System, bodies: Bodies) -> BodySet | BodyPlan:
    """Return the bodies, or those that are named and form by constraints."""
    return bodies if isinstance(bodies, BodySet) else BodyPlan(system, rigid=bodies)


def _refuse_others_in(group: int, forces: FastForces) -> None:
    """Refuse a force group that contains slow Forces."""
    for force in forces.others_in(group):
        raise ValueError(
            f"{force.getName()} is in force group {group}, which must contain only fast forces. Give another "
            "fastForceGroup, or omit it, so that an empty group is chosen; if the System was prepared for other "
            "bodies, prepare a new System"
        )


def _balance(system: openmm.System, constant_energy: bool) -> list[str]:
    """Balance the sums of PME, if there are any; return a description."""
    if not meshed_forces(system):
        return []
    if not balance_pme(system, constant_energy):
        return ["The sums of PME stay as they are: the box is so empty that OpenMM's are more accurate."]
    return ["The sums of PME are balanced." if constant_energy else "The sums of PME are balanced for a heat bath."]


def _remove_added_forces(system: openmm.System) -> None:
    """Remove the Forces that an earlier preparation added."""
    if added := close_pairs.added_forces(system):
        for i in reversed(added):
            system.removeForce(i)
        tables.forget()


def _join(system: openmm.System, forces: FastForces) -> list[str]:
    """Join the atoms of bodies without constraints; return a description."""
    if not (joined := join_bodies(system, forces.owner, forces.moving)):
        return []
    return [
        f"The atoms of {joined} rigid bodies are joined by bonds without strength, so that OpenMM treats each body as "
        "one molecule in trajectories and with barostats. Give the integrator the same bodies. OpenMM's own "
        "integrators would tear them apart: use the System of with_frames there."
    ]


def _gather_fast_forces(
    system: openmm.System, forces: FastForces, group: int, coarse: Stiffest | None
) -> tuple[list[openmm.Force], list[str]]:
    """Put fast forces into a group unless all motion is coarse; return them and descriptions."""
    fast = [] if coarse else _put_fast_forces(system, forces, group)
    sentences = []
    if fast:
        sentences += _add_close_pairs(system, forces, fast, group)
    elif coarse:
        sentences.append(describe_coarse(coarse))
    elif not forces.slow and not forces.inner:
        sentences.append("All molecules with bonded forces are rigid, so there are no fast forces.")
    slow = [force.getName() for force in forces.slow]
    if slow and not coarse:
        why = "they act on virtual sites or frozen atoms"
        sentences.append(f"These stay slow forces, since {why}: {', '.join(slow)}.")
    if forces.inner:
        sentences.append(
            f"These stay slow forces, since another Force contains them: {', '.join(forces.inner)}. Add them "
            "to the System itself to make them fast, if the other Force does not change their effect."
        )
    return fast, sentences


def _coarse_motion(system: openmm.System, bodies: BodySet | BodyPlan, owner: np.ndarray) -> Stiffest | None:
    """Return the stiffest motion by bonded Forces if it is so slow that no force has to be fast; else None."""
    if isinstance(bodies, BodyPlan):
        motion = stiffest(system, None if bodies.needs_positions else bodies.bodies(), owner)
    else:
        motion = stiffest(system, bodies, owner)
    return motion if motion is not None and motion.is_coarse else None


def _put_fast_forces(system: openmm.System, forces: FastForces, group: int) -> list[openmm.Force]:
    """Put Forces that can be fast into a group, and terms on bodies split off from other Forces; return them all."""
    fast = list(forces.fast.values())
    for force in forces.slow:
        of_bodies = divided(force, forces.owner, forces.moving)
        if of_bodies is not None:
            system.addForce(of_bodies)
            fast.append(of_bodies)
            tables.forget()
    for force in fast:
        force.setForceGroup(group)
    return fast


def _add_close_pairs(system: openmm.System, forces: FastForces, fast: list[openmm.Force], group: int) -> list[str]:
    """Add close pairs of bodies to the group of the fast forces; return descriptions."""
    sentences = [f"Force group {group} has the fast forces now: {', '.join(force.getName() for force in fast)}."]
    periodic = any(force.usesPeriodicBoundaryConditions() for force in fast)
    edges = links_of(system).covalent()
    edges = edges[forces.moving[edges].all(axis=1)]
    if count := close_pairs.add_close_pairs(system, edges, forces.owner, group, periodic):
        sentences.append(
            f"Nonbonded forces between {count} close pairs (up to {close_pairs.REACH} bonds apart) count as fast too; "
            "the slow forces leave them out. The total energy is the same."
        )
    return sentences
