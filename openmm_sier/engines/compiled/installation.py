"""The program of a System for the kernels engine, given to an integrator before its Context is made."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import openmm

from openmm_sier.dynamics.bodies import BodySet, RigidityError
from openmm_sier.dynamics.integration_method import IntegrationMethod
from openmm_sier.dynamics.plan import Resolution, plan_step
from openmm_sier.dynamics.stages import BATH
from openmm_sier.engines.compiled.body_tables import ClusterError, tables_of
from openmm_sier.engines.compiled.kernel_text import ProgramWriter
from openmm_sier.engines.compiled.plugin import address_of, library_of
from openmm_sier.engines.compiled.refusals import moved_by_fast_forces, refusal, refuse_bodies, refuse_method
from openmm_sier.engines.compiled.scalars import Scalars
from openmm_sier.engines.compiled.step_program import StepProgram
from openmm_sier.engines.compiled.trial_blocks import SUM, trial_blocks
from openmm_sier.engines.compiled.writing import StepWriter, written_trajectory
from openmm_sier.stability.step_check import StepCheck
from openmm_sier.system import tables
from openmm_sier.system.find_bodies import bodies_of
from openmm_sier.system.forces import kind_of


class CompiledStep(NamedTuple):
    """A step of a method in a System.

    Attributes:
        program: what the library executes.
        scalars: its numbers that depend on settings.
        bodies: all that moves.
        inner_fraction: the longest inner step as a fraction of the step; 1 where there are none.
        counts_heat: whether heat is counted.
        fast_groups: bit mask.
        has_last_energy: whether the end of a trajectory comes with its energy.
        sum_units: units of sums of the motion in one kJ/mol.
    """

    program: StepProgram
    scalars: Scalars
    bodies: BodySet
    inner_fraction: float
    counts_heat: bool
    fast_groups: int
    has_last_energy: bool
    sum_units: float


class InstalledStep(NamedTuple):
    """A step that an integrator has.

    Attributes:
        step: the step.
        library: executes it.
        take_back: a function that takes it from the integrator.
    """

    step: CompiledStep
    library: Any
    take_back: Callable[[], Any]


def compiled_step(
    method: IntegrationMethod, system: openmm.System, bodies: BodySet | None, groups: int
) -> CompiledStep:
    """Return the step of a method in a System.

    Args:
        method: what to follow, with the bath of its scheme.
        system: openmm.System.
        bodies: the rigid bodies; None: those that the constraints form.
        groups: the integration force groups, a bit mask.

    Raises:
        openmm.OpenMMException: kernels cannot do it.
    """
    refuse_method(method)
    try:
        moving = bodies_of(system, bodies)
    except RigidityError as error:
        raise refusal(f"needs to know all bodies ({error})") from error
    refuse_bodies(moving)
    fast = groups & method.fast_groups
    is_member = moved_by_fast_forces(system, moving, fast)
    # A program serves all steps, of which one of zero length makes none.
    shown = method if method.step else replace(method, step=1.0)
    inner_step = StepCheck(system, moving).inner_step(shown, groups) if is_member.any() else 0.0
    updates = method.updates_context and _acts_between_steps(system)
    has_constraints = len(moving.links[1]) > 0
    longest = inner_step / shown.step or None
    resolution = Resolution(around_bath=1 if method.scheme.bath_divides_drift else 0)
    plan = plan_step(method.scheme, longest, resolution, updates, projects=has_constraints)
    counts_heat = bool(method.counts_heat) or BATH not in method.scheme.operators
    # The heat of OpenMM's own thermostats is not counted by any engine.
    has_thermostat = any(kind_of(force).sets == "temperature" for force in system.getForces())
    scalars = Scalars()
    writer = StepWriter(counts_heat and updates and not has_thermostat, fast > 0, scalars)
    try:
        writer.write(plan.operations)
    except ValueError as error:
        raise refusal(f"does not know this scheme, since {error}") from error
    has_sites = tables.virtual_sites(system).size > 0
    try:
        body_tables = tables_of(moving, is_member)
    except ClusterError as error:
        raise refusal(
            f"solves only constraints of up to four atoms to one other atom, and {error} has others"
        ) from error
    program = ProgramWriter(body_tables, fast, counts_heat, method.trial_steps, has_sites, system.getNumParticles())
    program.write_block(writer.parts)
    program.write_block(SUM)
    if method.trial_steps:
        for block in trial_blocks(written_trajectory(plan, fast > 0, scalars), fast > 0):
            program.write_block(block)
    return CompiledStep(
        program.program(),
        scalars,
        moving,
        plan.longest_inner_step,
        counts_heat,
        fast,
        plan.with_energy() is not plan,
        program.sum_units,
    )


def _acts_between_steps(system: openmm.System) -> bool:
    """Return whether a Force of a System changes velocities, positions or the box before steps."""
    return any(
        isinstance(force, openmm.CMMotionRemover) or not kind_of(force).is_passive for force in system.getForces()
    )


def install(
    step: CompiledStep, integrator: openmm.CustomIntegrator, library: Any, method: IntegrationMethod
) -> InstalledStep:
    """Give an integrator a step, which a library executes in the Context that is made next."""
    address = address_of(integrator)
    number = library.assign(address, step.program)
    library.set_scalars(address, method.step, step.scalars.values(method))
    # It is taken back at the end of the process too: kernels must go before OpenMM's platform does.
    take_back = weakref.finalize(integrator, library.forget, address, number)
    return InstalledStep(step, library, take_back)


def installed(
    is_asked_for: bool,
    method: IntegrationMethod,
    system: openmm.System,
    bodies: BodySet | None,
    integrator: openmm.CustomIntegrator,
    platform: openmm.Platform,
) -> InstalledStep | None:
    """Return the step of a method in a System, which the integrator has from then on; None where kernels cannot do it.

    Args:
        is_asked_for: whether the user wants this engine and no other.
        method: with the bath of its scheme.
        system: openmm.System.
        bodies: the rigid bodies; None: those that the constraints form.
        integrator: has no Context yet.
        platform: that of the Context.

    Raises:
        openmm.OpenMMException: kernels cannot do what was asked for.
    """
    try:
        library = library_of(platform)
        step = compiled_step(method, system, bodies, integrator.getIntegrationForceGroups())
        return install(step, integrator, library, method)
    except openmm.OpenMMException:
        if is_asked_for:
            raise
        return None
