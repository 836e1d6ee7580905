"""Write the program of an integrator: a general one, and for a System the one that costs least there."""

from dataclasses import replace
from typing import Any

import openmm

from openmm_sier.dynamics.bodies import BodySet, RigidityError
from openmm_sier.dynamics.integration_method import IntegrationMethod
from openmm_sier.engines.native.program import write
from openmm_sier.engines.native.refusals import points
from openmm_sier.engines.program import Program, Trials
from openmm_sier.stability.motions import shortest_period
from openmm_sier.stability.step_rules import longest_inner_step
from openmm_sier.system import tables
from openmm_sier.system.arguments import groups_of
from openmm_sier.system.find_bodies import bodies_of
from openmm_sier.system.forces import kind_of
from openmm_sier.system.solver_test import may_not_converge


def general_program(method: IntegrationMethod) -> Program:
    """Return a program that executes a method in any System; one without parts if OpenMM cannot execute the method.

    A method of trials becomes a program of whole trials.
    """
    if method.trial_steps:
        return _written(method, divides_step=False, trials=Trials())
    return _written(method)


def program_for(
    method: IntegrationMethod,
    system: openmm.System,
    bodies: BodySet | None,
    groups: int,
    on_gpu: bool,
    checks_positions: bool,
) -> Program:
    """Return the program that follows a method in a System, and costs least there.

    Args:
        method: what to follow.
        system: openmm.System.
        bodies: the rigid bodies; None: those that the constraints form.
        groups: the integration force groups, a bit mask.
        on_gpu: whether a platform for GPUs executes it: then heat of a bath is not counted where the method leaves that
            open, and virtual sites follow their atoms within a native step.
        checks_positions: whether the engine looks at positions before each force.

    Returns:
        A program, or one without parts if OpenMM cannot execute the method.
    """
    slow = slow_groups(system, groups, method.fast_groups)
    has_virtual_sites = tables.virtual_sites(system).size > 0
    in_trials = are_native(method, system, on_gpu, checks_positions)
    return _written(
        method,
        # By its name the force of a group is right only if no other slow force acts.
        slow_group=slow[0] if method.fast_groups and len(slow) == 1 else None,
        divides_step=not in_trials and (has_virtual_sites or checks_positions),
        counts_heat=not on_gpu if method.counts_heat is None else method.counts_heat,
        trials=Trials(stopped_mass(system), checks_constraints=may_not_converge(system)) if in_trials else None,
        period=_shortest_period(system, bodies, groups & method.fast_groups) if method.fast_groups else None,
    )


def _shortest_period(system: openmm.System, bodies: BodySet | None, groups: int) -> float | None:
    """Return the period of the fastest bond by some force groups, ps; see `shortest_period`."""
    try:
        rigid = tuple(bodies_of(system, bodies).species)
    except RigidityError:
        # No named body, and constraints that form none.
        rigid = ()
    return shortest_period(system, points(system), rigid, groups)


def needs_finite_positions(system: openmm.System, platform: openmm.Platform) -> bool:
    """Return whether to look at positions before each force.

    The Reference platform computes forces even at positions that are not finite. Its PME writes outside of its mesh
    there, which may end the process.
    """
    return platform.getName() == "Reference" and system.usesPeriodicBoundaryConditions()


def _written(
    method: IntegrationMethod, trials: Trials | None = None, period: float | None = None, **choices: Any
) -> Program:
    """Write a program by `program.write`, or one without parts that says why not.

    Args:
        method: what to follow.
        trials: that the program makes.
        period: of the fastest motion by fast forces, ps; None if it is not known.
        choices: further arguments of `program.write`.
    """
    if method.fast_groups:
        # A program serves all steps, of which one of zero length makes none.
        shown = method if method.step else replace(method, step=1.0)
        inner_step = shown.inner_step(longest_inner_step(method.scheme, period))
        choices |= {"fast_groups": groups_of(method.fast_groups), "inner_step": inner_step / shown.step}
    else:
        choices["rattle_steps"] = method.substeps
    if method.trial_steps and not method.substeps:
        # A step of RATTLE is reversible and keeps the volume of phase space, whatever its error.
        choices["rattle_steps"] = 1
    try:
        program = write(method.scheme, updates_context=method.updates_context, bath=method.bath, **choices)
        return program._replace(trials=trials)
    except ValueError as error:
        return Program(method.scheme.name, (), str(error))


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


def are_native(method: IntegrationMethod, system: openmm.System, places_sites: bool, checks_positions: bool) -> bool:
    """Return whether a trial can be one native step in a System. Its steps are native in any case.

    Args:
        method: of the trials.
        system: openmm.System.
        places_sites: whether the platform places virtual sites within a native step, which they must follow.
        checks_positions: whether positions must be looked at before each force, as on the Reference platform, which
            computes forces of PME at positions that are not finite.
    """
    has_sites = tables.virtual_sites(system).size > 0
    return bool(method.trial_steps) and not checks_positions and (places_sites or not has_sites)


def stopped_mass(system: openmm.System) -> float:
    """Return the mass in Da of the atoms whose centre a CMMotionRemover stops; 0 without one."""
    is_stopped = any(isinstance(force, openmm.CMMotionRemover) for force in system.getForces())
    return float(tables.masses(system).sum()) if is_stopped else 0.0
