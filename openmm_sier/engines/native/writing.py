"""Write the program of an integrator: a general one, and for a System the one that costs least there."""

from typing import Any

import openmm

from openmm_sier.dynamics.flow import Flow
from openmm_sier.engines.native.program import write
from openmm_sier.engines.native.trials import stopped_mass, why_not
from openmm_sier.engines.program import Program, Trials
from openmm_sier.system.arguments import groups_of
from openmm_sier.system.forces import kind_of
from openmm_sier.system.solver_trial import may_not_converge


def general_program(flow: Flow) -> Program:
    """Return a program that follows a flow in any System; one without parts if OpenMM cannot execute the flow.

    Where the flow is followed in trials, it makes whole trials by itself. On the CPU and Reference platforms these are
    right only in a System without virtual sites.
    """
    if flow.trial_steps:
        return _written(flow, divides_step=False, trials=Trials(steps_alone=flow.trial_steps))
    return _written(flow)


def program_for(flow: Flow, system: openmm.System, groups: int, on_gpu: bool, checks_positions: bool) -> Program:
    """Return the program that follows a flow in a System, and costs least there.

    Args:
        flow: what to follow.
        system: openmm.System.
        groups: the integration force groups, a bit mask.
        on_gpu: whether a platform for GPUs executes it: then heat of a bath is not counted where the flow leaves that
            open, and virtual sites follow their atoms within a native step.
        checks_positions: whether the engine looks at positions before each force.

    Returns:
        A program, or one without parts if OpenMM cannot execute the flow.
    """
    slow = slow_groups(system, groups, flow.fast_groups)
    has_virtual_sites = any(map(system.isVirtualSite, range(system.getNumParticles())))
    in_trials = why_not(flow, system, on_gpu, checks_positions) is None
    return _written(
        flow,
        # By its name the force of a group is right only if no other slow force acts.
        slow_group=slow[0] if flow.fast_groups and len(slow) == 1 else None,
        divides_step=not in_trials and (has_virtual_sites or checks_positions),
        counts_heat=not on_gpu if flow.counts_heat is None else flow.counts_heat,
        trials=Trials(stopped_mass(system), checks_constraints=may_not_converge(system)) if in_trials else None,
    )


def needs_finite_positions(system: openmm.System, platform: openmm.Platform) -> bool:
    """Return whether to look at positions before each force.

    The Reference platform computes forces even at positions that are not finite. Its PME writes outside of its mesh
    there, which may end the process.
    """
    return platform.getName() == "Reference" and system.usesPeriodicBoundaryConditions()


def _written(flow: Flow, trials: Trials | None = None, **choices: Any) -> Program:
    """Write a program by `program.write`, or one without parts that says why not."""
    fast = groups_of(flow.fast_groups)
    substeps = flow.substeps
    if flow.trial_steps:
        # A step of RATTLE is reversible and keeps the volume of phase space, whatever its error.
        choices["inner_substeps"] = 1
        if substeps is None and not fast:
            substeps = 1
    try:
        program = write(flow.scheme, substeps, fast, flow.updates_context, flow.bath, **choices)
        return program._replace(trials=trials)
    except ValueError as error:
        return Program(flow.scheme.name, (), str(error))


def slow_groups(system: openmm.System, groups: int, fast_groups: int) -> tuple[int, ...]:
    """Return the force groups in which slow forces move the atoms; both arguments are bit masks."""
    return tuple(groups_of(_acting_groups(system) & groups & ~fast_groups))


def refuse_other_slow_groups(program: Program, system: openmm.System, groups: int, fast_groups: int) -> None:
    """Refuse integration force groups whose slow forces are not those that a program takes by the name of their group.

    Raises:
        openmm.OpenMMException: somebody changed the groups after the program was written.
    """
    named, found = program.slow_group, slow_groups(system, groups, fast_groups)
    if named is not None and found != (named,):
        raise openmm.OpenMMException(
            f"Force groups have changed since the Context was made: its slow forces were in force group {named}, and "
            f"are now in {found or 'none'}. Set force groups before the Context is made, or take engine='exact'"
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
