"""Preparation of a System for long steps: fast forces in their own group, and balanced PME sums."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import RigidBodies
from openmm_sier.prepare import close_pairs
from openmm_sier.prepare.fast_forces import FastForces
from openmm_sier.prepare.jumps import describe_jumps
from openmm_sier.prepare.masses import checked_mass, set_hydrogen_masses
from openmm_sier.prepare.pme import balance_pme, meshed_forces
from openmm_sier.system.arguments import GROUPS, Bodies, checked_bodies, checked_system, whole_number
from openmm_sier.system.find_bodies import Links


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


def prepare_system(
    system: openmm.System, bodies: Bodies = None, fastForceGroup: int | None = None, hydrogenMass: Any = None
) -> Preparation:
    """Prepare a System, of water alone or with solutes, for long steps.

    The potential energy stays what it is, but for the accuracy of PME:

    - The sums of PME are balanced, also of Forces within an ATMForce or a CustomCVForce, see `balance_pme`.
    - Bonds, angles and torsions of molecules that are not rigid get a force group of their own, in which every SIER
      integrator finds them. Fast forces may move only atoms outside rigid bodies. So a Force with a term between a
      rigid body and something else, or on a virtual site, stays slow, and so does a Force within another one.
    - If there are such forces, nonbonded interactions between atoms of these molecules up to four bonds apart are added
      to that group by one CustomBondForce and subtracted in the group of the NonbondedForce by another one. The
      NonbondedForce is not changed. Whatever is done to charges, exceptions and other Forces afterwards, the sum of all
      forces is that of the System without preparation.

    Preparing a System again for the same bodies renews all of this; for other bodies prepare a new System. A Context
    must be created after the preparation: the integrator refuses the next step if its System was changed.

    >>> system = openmm.System()
    >>> print(prepare_system(system))
    All molecules with bonded forces are rigid, so no force is fast.

    Args:
        system: openmm.System; its force groups and PME parameters are changed, and two Forces may be added.
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
    known = FastForces(system, checked_bodies(bodies))
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
    if heavy is not None:
        done.append(set_hydrogen_masses(system, heavy))
    fast = list(known.fast.values())
    for force in fast:
        force.setForceGroup(group)
    if fast:
        done += _add_close_pairs(system, known.points, fast, group)
    elif not known.slow and not known.inner:
        done.append("All molecules with bonded forces are rigid, so no force is fast.")
    if left := [force.getName() for force in known.slow]:
        why = "they act on rigid bodies, virtual sites or frozen atoms"
        done.append(f"These stay in the kicks, since {why}: {', '.join(left)}.")
    if known.inner:
        done.append(
            f"These stay in the kicks, since another Force contains them: {', '.join(known.inner)}. Where that does "
            "not change them, add them to the System itself: then they are fast."
        )
    return Preparation(frozenset({group} if fast else ()), tuple(done), describe_jumps(system))


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
