"""Choose the engine of an integrator."""

import os
from contextlib import suppress
from functools import cache

import openmm

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.dynamics.integration_method import IntegrationMethod
from openmm_sier.dynamics.tally import Tally
from openmm_sier.engines.compiled.engine import KernelsEngine
from openmm_sier.engines.compiled.installation import InstalledStep
from openmm_sier.engines.compiled.trial_engine import KernelTrialEngine
from openmm_sier.engines.exact.engine import ExactEngine
from openmm_sier.engines.native.engine import NativeEngine
from openmm_sier.engines.native.installation import vectors_of
from openmm_sier.engines.native.trial_engine import TrialEngine
from openmm_sier.engines.program import Program
from openmm_sier.engines.protocol import Engine
from openmm_sier.engines.snapshot import is_on_host
from openmm_sier.engines.variables import STATE_VARIABLES
from openmm_sier.system.find_bodies import RigidityError, UnknownShapeError

#: Engines by the names by which users ask for them.
ENGINES: dict[str, type[Engine]] = {engine.name: engine for engine in (ExactEngine, NativeEngine, KernelsEngine)}


def usual_platform() -> openmm.Platform:
    """Return the platform that OpenMM takes for a Context of which none is named: the fastest that works here."""
    return _taken_by_openmm(os.environ.get("OPENMM_DEFAULT_PLATFORM"))


@cache
def _taken_by_openmm(default: str | None) -> openmm.Platform:
    # A platform may be registered where it has no device.
    particle = openmm.System()
    particle.addParticle(1.0)
    return openmm.Context(particle, openmm.VerletIntegrator(0.001)).getPlatform()


def make_engine(
    name: str,
    context: openmm.Context,
    method: IntegrationMethod,
    tally: Tally,
    bodies: BodySet | None,
    program: Program,
    installed: InstalledStep | None = None,
) -> Engine:
    """Return an engine of a Context.

    Args:
        name: one of `ENGINES`, or "auto": the exact one on `HOST_PLATFORMS` where all shapes are known, otherwise the
            kernels engine where there is a step for it, and else the native one.
        context: openmm.Context, which has the integrator.
        method: the scheme that will be executed.
        tally: of the integrator.
        bodies: the rigid bodies; None: those that the constraints form.
        program: of the native engine, written for the method.
        installed: the step of the kernels engine; None without one.
    """
    if name == ExactEngine.name:
        return ExactEngine(context, method, tally, bodies)
    # Where OpenMM could not use the platform that it tried first, the variables of the exact engine may be missing.
    has_variables = set(STATE_VARIABLES) <= vectors_of(context.getIntegrator())
    if name == "auto" and is_on_host(context.getPlatform()) and has_variables:
        # The native engine needs no shapes.
        with suppress(UnknownShapeError):
            return ExactEngine(context, method, tally, bodies)
    if installed is not None:
        try:
            compiled = KernelTrialEngine if method.trial_steps else KernelsEngine
            return compiled(context, method, tally, bodies, program, installed)
        except (openmm.OpenMMException, RigidityError):
            installed.take_back()
            if name == KernelsEngine.name:
                raise
    if name in ("auto", NativeEngine.name):
        native = NativeEngine if program.trials is None else TrialEngine
        return native(context, method, tally, bodies, program)
    raise ValueError(f"unknown engine '{name}'")
