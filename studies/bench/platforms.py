"""What the integrators reach on one platform, by the size of the box: `openmm-sier bench --platform NAME`."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import openmm

from openmm_sier.dynamics.schemes import SIER2, SIER4G, SIER4P
from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.measure import sampling
from openmm_sier.measure.forcefields import read_box
from openmm_sier.measure.report import Report, Table
from openmm_sier.measure.starts import equilibrated, make_context
from openmm_sier.measure.statistics import median_and_error
from openmm_sier.system.find_bodies import RigidBodies
from studies.bench import accuracy, replicas
from studies.bench.accuracy import LEVELS, Point
from studies.bench.timing import BenchSettings, interleaved

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


def time_platform(settings: BenchSettings, report: Report) -> dict[str, Any]:
    """Speeds by size and method, and the points from which the step for an energy error follows.

    The energy error is measured in the box that larger ones repeat: relative to the fluctuation of V it does not depend
    on the size.

    Raises:
        ValueError: a size is no multiple of the box.
    """
    box = read_box(settings.box, settings.forcefield)
    unit_size = box.topology.getNumResidues()
    shapes = [replicas.copies_for(n, unit_size) for n in settings.molecules]
    points = _energy_errors(box, settings, report)
    rows: list[dict[str, Any]] = []
    for shape in shapes:
        rows += _speeds(replicas.repeated(box, settings.box.parent, shape), points, settings, report)
    return {"rows": rows, "points": [vars(point) for point in points]}


def _energy_errors(box: Any, settings: BenchSettings, report: Report) -> list[Point]:
    bodies = RigidBodies.from_system(box.system, box.topology)
    start = equilibrated(box, settings.temperature, settings.seed, settings.equilibrate, settings.platform, report)
    known, points = sampling.nve_methods(), []
    for name in CONSERVING:
        for dt in accuracy.METHODS.get(name, ()):
            try:
                points.append(accuracy.of_openmm(known[name], dt, box.system, bodies, start, settings))
            except (sampling.Unstable, openmm.OpenMMException) as error:
                report.note(f"{name} at {dt:g} fs per force: {error}")
                continue
            report.note(f"{points[-1].method} at {dt:g} fs per force: {100 * points[-1].error:.4f} %")
    return points


def _speeds(
    replica: replicas.Replica, points: list[Point], settings: BenchSettings, report: Report
) -> list[dict[str, Any]]:
    """Rows of one size: all methods take turns, and ratios are those within a turn."""
    contexts = _contexts(replica, settings)
    platform = contexts[VERLET].getPlatform().getName()
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
        over, spread = median_and_error(seconds[name] / seconds[FORCES])
        speed = evaluations / float(np.median(seconds[name]))
        steps = {level: accuracy.step_at(points, name, level) for level in LEVELS}
        row: dict[str, Any] = {
            "platform": platform,
            "engine": getattr(contexts[name].getIntegrator(), "engine", ""),
            "molecules": replica.molecules,
            "method": name,
            "steps_per_second": speed / per_step,
            "forces_per_second": speed,
            "over_forces": over,
            "spread": spread,
            "fs_per_second": {f"{level:g}": dt * speed for level, dt in steps.items()},
        }
        rows.append(row)
        report.note(f"{replica.molecules} molecules: {name}, {speed:.4g} forces/s, {over:.3f} times the forces alone")
    return rows


def _contexts(replica: replicas.Replica, settings: BenchSettings) -> dict[str, openmm.Context]:
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


def tables(found: dict[str, Any]) -> list[Table]:
    """Speeds, for the report."""
    rows = found["rows"]
    platform = rows[0]["platform"]
    errors = accuracy.tables([Point(**point) for point in found["points"]])[0]

    def cell(value: float) -> str:
        return "-" if math.isnan(value) else f"{value:.4g}"

    speeds = Table(
        f"On the {platform} platform, {1e3 * STEP:g} fs per force",
        ["molecules", "method", "engine", "steps/s", "forces/s", "over the forces", "±"],
        [
            [
                str(row["molecules"]),
                row["method"],
                row["engine"],
                cell(row["steps_per_second"]),
                cell(row["forces_per_second"]),
                f"{row['over_forces']:.3f}",
                f"{row['spread']:.3f}",
            ]
            for row in rows
        ],
    )
    levels = [f"{level:g}" for level in LEVELS]
    equal = Table(
        "Simulated fs per second at equal rms(H)/rms(V); - where no step of the first table encloses it",
        ["molecules", "method", *(f"{100 * level:g} %" for level in LEVELS)],
        [[str(row["molecules"]), row["method"], *(cell(row["fs_per_second"][k]) for k in levels)] for row in rows],
    )
    return [errors, speeds, equal]
