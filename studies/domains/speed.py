"""Processor time of steps, by turns."""

from __future__ import annotations

from collections.abc import Callable
from time import process_time
from typing import Any

import openmm

from openmm_sier.analysis.statistics import Estimate
from openmm_sier.inputs.equilibration import make_context
from studies.domains import bath, energy
from studies.domains.methods import METHODS, TRIAL
from studies.domains.models import Model
from studies.domains.plans import Plan
from studies.timing import median_and_error, turns

#: s of processor time that a turn should take.
TURN = 0.2

#: 1/ps.
FRICTION = 1.0


def by_turns(
    model: Model, plan: Plan, start: openmm.State, rounds: int, seed: int, platform: str
) -> list[dict[str, Any]]:
    """Rows with ns a day for each method at each step that the plan has, and for springs at their usual step.

    A step costs the same at any length, but where forces act in inner steps. There each length has its own turns.
    """
    actions: dict[tuple[str, float], Callable[[], float]] = {}
    contexts = []
    for name, steps in plan.baths.items():
        for step in steps if METHODS[name].inner else [*steps, model.usual][:1]:
            moving = METHODS[name].make(model, 1e-3 * step, FRICTION, seed)
            contexts.append(bath.context_at(moving, model, start, seed, platform))
            actions[name, step] = _turn(moving.integrator)
    for name, steps in plan.energies.items():
        chosen = energy.INTEGRATORS[name]
        integrator = chosen.make(model, 1e-3 * steps[0])
        context = make_context(energy.system_of(model, chosen), integrator, platform)
        context.setPositions(start.getPositions())
        context.setVelocitiesToTemperature(model.temperature, seed)
        contexts.append(context)
        actions[name, steps[0]] = _turn(integrator)
    rows: list[dict[str, Any]] = []
    for (name, step), times in turns(actions, rounds).items():
        spent = median_and_error(times)
        has_own_turns = name in METHODS and METHODS[name].inner
        for each in [step] if has_own_turns else _steps(model, plan, name):
            rows.append({"method": _name(name), "step": each, **_speed(name, each, spent)})
    return rows


def _steps(model: Model, plan: Plan, name: str) -> list[float]:
    """All steps for which the speed of a method is measured."""
    usual = [model.usual] if name == "langevinmiddle" else []
    return sorted({*usual, *{**plan.baths, **plan.energies}[name]})


def _name(name: str) -> str:
    """The name of a method for tables."""
    return METHODS[name].name if name in METHODS else energy.INTEGRATORS[name].name


def _speed(name: str, step: float, spent: Estimate) -> dict[str, float]:
    """ms a step, or a trial, and ns a day with errors, from seconds."""
    simulated = step * (TRIAL if name in METHODS and METHODS[name].exact else 1)
    a_day = 86400 * 1e-6 * simulated / spent.value
    share = spent.error / spent.value
    return {"ms": 1e3 * spent.value, "ms_error": 1e3 * spent.error, "ns_a_day": a_day, "ns_a_day_error": a_day * share}


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
