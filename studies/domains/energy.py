"""Runs of a model at constant energy: by Verlet with springs in bodies, by SIER4G with rigid bodies."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import openmm

from openmm_sier import SIERIntegrator
from openmm_sier.inputs.equilibration import make_context
from studies import frame
from studies.domains import bath
from studies.domains.methods import METHODS
from studies.domains.models import FAST, JOINTS, LINKERS, Model

#: ps and 1/ps of the bath that gives springs their heat before a run.
WARMING, WARMING_FRICTION = 20.0, 5.0

#: Steps of the shortest run.
FEWEST = 10


class Integrator(NamedTuple):
    """An integrator at constant energy.

    Attributes:
        name: for tables.
        springs: whether springs hold bodies, which are rigid otherwise.
        forces: evaluations a step.
        make: model and step in ps -> integrator.
        fast: names of Forces that act in inner steps.
    """

    name: str
    springs: bool
    forces: int
    make: Callable[[Model, float], openmm.Integrator]
    fast: tuple[str, ...] = ()


def _nested(model: Model, step: float) -> openmm.Integrator:
    return SIERIntegrator(step, bodies=model.rigid_bodies, fastForceGroups={FAST}, substeps=1)


INTEGRATORS = {
    "sier4g": Integrator("SIER4G", False, 3, lambda model, step: SIERIntegrator(step, bodies=model.rigid_bodies)),
    "sier4g-linkers": Integrator("SIER4G, bonds of linkers in inner steps", False, 3, _nested, (LINKERS,)),
    "sier4g-inner": Integrator("SIER4G, all bonds in inner steps", False, 3, _nested, (LINKERS, JOINTS)),
    "verlet": Integrator("Verlet, springs", True, 1, lambda model, step: openmm.VerletIntegrator(step)),
}


def followed(model: Model, name: str, step: float, time: float, start: openmm.State, seed: int) -> dict[str, Any]:
    """Errors of the energy H of a run in double precision: rms in kJ/mol and over that of V in per cent, and the drift.

    Args:
        model, name: what is run, and by which of `INTEGRATORS`.
        step: fs.
        time: ps.
        start: a phase point of the rigid model in the bath; springs are warmed from it.
        seed: of velocities and of the bath that warms springs.
    """
    chosen = INTEGRATORS[name]
    system = system_of(model, chosen)
    if chosen.springs:
        start = warmed(model, start, seed)
    integrator = chosen.make(model, 1e-3 * step)
    context = make_context(system, integrator, "Reference")
    context.setPositions(start.getPositions())
    context.setVelocities(start.getVelocities())
    # There is a sample after each step, so that all oscillations of the energy count.
    table = frame.sampled(context, frame.energies, step, max(time, 1e-3 * FEWEST * step), step).table
    found = frame.conservation(table)
    return {"forces": chosen.forces, "drift_error": found.pop("its_error")} | found


def system_of(model: Model, chosen: Integrator) -> openmm.System:
    """A copy of the System that an integrator is for, with its fast forces in their group.

    Raises:
        ValueError: it is for springs, and the model has none.
    """
    system = model.network if chosen.springs else model.rigid
    if system is None:
        raise ValueError(f"{model.name} has no springs")
    copy = openmm.XmlSerializer.clone(system)
    for force in copy.getForces():
        if force.getName() in chosen.fast:
            force.setForceGroup(FAST)
    return copy


def warmed(model: Model, start: openmm.State, seed: int) -> openmm.State:
    """A phase point of the model with springs in the bath."""
    moving = METHODS["langevinmiddle"].make(model, 1e-3 * model.usual, WARMING_FRICTION, seed)
    context = bath.context_at(moving, model, start, seed, "CPU")
    moving.integrator.step(round(1e3 * WARMING / model.usual))
    return context.getState(positions=True, velocities=True)
