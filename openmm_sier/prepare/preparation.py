"""Preparation of a System for long steps: fast forces in their own group, and balanced PME sums."""

from dataclasses import dataclass

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.prepare import close_pairs
from openmm_sier.prepare.cutoff_discontinuities import describe_discontinuities
from openmm_sier.prepare.fast_forces import FastForces
from openmm_sier.prepare.joined_bodies import NAME as BODIES
from openmm_sier.prepare.joined_bodies import join_bodies
from openmm_sier.prepare.masses import checked_mass, set_hydrogen_masses
from openmm_sier.prepare.pme import balance_pme, meshed_forces
from openmm_sier.prepare.split_terms import divided
from openmm_sier.prepare.stiffness import Stiffest, describe_coarse, stiffest
from openmm_sier.system import tables
from openmm_sier.system.arguments import GROUPS, Bodies, Quantity, checked_bodies, checked_system, whole_number
from openmm_sier.system.bonded_terms import bonded_terms, do_work
from openmm_sier.system.bound_systems import refuse_bound
from openmm_sier.system.find_bodies import BodyPlan, Links, known_or_planned
from openmm_sier.system.forces import kind_of


@dataclass(frozen=True)
class Preparation:
    """Hold what `prepare_system` did; print it.

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


def prepare_system(
    system: openmm.System,
    bodies: Bodies = None,
    fastForceGroup: int | None = None,
    hydrogenMass: Quantity | None = None,
) -> Preparation:
    """Prepare a System, of water alone or with solutes, for long steps.

    Call it before the Context is created: OpenMM reads a System only then. To prepare a System again for the same
    bodies renews everything; for other bodies prepare a new System.

    >>> print(prepare_system(system))
    The sums of PME are balanced.
    All molecules with bonded forces are rigid, so there are no fast forces.
    ...

    The forces on bodies and the potential energy stay what they are, apart from the accuracy of PME. In detail:

    - It balances the two sums of PME, also in an ATMForce or a CustomCVForce; see `balance_pme`.
    - It puts bonds, angles and torsions of molecules that are not rigid into a force group of their own, where every
      SIER integrator finds them. In the inner steps rigid bodies on which they act turn too. Terms that act on a
      virtual site or a frozen atom stay slow. A Force that has such terms is divided into two, unless its energy is an
      expression or it is inside another Force; then it stays slow as a whole.
    - It joins the atoms of bodies that no constraints hold by bonds without strength, so that OpenMM keeps them
      together in trajectories and with barostats. These bonds record the bodies in the System, so that an integrator
      without the bodies is refused. OpenMM's own integrators do not read them: give these the System of `with_frames`.
    - Where all bonds and angles are slow, as between beads that stand for residues, no force becomes fast unless you
      give a `fastForceGroup`, since inner steps would only cost time.
    - It counts nonbonded interactions between atoms up to four bonds apart as fast too. One CustomBondForce adds them
      to the fast group, and another one subtracts them from the group of the NonbondedForce, which stays as it is. The
      sum of all forces is that of the System without preparation, even if charges or exceptions change later.

    Args:
        system: the System. Its force groups and PME parameters change, and Forces may be added.
        bodies: the bodies, as you give them to the integrator; None takes those of the System's constraints.
        fastForceGroup: you can skip this. It is the force group for the fast forces, from 0 to 31. None takes 1 or, if
            that has other forces, the first empty one.
        hydrogenMass: mass of all hydrogens, in water too, a quantity or a number in dalton from 1 to 4.5; None leaves
            masses as they are. With 4 take a step of 9 fs in a heat bath or by hybrid Monte Carlo. Averages of
            positions stay the same, but motion slows down: water diffuses 10 to 20 % slower. So do not use it at
            constant energy.

    Returns:
        The fast force groups, what was done, and what still limits the energy; print it.

    Raises:
        TypeError: `system` is no System, such as a Simulation, or `bodies` have the wrong type.
        ValueError: the group is out of range or has other forces, `hydrogenMass` is out of range or comes with
            `RigidBodies`, which have masses already, `balance_pme` refuses, or the System has a Context with a SIER
            integrator already. The System is unchanged then.
        RigidityError: `RigidBodies.from_system` refuses the bodies. The System is unchanged then too.
    """
    system = checked_system(system)
    refuse_bound(system)
    group = None if fastForceGroup is None else whole_number("fastForceGroup", fastForceGroup, most=GROUPS - 1)
    heavy = None if hydrogenMass is None else checked_mass(hydrogenMass)
    with tables.read_once():
        found = known_or_planned(system, checked_bodies(bodies))
        known = FastForces(system, found)
        group = known.free_group() if group is None else group
        _refuse_others_in(group, known)
        if heavy is not None and isinstance(bodies, BodySet):
            raise ValueError(
                "The masses in `bodies` would not change with hydrogenMass: call prepare_system(system, "
                "hydrogenMass=…) before RigidBodies.from_system"
            )
        done = _balance(system)
        for i in reversed(close_pairs.own_forces(system)):
            system.removeForce(i)
    if heavy is not None:
        done.append(set_hydrogen_masses(system, heavy))
    with tables.read_once():
        coarse = _coarse_motion(system, found, known.owner) if fastForceGroup is None else None
        fast, said = _gather_fast_forces(system, known, group, coarse)
        done += _join(system, known) + said + _useless_terms(system, known.owner)
        limits = describe_discontinuities(system)
    groups = frozenset({group} if fast else ())
    return Preparation(groups, tuple(done), limits)


def _refuse_others_in(group: int, known: FastForces) -> None:
    """Refuse a force group that has other Forces than fast ones."""
    for force in known.others_in(group):
        raise ValueError(
            f"{force.getName()} is in force group {group}, which must have only fast forces: give another "
            "fastForceGroup, or leave it out, so that an empty group is taken; if the System was prepared for other "
            "bodies, prepare a new System"
        )


def _balance(system: openmm.System) -> list[str]:
    """Balance the sums of PME, if there are any; return what was done."""
    if not meshed_forces(system):
        return []
    balance_pme(system)
    return ["The sums of PME are balanced."]


def _join(system: openmm.System, known: FastForces) -> list[str]:
    """Join the atoms of bodies that no constraints hold; return what was done."""
    if not (joined := join_bodies(system, known.owner)):
        return []
    return [
        f"The atoms of {joined} rigid bodies are joined by bonds without strength: OpenMM takes each body for one "
        "molecule, in trajectories and with barostats. Give the integrator the same bodies. OpenMM's own integrators "
        "would tear them apart, and need the System of with_frames."
    ]


def _gather_fast_forces(
    system: openmm.System, known: FastForces, group: int, coarse: Stiffest | None
) -> tuple[list[openmm.Force], list[str]]:
    """Put fast forces into a group unless all motion is coarse; return them, and what was done."""
    fast = [] if coarse else _put_fast_forces(system, known, group)
    done = []
    if fast:
        done += _add_close_pairs(system, known, fast, group)
    elif coarse:
        done.append(describe_coarse(coarse))
    elif not known.slow and not known.inner:
        done.append("All molecules with bonded forces are rigid, so there are no fast forces.")
    left = [force.getName() for force in known.slow]
    if left and not coarse:
        why = "they act on virtual sites or frozen atoms"
        done.append(f"These stay slow forces, since {why}: {', '.join(left)}.")
    if known.inner:
        done.append(
            f"These stay slow forces, since another Force contains them: {', '.join(known.inner)}. Add them "
            "to the System itself to make them fast, if the other Force does not change what they do."
        )
    return fast, done


def _coarse_motion(system: openmm.System, bodies: BodySet | BodyPlan, owner: np.ndarray) -> Stiffest | None:
    """Return the stiffest motion by bonded Forces if it is so slow that no force need be fast."""
    found = stiffest(system, bodies if isinstance(bodies, BodySet) else None, owner)
    return found if found is not None and found.is_coarse else None


def _put_fast_forces(system: openmm.System, known: FastForces, group: int) -> list[openmm.Force]:
    """Put what can be fast into a group, also the terms on bodies alone of Forces that cannot; returns these Forces."""
    fast = list(known.fast.values())
    for force in known.slow:
        of_bodies = divided(force, known.owner, known.moving)
        if of_bodies is not None:
            system.addForce(of_bodies)
            fast.append(of_bodies)
    for force in fast:
        force.setForceGroup(group)
    return fast


def _useless_terms(system: openmm.System, owner: np.ndarray) -> list[str]:
    """Return a sentence about bonded terms within one body, which do no work."""
    counts = []
    for force in system.getForces():
        if kind_of(force).terms is None or force.getName() == BODIES:
            continue
        works = do_work(bonded_terms(force), owner)
        if not works.all():
            counts.append(f"{np.count_nonzero(~works)} of {len(works)} of {force.getName()}")
    if not counts:
        return []
    return [
        f"Bonded terms within rigid bodies or between frozen atoms do no work but cost time ({', '.join(counts)}): "
        "leave elastic networks out when you make the Forces. Bonds along chains are cheap, and keep molecules whole."
    ]


def _add_close_pairs(system: openmm.System, known: FastForces, fast: list[openmm.Force], group: int) -> list[str]:
    """Add the close pairs of bodies to the group of the fast forces; returns what was done."""
    done = [f"Force group {group} has the fast forces now: {', '.join(force.getName() for force in fast)}."]
    periodic = any(force.usesPeriodicBoundaryConditions() for force in fast)
    edges = Links(system).covalent()
    edges = edges[known.moving[edges].all(axis=1)]
    if count := close_pairs.add_close_pairs(system, edges, known.owner, group, periodic):
        done.append(
            f"Nonbonded forces between {count} close pairs (up to {close_pairs.REACH} bonds apart) count as fast too; "
            "the slow forces leave them out. The total energy is the same."
        )
    return done
