"""Speed of a sheet of chains of beads with rigid domains, in a bath, for GPUs."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import openmm

from openmm_sier import SIERLangevinIntegrator, with_frames
from openmm_sier.inputs.equilibration import make_context
from studies import timing
from studies.domains import chain
from studies.domains.methods import METHODS, Made
from studies.domains.models import INTERACTIONS, Model
from studies.units import md

#: What ratios are taken over.
REFERENCE = "LangevinMiddle, springs, 10 fs"

#: 1/ps.
FRICTION = 1.0

#: Steps in fs of what `studies.domains` compares.
STEPS = {"langevinmiddle": (10.0, 60.0), "frames": (40.0,)}


def timed(settings: Any) -> list[dict[str, Any]]:
    """Return a row for each method in a sheet of chains.

    Args:
        settings: of `studies.gpu`.

    Raises:
        ValueError: the number of chains is no square.
    """
    edge = math.isqrt(settings.chains)
    if edge * edge != settings.chains:
        raise ValueError(f"chains: expected a square such as 64, got {settings.chains}")
    model = chain.sheet(edge)
    for system in (model.rigid, model.network):
        _divide_groups(system)
    contexts, durations = {}, {}
    for name, steps in STEPS.items():
        for step in steps:
            moving = METHODS[name].make(model, 1e-3 * step, FRICTION, settings.seed)
            called = f"{METHODS[name].name}, {step:g} fs"
            contexts[called], durations[called] = _context(moving, settings), step
    for engine, step in (("native", 40.0), ("exact", 60.0)):
        called = f"SIER2, {'frames' if engine == 'native' else 'exact engine'}, {step:g} fs"
        contexts[called], durations[called] = _context(_own(model, engine, step), settings), step
    rows = timing.speeds(contexts, durations, {"over": REFERENCE}, settings.rounds, settings.turn)
    return [{"chains": settings.chains, "beads": len(model.positions), "method": row.pop("name")} | row for row in rows]


def _divide_groups(system: openmm.System) -> None:
    """Put nonbonded Forces into groups of their own: GPUs take one cut-off in each group."""
    nonbonded = [force for force in system.getForces() if isinstance(force, openmm.CustomNonbondedForce)]
    for number, force in enumerate(nonbonded):
        force.setForceGroup(INTERACTIONS + 4 * number)


def _own(model: Model, engine: str, step: float) -> Made:
    """Return frames that the native engine moves, or bodies that the exact one does."""
    if engine == "exact":
        integrator = SIERLangevinIntegrator(
            model.temperature, FRICTION, 1e-3 * step, engine=engine, bodies=model.rigid_bodies
        )
        return Made(model.rigid, integrator, model.positions)
    framed = with_frames(model.rigid, model.positions, model.bodies)
    integrator = SIERLangevinIntegrator(model.temperature, FRICTION, 1e-3 * step, engine=engine)
    return Made(framed.system, integrator, np.asarray(md(framed.positions)), framed)


def _context(moving: Made, settings: Any) -> openmm.Context:
    context = make_context(moving.system, moving.integrator, settings.platform)
    context.setPositions(moving.positions)
    context.setVelocitiesToTemperature(settings.temperature, settings.seed)
    return context
