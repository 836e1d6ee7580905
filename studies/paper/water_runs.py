"""Runs of liquid water: from each phase point one with every method and step."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import openmm

from openmm_sier.analysis.statistics import rms
from openmm_sier.dynamics.bodies import RigidityError
from studies import frame
from studies.methods import PAPER, Method
from studies.paper import liquids
from studies.paper.published import FS
from studies.records import Task

#: Beyond this rms(H)/rms(V) a method has broken down, and longer steps are not tried.
BROKEN = 1.0


class PhasePoint(NamedTuple):
    """Where runs start: the kind of the liquid, and the number of the point, from 1."""

    kind: str
    number: int


@dataclass(frozen=True)
class WaterSettings:
    """Parameters of the experiment.

    Attributes:
        molecules: number of them; all 512 of the project's box, or fewer.
        temperature: K.
        cutoffs: of both systems.
        kinds: which systems are run.
        force_steps_fs: h/f, fs, for SIER2 and SIER4.
        compared_from_fs: MRDL and SEJ4 run from this h/f on; below they cannot be told from SIER2.
        compared_to_fs: and up to this one.
        fine_below_fs: for h/f below this, fewer runs are averaged, since they take long, and none with PME, whose
            single-precision forces would hide the errors.
        span: length of a run, ps.
        runs, fine_runs: number of runs averaged.
        relax: time at constant temperature before the first phase point and between two, ps.
        sample_fs: time between two evaluations of H, fs, or the step if that is longer.
        seed: of everything random.
    """

    molecules: int = 512
    temperature: float = 297.0
    cutoffs: liquids.Cutoffs = field(default_factory=liquids.Cutoffs)
    kinds: tuple[str, ...] = (liquids.MOLECULAR, liquids.PME)
    force_steps_fs: tuple[float, ...] = (0.1, 0.25, 0.5, 1.0, 1.4, 1.8, 2.2, 2.8, 3.5, 5.0, 7.0)
    compared_from_fs: float = 1.0
    compared_to_fs: float = 7.0
    fine_below_fs: float = 0.4
    span: float = 1.0
    runs: int = 9
    fine_runs: int = 3
    relax: float = 1.0
    sample_fs: float = 4.0
    seed: int = 1

    def steps_of(self, method: Method, point: PhasePoint) -> list[float]:
        """h/f in fs of the runs with a method from a phase point."""
        compared = method.name in ("MRDL", "SEJ4")
        first = self.compared_from_fs if compared else 0.0
        last = self.compared_to_fs if compared else np.inf
        steps = [step for step in self.force_steps_fs if first <= step <= last]
        fine = point.kind == liquids.MOLECULAR and point.number <= self.fine_runs
        return [step for step in steps if fine or step >= self.fine_below_fs]


#: Fewer molecules, so that a shorter cut-off fits in the box, and fewer and shorter runs.
QUICK = WaterSettings(
    molecules=216,
    cutoffs=liquids.Cutoffs(molecular_on=0.7, molecular_off=0.9, pme=0.9, pme_switch=0.7),
    force_steps_fs=(0.7, 1.0, 1.4, 2.0, 2.8),
    compared_from_fs=1.4,
    compared_to_fs=2.0,
    fine_below_fs=0.0,
    span=0.25,
    runs=2,
    relax=0.4,
)


def phase_points(settings: WaterSettings) -> list[PhasePoint]:
    """Return all phase points of an experiment, the slowest first, which are those of PME."""
    kinds = [kind for kind in (liquids.PME, liquids.MOLECULAR) if kind in settings.kinds]
    return [PhasePoint(kind, 1 + i) for kind in kinds for i in range(settings.runs)]


def tasks(settings: WaterSettings) -> list[Task]:
    """The runs from each phase point."""
    shared = {"seed": settings.seed, "molecules": settings.molecules, "span": settings.span}
    return [Task(settings, point._asdict() | shared) for point in phase_points(settings)]


def run(task: Task) -> dict[str, Any]:
    """The point of a task, with its `runs`: all methods and steps from one phase point.

    A run has its `kind`, `number` of the phase point, `method`, `force_step_fs`, and about the run's own means `rms_H`,
    `rms_V` in kJ/mol and the `drift` of H in kJ/mol/ps, None if the run did not finish.
    """
    settings, point = task.settings, PhasePoint(task.point["kind"], task.point["number"])
    water = liquids.water_box(settings.molecules)
    # From a box of its own the liquid has to settle first; the project's has.
    time = settings.relax * point.number if settings.molecules == WaterSettings.molecules else None
    seed = settings.seed + point.number
    phase = liquids.phase_point(water, point.kind, settings.cutoffs, settings.temperature, time, seed)
    system = liquids.build(point.kind, water, settings.cutoffs)
    runs, broken = [], set()
    for method in PAPER:
        for step in settings.steps_of(method, point):
            if method.name in broken:
                continue
            row = point._asdict() | {"method": method.name, "force_step_fs": step}
            row |= _run(system, point.kind, phase, method, step, settings)
            runs.append(row)
            if row["rms_H"] is None or row["rms_H"] > BROKEN * row["rms_V"]:
                broken.add(method.name)
    return task.point | {"runs": runs}


def _run(
    system: openmm.System, kind: str, phase: openmm.State, method: Method, step: float, settings: WaterSettings
) -> dict[str, float | None]:
    duration = step * method.forces
    context = liquids.context(system, method.make(duration * FS), kind)
    context.setState(phase)
    try:
        # One step before the first energy makes velocities those of rigid bodies to rounding.
        context.getIntegrator().step(1)
        table = frame.sampled(context, frame.energies, duration, settings.span, settings.sample_fs).table
    except (openmm.OpenMMException, RigidityError):
        return dict.fromkeys(("rms_H", "rms_V", "drift"))
    # The paper takes H about its mean.
    found = frame.conservation(table)
    if not math.isfinite(found["rms"]):
        return dict.fromkeys(("rms_H", "rms_V", "drift"))
    return {"rms_H": found["rms"], "rms_V": rms(table["potential"].to_numpy()), "drift": found["drift"]}
