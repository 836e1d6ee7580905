"""Preparation of a System for long steps: fast forces in their own group, and balanced PME sums."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.bodies import RigidBodies
from openmm_sier.prepare import close_pairs
from openmm_sier.prepare.fast_forces import FastForces
from openmm_sier.prepare.inside_bodies import FEWEST_ATOMS, PAIRWISE, Excluded, exclude_inside_bodies, useless_terms
from openmm_sier.prepare.joined_bodies import join_bodies
from openmm_sier.prepare.jumps import describe_jumps
from openmm_sier.prepare.masses import checked_mass, set_hydrogen_masses
from openmm_sier.prepare.pme import balance_pme, meshed_forces
from openmm_sier.prepare.split_terms import points_divided
from openmm_sier.prepare.stiffness import Stiffest, describe_coarse, stiffest
from openmm_sier.system.arguments import GROUPS, Bodies, checked_bodies, checked_system, whole_number
from openmm_sier.system.find_bodies import BodyPlan, Links, known_or_planned


@dataclass(frozen=True)
class Preparation:
    """What `prepare_system` did; print it.

    Attributes:
        fastForceGroups: the fast force groups, which integrators find in the System; empty if no force is fast.
        done: a sentence for each thing that was done or left as it was.
        limits: a sentence for each thing that still limits how well energy is conserved, with its remedy.
        excludedPairs: how many pairs of atoms within rigid bodies do not interact any more.
        excludedEnergy: their energy, which is a constant, and by which the potential energy is lower. It is that of
            default values of global parameters, and of the bodies' shapes.
    """

    fastForceGroups: frozenset[int]
    done: tuple[str, ...]
    limits: tuple[str, ...] = ()
    excludedPairs: int = 0
    excludedEnergy: unit.Quantity = field(default_factory=lambda: 0.0 * unit.kilojoule_per_mole)

    def __str__(self) -> str:
        return "\n".join(self.done + self.limits)


def prepare_system(
    system: openmm.System, bodies: Bodies = None, fastForceGroup: int | None = None, hydrogenMass: Any = None
) -> Preparation:
    """Prepare a System, of water alone or with solutes, for long steps.

    Forces on bodies stay what they are, and so does the potential energy, but for a constant and the accuracy of PME:

    - The sums of PME are balanced, also of Forces within an ATMForce or a CustomCVForce, see `balance_pme`.
    - Bonds, angles and torsions of molecules that are not rigid get a force group of their own, in which every SIER
      integrator finds them. Fast forces may move only atoms outside rigid bodies. So terms between a rigid body and
      something else, or on a virtual site, stay slow: a Force that has such terms is divided, by a new Force with those
      on points alone, which lose their strength in the old one. A Force whose energy is an expression stays slow as a
      whole then, and so does a Force within another one.
    - In a periodic System, bodies that consist of several molecules are joined by bonds without strength, so that
      OpenMM keeps their atoms together in trajectories and with barostats.
    - Where all bonds and angles are slow, as those of beads that stand for residues, no force is fast, unless
      `fastForceGroup` asks for it. Inner steps would cost time alone. What limits the step then is told.
    - If there are such forces, nonbonded interactions between atoms of these molecules up to four bonds apart are added
      to that group by one CustomBondForce and subtracted in the group of the NonbondedForce by another one. The
      NonbondedForce is not changed. Whatever is done to charges, exceptions and other Forces afterwards, the sum of all
      forces is that of the System without preparation.
    - Interactions between atoms of one rigid body do no work and cost time. Where `bodies` tell its shape, those of
      NonbondedForces, CustomNonbondedForces and GayBerneForces are excluded, and their energy, a constant, is told.
      With PME they stay, since excluded pairs would take longer. Bonded terms within bodies are told of.

    Preparing a System again for the same bodies renews all of this; for other bodies prepare a new System. A Context
    must be created after the preparation: the integrator refuses the next step if its System was changed.

    >>> system = openmm.System()
    >>> print(prepare_system(system))
    All molecules with bonded forces are rigid, so no force is fast.

    Args:
        system: openmm.System; its force groups, PME parameters and exclusions are changed, and Forces may be
            added.
        bodies: the bodies that the integrator will be given, as it takes them; None: those of the System's constraints.
        fastForceGroup: force group for the fast forces, from 0 to 31. None: 1 or, if that has other forces, the first
            that has none.
        hydrogenMass: of all hydrogens, in water too, a quantity or a number in dalton, see `set_hydrogen_masses`; None
            leaves them as they are. With four dalton take 9 fs in place of 4 in a heat bath, and 9 in place of 6 by
            hybrid Monte Carlo. Averages of positions do not change, but motion does: diffusion and relaxation of water
            are some 10 to 20 % slower. Do not use it where dynamics is what you want, as at constant energy.

    Returns:
        The fast force groups, what was done, and what still limits the energy; print it.

    Raises:
        TypeError: it is no System, such as a Simulation, or `bodies` have the wrong type.
        ValueError: the group is out of range or already has other forces, `hydrogenMass` is out of range or given with
            bodies that have masses already, or `balance_pme` refuses. The System is unchanged then.
        RigidityError: see `RigidBodies.from_system`; the System is unchanged then too.
    """
    system = checked_system(system)
    group = None if fastForceGroup is None else whole_number("fastForceGroup", fastForceGroup, most=GROUPS - 1)
    found = known_or_planned(system, checked_bodies(bodies))
    known = FastForces(system, found)
    if group is None:
        group = known.free_group()
    for force in known.others_in(group):
        raise ValueError(
            f"{force.getName()} is in force group {group}, which is to be that of the fast forces: give another "
            "fastForceGroup or none, to have a free one, or, if it was prepared for other bodies, prepare a new System"
        )
    heavy = None if hydrogenMass is None else checked_mass(hydrogenMass)
    if heavy is not None and isinstance(bodies, RigidBodies):
        raise ValueError("Bodies hold old masses: call prepare_system(hydrogenMass=…) before RigidBodies.from_system")
    done = []
    if meshed_forces(system):
        balance_pme(system)
        done.append("The sums of PME are balanced.")
    for i in reversed(close_pairs.own_forces(system)):
        system.removeForce(i)
    if joined := join_bodies(system, known.owner):
        done.append(
            f"The atoms of {joined} rigid bodies are joined by bonds without strength: OpenMM takes each for one "
            "molecule, in trajectories and with barostats."
        )
    if heavy is not None:
        done.append(set_hydrogen_masses(system, heavy))
    coarse = _coarse_motion(system, found, known.owner) if fastForceGroup is None else None
    fast = [] if coarse else _put_fast_forces(system, known, group)
    if fast:
        done += _add_close_pairs(system, known.points, fast, group)
    elif coarse:
        done.append(describe_coarse(coarse))
    elif not known.slow and not known.inner:
        done.append("All molecules with bonded forces are rigid, so no force is fast.")
    left = [force.getName() for force in known.slow]
    if left and not coarse:
        why = "they act on rigid bodies, virtual sites or frozen atoms"
        done.append(f"These stay in the kicks, since {why}: {', '.join(left)}.")
    if known.inner:
        done.append(
            f"These stay in the kicks, since another Force contains them: {', '.join(known.inner)}. Where that does "
            "not change them, add them to the System itself: then they are fast."
        )
    excluded = Excluded() if isinstance(found, BodyPlan) else exclude_inside_bodies(system, found)
    done += _inside_bodies(system, found, excluded, known.owner)
    return Preparation(
        frozenset({group} if fast else ()),
        tuple(done),
        describe_jumps(system),
        excluded.pairs,
        excluded.energy * unit.kilojoule_per_mole,
    )


def _coarse_motion(system: openmm.System, bodies: RigidBodies | BodyPlan, owner: np.ndarray) -> Stiffest | None:
    """Return the stiffest motion by bonded Forces if it is so slow that no force need be fast."""
    found = stiffest(system, bodies if isinstance(bodies, RigidBodies) else None, owner)
    return found if found is not None and found.is_coarse else None


def _put_fast_forces(system: openmm.System, known: FastForces, group: int) -> list[openmm.Force]:
    """Put what can be fast into a group, also the terms on points alone of Forces that cannot; returns these Forces."""
    fast = list(known.fast.values())
    for force in known.slow:
        of_points = points_divided(force, known.points)
        if of_points is not None:
            system.addForce(of_points)
            fast.append(of_points)
    for force in fast:
        force.setForceGroup(group)
    return fast


def _inside_bodies(
    system: openmm.System, bodies: RigidBodies | BodyPlan, excluded: Excluded, owner: np.ndarray
) -> list[str]:
    """Return what was done about interactions within rigid bodies, which do no work."""
    done = []
    if isinstance(bodies, BodyPlan):
        count = sum(len(kind.clusters) for kind in bodies.kinds if len(kind.masses) >= FEWEST_ATOMS)
        if count and any(isinstance(force, PAIRWISE) for force in system.getForces()):
            done.append(
                f"Interactions within {count} rigid bodies do no work and cost time, and stay, since lists of "
                "particles do not tell which are near. Give prepare_system the bodies of RigidBodies.from_system("
                "system, topology, lists, positions): then they are excluded."
            )
    elif excluded.refusal:
        done.append(f"Interactions within rigid bodies do no work, and stay: {excluded.refusal}.")
    elif excluded.pairs:
        done.append(
            f"{excluded.pairs} pairs of atoms within {excluded.bodies} rigid bodies, which do no work, are excluded "
            f"from {', '.join(excluded.forces)}. Their energy of {excluded.energy:.6g} kJ/mol is a constant that the "
            "potential energy does not have any more."
        )
    if useless := useless_terms(system, owner):
        counts = ", ".join(f"{count} of {terms} of {name}" for name, (count, terms) in useless.items())
        done.append(
            f"Bonded terms within rigid bodies or between frozen atoms do no work and cost time ({counts}): leave "
            "elastic networks out where you make the Forces. Bonds along chains are cheap, and keep molecules whole."
        )
    return done


def _add_close_pairs(system: openmm.System, points: np.ndarray, fast: list[openmm.Force], group: int) -> list[str]:
    """Add the close pairs of points to the group of the fast forces; returns what was done."""
    done = [f"Force group {group} has the fast forces now: {', '.join(force.getName() for force in fast)}."]
    periodic = any(force.usesPeriodicBoundaryConditions() for force in fast)
    edges = Links(system).covalent()
    edges = edges[points[edges].all(axis=1)]
    if count := close_pairs.add_close_pairs(system, edges, group, periodic):
        done.append(
            f"Nonbonded forces between {count} close pairs (up to {close_pairs.REACH} bonds apart) count as fast too; "
            "the slow forces leave them out. The total energy is the same."
        )
    return done
