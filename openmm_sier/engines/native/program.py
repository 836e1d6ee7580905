"""A splitting scheme written out as the program of an OpenMM CustomIntegrator: a general one, or the one for a System.

The program runs where the forces run. `write` makes it from the plan of a `Scheme` and `installation.install` gives it
to an integrator; `print(write(SIER4G, rattle_steps=5))` shows it.

OpenMM moves virtual sites at the end of an integrator's step, but on the CPU and Reference platforms not within it.
Where a System may have virtual sites, a step of the scheme is therefore divided into several steps of OpenMM, here
called native steps, each of which computes forces at the positions that it starts from and nowhere else. All are h/n
long, so that OpenMM's clock is right after every n of them. A step is divided, too, where positions must be looked at
before each force.

What a step costs on a GPU is the kernels that it launches and the memory that these move. So a program has no
computation of a global variable unless its step is divided (OpenMM uploads all of them after each), takes the slow
forces by the name of their group where they have one of their own, and counts the heat of a bath only where it is asked
to, since that takes four more projections of the velocities.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import Any

import openmm

from openmm_sier.dynamics.bodies import BodySet, RigidityError
from openmm_sier.dynamics.constraints.geodesic import SUZUKI, TRIPLE_JUMP
from openmm_sier.dynamics.integration_method import FEWEST_WITH_BATH, IntegrationMethod
from openmm_sier.dynamics.plan import Resolution, plan_step
from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.dynamics.stages import BATH
from openmm_sier.dynamics.thermostat import OrnsteinUhlenbeck
from openmm_sier.engines.native.refusals import points, slow_groups
from openmm_sier.engines.native.statements import Force, Statements
from openmm_sier.engines.program import ALL_GROUPS, ForceTerm, Line, Program, Trials
from openmm_sier.stability.motions import shortest_period
from openmm_sier.stability.step_rules import longest_inner_step
from openmm_sier.system import tables
from openmm_sier.system.arguments import groups_of
from openmm_sier.system.find_bodies import bodies_of
from openmm_sier.system.solver_test import may_not_converge

#: OpenMM looks at every path through the if-blocks of a program, of which there are 2^parts.
MOST_PARTS = 12

#: RATTLE steps, as fractions of a drift, that make the drift fourth order. Five are 80 times as accurate as three.
COMPOSITIONS = {3: TRIPLE_JUMP, 5: SUZUKI}

#: Usual steps of RATTLE in each drift of an inner step.
USUAL_IN_INNER_STEPS = 3

#: A drift longer than this many times the simulated time per force takes five RATTLE steps.
LONG_DRIFT = 2.0

#: The condition of a block that is never executed: no native step has such a number.
NEVER = -9


def usual_rattle_steps(scheme: Scheme) -> int:
    """Return the least number of steps of RATTLE in a drift whose errors are below those of the scheme at usual steps.

    SIER2, SIER4G and SIER4P have drifts of up to 1.6 times the simulated time per force, for which three suffice. SIER4
    and SIER4V have drifts of 2.4 and 2.8 times it. Beside a bath one step of 9 fs, which has the bath in its middle,
    has the exact averages of water within 0.1 %.
    """
    if scheme.bath_divides_drift:
        return 1
    return 5 if scheme.longest_drift * scheme.force_evaluations > LONG_DRIFT else 3


def write(
    scheme: Scheme,
    rattle_steps: int | None = None,
    fast_groups: Collection[int] = (),
    inner_step: float | None = None,
    updates_context: bool = True,
    bath: OrnsteinUhlenbeck | None = None,
    slow_group: int | None = None,
    divides_step: bool = True,
    counts_heat: bool = True,
) -> Program:
    """Write the program of a scheme.

    Without fast groups all forces are in the kicks, and the drift is free motion. With them the forces of these groups
    move from the kicks into the drift, see `dynamics.plan`. With a bath in the middle of the drift, the drift is an odd
    number of steps of RATTLE with the bath in the middle of one, with or without fast forces.

    Velocities are constrained where they are read, before a bath and at the end of the step, and not after every stage:
    what they have along the constraints changes no position that is constrained next, since the constraint forces take
    it up. Only forces at displaced positions are constrained where they act. A step with a bath in its middle whose
    heat is not counted leaves its end to the engine, which constrains velocities once after a call of `step`;
    trajectories then depend by rounding on how steps are divided into calls.

    Args:
        scheme: what to execute; its operators are kicks, gradient kicks, drifts and baths.
        rattle_steps: in each drift or, with fast groups, in each drift of an inner step: 3 and 5 make it fourth order
            (`COMPOSITIONS`), other numbers are equal steps. Beside a bath in the middle of a drift steps are always
            equal, and the one that has the bath in its middle is counted on both sides; with fast groups there is one
            in each inner step. None: `usual_rattle_steps`, and `USUAL_IN_INNER_STEPS` with fast groups.
        fast_groups: force groups of the fast forces, which must act on atoms alone, see `refusals.refuse_fast_forces`.
        inner_step: longest inner step as a fraction of the step; None: one in each drift, three around a bath.
        updates_context: whether OpenMM's barostats and CMMotionRemovers act before each step. What a remover takes is
            counted as heat, unless that of a bath is not.
        bath: executes the scheme's bath, with whatever temperature and friction it is given later.
        slow_group: the only force group of the slow forces; None: the sum of all forces less the fast ones.
        divides_step: whether a native step ends before each force at positions that changed, as in a System that may
            have virtual sites. Otherwise one native step is enough.
        counts_heat: whether the heat of the bath is counted. It takes projections of the velocities before and after
            the bath; the trajectory is the same without them, to rounding.

    Raises:
        ValueError: the scheme has another operator, or a bath that nothing executes, or needs more than `MOST_PARTS`
            native steps.
    """
    fast = [ForceTerm(f"f{group}") for group in sorted(fast_groups)]
    counts_heat = counts_heat or BATH not in scheme.operators
    if fast:
        resolution = _resolution(scheme, rattle_steps or USUAL_IN_INNER_STEPS)
        inner_step = inner_step or (1 / FEWEST_WITH_BATH if scheme.bath_divides_drift else scheme.longest_drift)
    else:
        resolution, inner_step = _resolution(scheme, rattle_steps or usual_rattle_steps(scheme)), None
    plan = plan_step(scheme, inner_step, resolution, updates_context)
    statements = Statements(_slow_forces(fast, slow_group), fast, bath, scheme.bath_divides_drift, counts_heat)
    lines = statements.of(plan.operations)
    parts = _divided(lines) if divides_step else (tuple(lines),)
    if len(parts) > MOST_PARTS:
        raise ValueError(f"the scheme {scheme.name} takes {len(parts)} native steps, more than {MOST_PARTS}")
    return Program(
        scheme.name,
        parts,
        inner_fraction=plan.longest_inner_step,
        counts_heat=counts_heat,
        ends_constrained=statements.ends_constrained,
        slow_group=slow_group,
        momentum_lag=scheme.momentum_lag,
        fast_groups=tuple(sorted(fast_groups)),
    )


def _resolution(scheme: Scheme, rattle_steps: int) -> Resolution:
    """Return how drifts are divided into steps of RATTLE; see `write`."""
    weights = COMPOSITIONS.get(rattle_steps, (1 / rattle_steps,) * rattle_steps)
    return Resolution(weights, weights, around_bath=2 * rattle_steps - 1 if scheme.bath_divides_drift else 0)


def _slow_forces(fast: Force, slow_group: int | None) -> Force:
    """Return the sum of all forces less the fast ones, or the force of the only slow group."""
    if slow_group is not None:
        return [ForceTerm(f"f{slow_group}", is_slow=True)]
    return [ForceTerm(ALL_GROUPS, is_slow=True), *(term._replace(sign="-") for term in fast)]


def _divided(lines: list[Line]) -> tuple[tuple[Line, ...], ...]:
    """Return lines by native step; one begins where slow forces are needed at positions that the last one changed."""
    parts: list[list[Line]] = [[]]
    moved = False
    for line in lines:
        if moved and line.needs_slow_force:
            parts.append([])
            moved = False
        parts[-1].append(line)
        moved = moved or line.moves
    return tuple(map(tuple, parts))


# --- for an integrator ---


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
    # A trial is one native step where virtual sites follow, and nobody looks at positions.
    in_trials = bool(method.trial_steps) and not checks_positions and (on_gpu or not has_virtual_sites)
    is_stopped = any(isinstance(force, openmm.CMMotionRemover) for force in system.getForces())
    stopped_mass = float(tables.masses(system).sum()) if is_stopped else 0.0
    return _written(
        method,
        # By its name the force of a group is right only if no other slow force acts.
        slow_group=slow[0] if method.fast_groups and len(slow) == 1 else None,
        divides_step=not in_trials and (has_virtual_sites or checks_positions),
        counts_heat=not on_gpu if method.counts_heat is None else method.counts_heat,
        trials=Trials(stopped_mass, checks_constraints=may_not_converge(system)) if in_trials else None,
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
