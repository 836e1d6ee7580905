"""Refuse what only the exact engine can do."""

from collections.abc import Collection, Mapping
from itertools import combinations

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.dynamics.integration_method import IntegrationMethod
from openmm_sier.dynamics.rotation import exact
from openmm_sier.dynamics.species import Species
from openmm_sier.engines.program import Program
from openmm_sier.system import checks, tables
from openmm_sier.system.arguments import groups_of
from openmm_sier.system.bonded_terms import bonded_terms
from openmm_sier.system.forces import kind_of

#: What ends the text of a refusal.
REMEDY = "or take engine='exact', which any platform runs"


def refuse_method(method: IntegrationMethod, program: Program) -> None:
    """Refuse a method that the program cannot follow.

    Raises:
        openmm.OpenMMException: the message says why, and the remedy.
    """
    reason = ""
    if program.refusal:
        reason = f"does not know this scheme, since {program.refusal}: take another scheme"
    elif method.rotation is not exact:
        reason = "has only the exact free-rotation map: leave out `rotation`"
    elif method.bath is not None and isinstance(method.bath.friction, Mapping):
        reason = "has one friction for all bodies: give `frictionCoeff` as a number"
    elif method.bath is not None and method.bath.common_friction is None:
        reason = "has one friction for translation and rotation: leave out `rotationalFriction`"
    if reason:
        raise openmm.OpenMMException(f"The native engine {reason}, {REMEDY}")


def refuse_system(system: openmm.System, bodies: BodySet | None) -> None:
    """Refuse bodies and a System that only the exact engine can move.

    Raises:
        openmm.OpenMMException: the message says what that is, and the remedy.
    """
    if reason := _unheld_bodies(bodies, system):
        raise openmm.OpenMMException(f"The native engine {reason}, {REMEDY}")
    if any(isinstance(force, openmm.AndersenThermostat) for force in system.getForces()):
        raise openmm.OpenMMException(
            "The native engine divides its step, and AndersenThermostat takes each part for a whole step. Remove the "
            "AndersenThermostat and use SIERLangevinIntegrator, or take engine='exact'"
        )
    if system.getNumConstraints():
        checks.refuse_scaled_atoms(system)


def _unheld_bodies(bodies: BodySet | None, system: openmm.System) -> str | None:
    """Return the text that refuses a named body that constraints do not keep rigid; None if there is none."""
    if bodies is None:
        return None
    if bodies.bearings is not None:
        body = bodies.describe(bodies.bearings.columns[0])
        return f"moves bodies along and about all axes, unlike the type of {body}: give the type Motion.FREE"
    for species in bodies.species:
        if species.has_other_moments:
            return (
                f"moves atoms by their masses, and {bodies.describe_atoms(species.atoms[0])} has moments that are not "
                "those of its masses: make a copy of the System by with_frames(system, positions, bodies)"
            )
    held = tables.constraints(system).by_pair()
    for atoms in (atoms for species in bodies.species for atoms in species.atoms.tolist()):
        for pair in combinations(sorted(atoms), 2):
            if pair not in held:
                return (
                    f"keeps bodies rigid only by constraints, and no constraint joins atoms {pair[0]} and {pair[1]} "
                    "of a body in `bodies`: make a copy of the System by with_frames(system, positions, bodies); or, "
                    "for a body of up to four atoms, constrain each pair of them"
                )
    return None


def refuse_fast_forces(system: openmm.System, groups: Collection[int], integration_groups: int) -> None:
    """Refuse fast forces that a native program cannot have in its drifts.

    Within a native step atoms move and virtual sites do not. So a fast force must not act on virtual sites; in a System
    without them any force can be fast.

    Args:
        system: openmm.System.
        groups: the fast force groups.
        integration_groups: bit mask of the groups that move the atoms, as from `getIntegrationForceGroups`.

    Raises:
        openmm.OpenMMException: a fast group is not among `integration_groups`, or a Force in it may act on a virtual
            site.
    """
    if idle := [group for group in sorted(groups) if not integration_groups >> group & 1]:
        raise openmm.OpenMMException(
            f"The fast force group {idle[0]} is not among the integration force groups: add it with "
            "setIntegrationForceGroups, or leave it out of fastForceGroups"
        )
    sites = tables.virtual_sites(system) if groups else np.empty(0, dtype=np.int64)
    for force in system.getForces() if sites.size else []:
        kind = kind_of(force)
        if force.getForceGroup() not in groups or not kind.exerts_forces:
            continue
        touched = np.intersect1d(bonded_terms(force), sites) if kind.terms is not None else sites
        if touched.size:
            raise openmm.OpenMMException(
                f"{force.getName()} ({type(force).__name__}) is in the fast force group {force.getForceGroup()} and "
                f"may act on atom {touched[0]}, a virtual site. Virtual sites do not follow their atoms within a step "
                "of the native engine. If this is a copy with frames of a prepared System, prepare the copy too: "
                "prepare_system(system). Otherwise put this Force into another group with setForceGroup"
            )


def slow_groups(system: openmm.System, groups: int, fast_groups: int) -> tuple[int, ...]:
    """Return the force groups in which slow forces move the atoms; both arguments are bit masks."""
    return tuple(groups_of(_acting_groups(system) & groups & ~fast_groups))


def refuse_other_slow_groups(program: Program, system: openmm.System, groups: int, fast_groups: int) -> None:
    """Refuse integration force groups whose slow forces are not those that a program takes by the name of their group.

    Raises:
        openmm.OpenMMException: somebody changed the groups after the program was written.
    """
    group, present = program.slow_group, slow_groups(system, groups, fast_groups)
    if group is not None and present != (group,):
        raise openmm.OpenMMException(
            f"Force groups have changed since the Context was made: its slow forces were in force group {group}, and "
            f"are now in {present or 'none'}. Set force groups before the Context is made, or take engine='exact'"
        )


def _acting_groups(system: openmm.System) -> int:
    """Return the force groups of all Forces that exert forces, a bit mask."""
    mask = 0
    for force in system.getForces():
        if not kind_of(force).exerts_forces:
            continue
        mask |= 1 << force.getForceGroup()
        if isinstance(force, openmm.NonbondedForce) and force.getReciprocalSpaceForceGroup() >= 0:
            mask |= 1 << force.getReciprocalSpaceForceGroup()
    return mask


def points(system: openmm.System) -> BodySet:
    """Return the massive atoms of a System, each a body of its own."""
    masses = tables.masses(system)
    kinds = [(mass, np.flatnonzero(masses == mass)[:, None]) for mass in np.unique(masses[masses > 0])]
    point = np.zeros((3, 1))
    return BodySet([Species.from_sites(atoms, np.array([mass]), point) for mass, atoms in kinds], len(masses))


def needs_finite_positions(system: openmm.System, platform: openmm.Platform) -> bool:
    """Return whether to look at positions before each force.

    The Reference platform computes forces even at positions that are not finite. Its PME writes outside of its mesh
    there, which may end the process.
    """
    return platform.getName() == "Reference" and system.usesPeriodicBoundaryConditions()
