"""Processor time of steps, by turns."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from time import process_time
from typing import Any

import openmm

from studies.bench.timing import median_and_error, turns
from studies.domains import bath, energy, lammps
from studies.domains.methods import METHODS, TRIAL
from studies.domains.models import Model
from studies.domains.plans import Plan
from studies.units import md

#: s of processor time that a turn should take, and steps of LAMMPS in one.
TURN, LAMMPS_STEPS = 0.2, 500

#: 1/ps.
FRICTION = 1.0


def by_turns(model: Model, plan: Plan, start: openmm.State, rounds: int, seed: int, platform: str) -> list[dict]:
    """Rows with ns a day for each method at each step that the plan has in the bath and at constant energy.

    Steps of one method cost the same unless forces act in inner steps, but each has its own turns.
    """
    actions: dict[str, Callable[[], float]] = {}
    rows: dict[str, dict[str, Any]] = {}
    contexts = []
    for name, steps in plan.baths.items():
        for step in steps:
            made = METHODS[name].make(model, 1e-3 * step, FRICTION, seed)
            contexts.append(bath.context_at(made, model, start, seed, platform))
            label = f"{name} {step}"
            actions[label] = _turn(made.integrator)
            per_step = TRIAL * step if METHODS[name].exact else step
            rows[label] = {"method": METHODS[name].name, "step": step, "simulated": per_step}
    for name, steps in plan.energies.items():
        integrator = energy.INTEGRATORS[name].make(model, 1e-3 * steps[0])
        system = model.network if energy.INTEGRATORS[name].springs else model.rigid
        context = bath.make_context(openmm.XmlSerializer.clone(system), integrator, platform)
        context.setPositions(start.getPositions())
        context.setVelocitiesToTemperature(model.temperature, seed)
        contexts.append(context)
        label = f"{name} {steps[0]}"
        actions[label] = _turn(integrator)
        rows[label] = {"method": energy.INTEGRATORS[name].name, "step": steps[0], "simulated": steps[0]}
    with tempfile.TemporaryDirectory() as place:
        for step in plan.in_lammps if lammps.installed() else ():
            label = f"lammps {step}"
            actions[label] = _turn_of_lammps(model, start, step, seed, Path(place))
            rows[label] = {"method": lammps.NAME, "step": step, "simulated": step}
        for label, seconds in turns(actions, rounds).items():
            spent = median_and_error(seconds)
            a_day = 86400 * 1e-6 * rows[label]["simulated"] / spent.value
            rows[label] |= {"ms": 1e3 * spent.value, "ms_error": 1e3 * spent.error}
            rows[label] |= {"ns_a_day": a_day, "ns_a_day_error": a_day * spent.error / spent.value}
    return list(rows.values())


def _turn(integrator: openmm.Integrator) -> Callable[[], float]:
    """A function that makes some steps, and gives the processor time of one in s."""
    integrator.step(1)
    begun = process_time()
    integrator.step(2)
    steps = max(2, round(2 * TURN / max(1e-6, process_time() - begun)))

    def take() -> float:
        begun = process_time()
        integrator.step(steps)
        return (process_time() - begun) / steps

    return take


def _turn_of_lammps(model: Model, start: openmm.State, step: float, seed: int, place: Path) -> Callable[[], float]:
    """The same of LAMMPS, which starts anew each time; what it takes to start does not count."""
    positions = md(start.getPositions(asNumpy=True))

    def take() -> float:
        made = lammps.run(model, positions, step, LAMMPS_STEPS, LAMMPS_STEPS, FRICTION, seed, place)
        return made.seconds / LAMMPS_STEPS

    return take
