"""Choose the engine of an integrator."""

import os
from functools import cache

import openmm

from openmm_sier.engines.exact.engine import ExactEngine
from openmm_sier.engines.native.engine import NativeEngine
from openmm_sier.engines.native.installation import vectors_of
from openmm_sier.engines.native.trial_engine import TrialEngine
from openmm_sier.engines.protocol import Engine, Task
from openmm_sier.engines.variables import STATE_VARIABLES

#: Engines by the names by which users ask for them.
ENGINES: dict[str, type[Engine]] = {engine.name: engine for engine in (ExactEngine, NativeEngine)}

#: The platforms on which "auto" takes the exact engine, since their forces are in memory that Python can read.
EXACT_PLATFORMS = ("CPU", "Reference")


def is_on_host(platform: openmm.Platform) -> bool:
    """Return whether Python can read the forces of a platform without a copy from a GPU."""
    return platform.getName() in EXACT_PLATFORMS


def usual_platform() -> openmm.Platform:
    """Return the platform that OpenMM takes for a Context of which none is named: the fastest that works here."""
    return _taken_by_openmm(os.environ.get("OPENMM_DEFAULT_PLATFORM"))


@cache
def _taken_by_openmm(default: str | None) -> openmm.Platform:
    # A platform may be registered where it has no device.
    particle = openmm.System()
    particle.addParticle(1.0)
    return openmm.Context(particle, openmm.VerletIntegrator(0.001)).getPlatform()


def engine_for(wanted: str, task: Task) -> Engine:
    """Return an engine of `ENGINES` for a task, or the one that suits the platform if "auto" is wanted."""
    if wanted == ExactEngine.name:
        return ExactEngine(task)
    native = NativeEngine if task.program.trials is None else TrialEngine
    if wanted == NativeEngine.name:
        return native(task)
    # Where OpenMM could not use the platform that it tried first, the variables of the exact engine may be missing.
    has_variables = set(STATE_VARIABLES) <= vectors_of(task.context.getIntegrator())
    if is_on_host(task.context.getPlatform()) and has_variables:
        return ExactEngine(task)
    return native(task)
