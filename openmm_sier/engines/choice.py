"""Which engine an integrator gets."""

import openmm

from openmm_sier.engines.exact.engine import ExactEngine
from openmm_sier.engines.native.engine import NativeEngine
from openmm_sier.engines.native.program import Program
from openmm_sier.engines.protocol import Engine, Flow
from openmm_sier.system.arguments import Bodies

#: Engines by the names by which users ask for them.
ENGINES = {engine.name: engine for engine in (ExactEngine, NativeEngine)}

#: The platforms on which "auto" takes the exact engine, since their forces are in memory that Python can read.
EXACT_PLATFORMS = ("CPU", "Reference")


def engine_for(wanted: str, context: openmm.Context, flow: Flow, bodies: Bodies, program: Program) -> Engine:
    """The engine of a Context, "exact", "native" or "auto" as wanted; the program is that of the flow."""
    on_host = context.getPlatform().getName() in EXACT_PLATFORMS
    if wanted == "exact" or (wanted == "auto" and on_host):
        return ExactEngine(context, flow, bodies)
    return NativeEngine(context, flow, bodies, program)
