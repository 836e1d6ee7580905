"""Processor time of steps, by turns."""

from __future__ import annotations

from typing import Any

import openmm

from openmm_sier.inputs.equilibration import make_context
from studies import timing
from studies.domains import bath, energy
from studies.domains.methods import METHODS, TRIAL
from studies.domains.models import Model
from studies.domains.plans import Plan

#: s that a turn should take.
TURN = 0.2

#: 1/ps.
FRICTION = 1.0


def by_turns(
    model: Model, plan: Plan, start: openmm.State, rounds: int, seed: int, platform: str
) -> list[dict[str, Any]]:
    """Return rows with ns a day for each method at each step that the plan has, and for springs at their usual step.

    A step costs the same at any length, but where forces act in inner steps. There each length has its own turns.
    """
    contexts: dict[tuple[str, float], openmm.Context] = {}
    for name, steps in plan.baths.items():
        for step in steps if METHODS[name].inner else [*steps, model.usual][:1]:
            moving = METHODS[name].make(model, 1e-3 * step, FRICTION, seed)
            contexts[name, step] = bath.context_at(moving, model, start, seed, platform)
    for name, steps in plan.energies.items():
        chosen = energy.INTEGRATORS[name]
        integrator = chosen.make(model, 1e-3 * steps[0])
        context = make_context(energy.system_of(model, chosen), integrator, platform)
        context.setPositions(start.getPositions())
        context.setVelocitiesToTemperature(model.temperature, seed)
        contexts[name, steps[0]] = context
    rows: list[dict[str, Any]] = []
    # Per fs of a step.
    for timed in timing.speeds(contexts, dict.fromkeys(contexts, 1.0), {}, rounds, TURN):
        name, step = timed["name"]
        for each in [step] if name in METHODS and METHODS[name].inner else _steps(model, plan, name):
            rows.append({"method": _name(name), "step": each, **_speed(name, each, timed)})
    return rows


def _steps(model: Model, plan: Plan, name: str) -> list[float]:
    """Return all steps for which the speed of a method is measured."""
    usual = [model.usual] if name == "langevinmiddle" else []
    return sorted({*usual, *{**plan.baths, **plan.energies}[name]})


def _name(name: str) -> str:
    """Return the name of a method for tables."""
    return METHODS[name].name if name in METHODS else energy.INTEGRATORS[name].name


def _speed(name: str, step: float, timed: dict[str, Any]) -> dict[str, float]:
    """Return ms of a step, or a trial, and ns a day with its error, both of processor time."""
    simulated = step * (TRIAL if name in METHODS and METHODS[name].exact else 1)
    return {
        "ms": 1e-3 * timed["microseconds"],
        "ns_a_day": simulated * timed["ns_per_day_processor"],
        "ns_a_day_error": simulated * timed["ns_per_day_processor_error"],
    }
