"""Which engine an integrator gets."""

import os

import openmm

from openmm_sier.dynamics.flow import Flow
from openmm_sier.engines.exact.engine import ExactEngine
from openmm_sier.engines.native.engine import NativeEngine
from openmm_sier.engines.native.installation import vectors_of
from openmm_sier.engines.native.program import Program
from openmm_sier.engines.protocol import Engine
from openmm_sier.engines.variables import STATE_VARIABLES, StoredLedger
from openmm_sier.system.arguments import Bodies

#: Engines by the names by which users ask for them.
ENGINES = {engine.name: engine for engine in (ExactEngine, NativeEngine)}

#: The platforms on which "auto" takes the exact engine, since their forces are in memory that Python can read.
EXACT_PLATFORMS = ("CPU", "Reference")


def is_on_host(platform: openmm.Platform) -> bool:
    """Return whether Python can read the forces of a platform without a copy from a GPU."""
    return platform.getName() in EXACT_PLATFORMS


def fastest_platform() -> openmm.Platform:
    """Return the platform that OpenMM takes for a Context of which none is named."""
    if name := os.environ.get("OPENMM_DEFAULT_PLATFORM"):
        return openmm.Platform.getPlatformByName(name)
    return max(map(openmm.Platform.getPlatform, range(openmm.Platform.getNumPlatforms())), key=lambda it: it.getSpeed())


def engine_for(
    wanted: str, context: openmm.Context, flow: Flow, stored: StoredLedger, bodies: Bodies, program: Program
) -> Engine:
    """Return the engine of a Context.

    Args:
        wanted: "exact", "native" or "auto".
        context: openmm.Context.
        flow: what will be followed.
        stored: the ledger of the integrator.
        bodies: as users give them.
        program: what OpenMM executes for the native engine.
    """
    # Where OpenMM could not use the platform that it tried first, the variables of the exact engine may be missing.
    has_variables = set(STATE_VARIABLES) <= vectors_of(context.getIntegrator())
    if wanted == "exact" or (wanted == "auto" and is_on_host(context.getPlatform()) and has_variables):
        return ExactEngine(context, flow, stored, bodies)
    return NativeEngine(context, flow, stored, bodies, program)
