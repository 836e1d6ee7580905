"""What the integrators reach on one platform, by the size of the box: `python -m studies.bench --platform NAME`."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
import openmm
import pandas as pd

from openmm_sier.dynamics.schemes import SIER2, SIER4G, SIER4P
from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.measure.report import Report, Table
from openmm_sier.measure.starts import make_context
from studies import boxes, records
from studies.bench import accuracy
from studies.bench.accuracy import LEVELS
from studies.bench.timing import BenchSettings, interleaved, median_and_error
from studies.sampling import equilibrated_liquid

#: ps for each force evaluation in the runs that are timed.
STEP = 2e-3

VERLET = "OpenMM Verlet"

#: What is timed, as force evaluations per step, and (step in ps, temperature in K) -> integrator.
METHODS: dict[str, tuple[int, Callable[[float, float], openmm.Integrator]]] = {
    VERLET: (1, lambda h, temperature: openmm.VerletIntegrator(h)),
    "OpenMM LangevinMiddle": (1, lambda h, temperature: openmm.LangevinMiddleIntegrator(temperature, 1, h)),
    "SIER2": (1, lambda h, temperature: SIERIntegrator(h, SIER2)),
    "SIER4G": (3, lambda h, temperature: SIERIntegrator(h, SIER4G)),
    "SIER4P": (4, lambda h, temperature: SIERIntegrator(h, SIER4P)),
}

#: Methods whose energy errors are measured, in the box that larger ones repeat, by their names in `accuracy.METHODS`.
CONSERVING = ("verlet", "sier2", "sier4g", "sier4p")

#: Force evaluations in the shortest turn, a multiple of those in a step of every method; seconds that a turn should
#: take; and the most force evaluations in a turn.
EVALUATIONS, TURN, MOST_EVALUATIONS = 12, 0.3, 6000

FORCES, READING = "forces", "reading"


SPEEDS = {
    "molecules": "{molecules}",
    "method": "{method}",
    "engine": "{engine}",
    "steps/s": "{steps_per_second:.4g}",
    "forces/s": "{forces_per_second:.4g}",
    "over the forces": "{over_forces:.3f} ± {over_forces_error:.3f}",
}

#: Simulated time per second at an energy error, a column for each.
EQUAL = {f"{level:g} %": f"fs_per_second_at_{level:g}".replace(".", "_") for level in LEVELS}


def find(settings: BenchSettings, report: Report) -> dict[str, pd.DataFrame]:
    """Speeds by size and method, and the points from which the step for an energy error follows.

    The energy error is measured in the box that larger ones repeat: relative to the fluctuation of V it does not depend
    on the size.

    Raises:
        ValueError: a size is no multiple of the box.
    """
    box = boxes.read(settings)
    shapes = [boxes.copies_for(n, box.topology.getNumResidues()) for n in settings.molecules]
    liquid = equilibrated_liquid(settings, settings.equilibrate, report)
    steps = {name: accuracy.METHODS[name] for name in CONSERVING if name in accuracy.METHODS}
    points = pd.DataFrame(accuracy.measure(liquid, steps, settings.time, report))
    rows: list[dict[str, Any]] = []
    for shape in shapes:
        rows += _speeds(boxes.repeated(box, settings.box.parent, shape), points, settings, report)
    return {"platform_points": points, "speeds": pd.DataFrame(rows)}


def tables(found: Mapping[str, pd.DataFrame]) -> list[Table]:
    """Speeds, for the report."""
    speeds = found["speeds"]
    title = f"On the {speeds['platform'].iloc[0]} platform, {1e3 * STEP:g} fs per force"
    equal = "Simulated fs per second at equal rms(H)/rms(V); - where no step of the first table encloses it"
    columns = {"molecules": "{molecules}", "method": "{method}"}
    columns |= {heading: f"{{{name}:.4g}}" for heading, name in EQUAL.items()}
    return [
        records.table("Energy error and speed", found["platform_points"], accuracy.POINTS),
        records.table(title, speeds, SPEEDS),
        records.table(equal, speeds, columns),
    ]


def _speeds(
    replica: boxes.Replica, points: pd.DataFrame, settings: BenchSettings, report: Report
) -> list[dict[str, Any]]:
    """Rows of one size: all methods take turns, and ratios are those within a turn."""
    contexts = _contexts(replica, settings)
    evaluations = _evaluations_in_a_turn(contexts[VERLET])
    actions = {READING: partial(_read, contexts[VERLET]), FORCES: partial(_turn, contexts[FORCES], evaluations)}
    for name, (per_step, _) in METHODS.items():
        actions[name] = partial(_turn, contexts[name], evaluations // per_step)
    seconds = interleaved(actions, settings.rounds)
    reading = seconds.pop(READING)
    # Positions are read only to wait for a GPU.
    seconds = {name: np.maximum(values - reading, 1e-9) for name, values in seconds.items()}
    rows = []
    for name, (per_step, _) in METHODS.items():
        over, error, _ = median_and_error(seconds[name] / seconds[FORCES])
        speed = evaluations / float(np.median(seconds[name]))
        row: dict[str, Any] = {
            "platform": contexts[name].getPlatform().getName(),
            "engine": getattr(contexts[name].getIntegrator(), "engine", ""),
            "molecules": replica.molecules,
            "method": name,
            "steps_per_second": speed / per_step,
            "forces_per_second": speed,
            "over_forces": over,
            "over_forces_error": error,
        }
        for level, column in zip(LEVELS, EQUAL.values(), strict=True):
            row[column] = accuracy.step_at(points, name, level) * speed
        rows.append(row)
        form = "{molecules} molecules: {method}, {forces_per_second:.4g} forces/s, {over_forces:.3f} times the forces"
        report.note(f"{records.cell(form, row)} alone")
    return rows


def _contexts(replica: boxes.Replica, settings: BenchSettings) -> dict[str, openmm.Context]:
    """One Context for each method, from the same atoms, and one that computes nothing but forces."""
    integrators = {name: make(STEP * n, settings.temperature) for name, (n, make) in METHODS.items()}
    integrators[FORCES] = _forces_alone()
    contexts = {}
    for name, integrator in integrators.items():
        contexts[name] = context = make_context(replica.system, integrator, settings.platform)
        context.setPositions(replica.positions)
        context.applyConstraints(1e-6)
        context.setVelocitiesToTemperature(settings.temperature, settings.seed)
    return contexts


def _forces_alone() -> openmm.CustomIntegrator:
    """An integrator that only computes forces, at positions that it declares to be new although they are not."""
    integrator = openmm.CustomIntegrator(STEP)
    integrator.addPerDofVariable("seen", 0)
    integrator.addComputePerDof("x", "x")
    integrator.addComputePerDof("seen", "f")
    return integrator


def _read(context: openmm.Context) -> None:
    context.getState(positions=True)


def _turn(context: openmm.Context, steps: int) -> None:
    context.getIntegrator().step(steps)
    _read(context)


def _evaluations_in_a_turn(context: openmm.Context) -> int:
    """Number, a multiple of `EVALUATIONS`, with which a turn of Verlet takes `TURN` seconds."""
    _turn(context, EVALUATIONS)
    begun = time.perf_counter()
    _turn(context, EVALUATIONS)
    count = math.ceil(TURN / max(time.perf_counter() - begun, 1e-6))
    return EVALUATIONS * min(count, MOST_EVALUATIONS // EVALUATIONS)
