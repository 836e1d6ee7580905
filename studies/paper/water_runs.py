"""The runs of liquid water: from each phase point one with every method and step, kept on disk as they are done."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import RigidityError
from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.measure.observables import energy_drift, energy_fluctuation
from openmm_sier.measure.statistics import rms
from studies.files import replace_file
from studies.paper import liquids, start
from studies.paper.methods import FS, METHODS, Method, Progress

#: Beyond this rms(H)/rms(V) a method has broken down, and longer steps are not tried.
BROKEN = 1.0

#: Prefixes of the names of phase points. PME takes longest, and comes first.
PREFIXES = {liquids.PME: "pme", liquids.MOLECULAR: "molecular"}

#: The file of a phase point.
FILE = "runs.json"


class PhasePoint(NamedTuple):
    """Where runs start: the kind of the liquid, and the number of the point, from 1."""

    kind: str
    number: int

    @property
    def name(self) -> str:
        """For example `pme-3`."""
        return f"{PREFIXES[self.kind]}-{self.number}"


@dataclass(frozen=True)
class WaterSettings:
    """Parameters of the experiment.

    Attributes:
        molecules: number of them; `start.BOX_MOLECULES` come from the project's box.
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
        relax: time between the starts of two runs, ps.
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


class Run(NamedTuple):
    """One method at one step from one phase point.

    Attributes:
        method: name.
        force_step_fs: h/f, fs.
        found: rms(H), rms(V), kJ/mol, and the drift of H, kJ/mol/ps; None if the run did not finish.
    """

    method: str
    force_step_fs: float
    found: tuple[float, float, float] | None

    @property
    def broke_down(self) -> bool:
        return self.found is None or self.found[0] > BROKEN * self.found[1]


def phase_points(settings: WaterSettings) -> list[PhasePoint]:
    """All phase points of an experiment, starting with those that take longest."""
    kinds = [kind for kind in PREFIXES if kind in settings.kinds]
    return [PhasePoint(kind, 1 + i) for kind in kinds for i in range(settings.runs)]


def phase_point(name: str, settings: WaterSettings) -> PhasePoint:
    """The phase point of a name.

    Raises:
        ValueError: the experiment has no such point.
    """
    points = {point.name: point for point in phase_points(settings)}
    if name not in points:
        raise ValueError(f"the phase point must be one of {', '.join(points)}, got {name!r}")
    return points[name]


def make_runs(
    box: start.Box, point: PhasePoint, settings: WaterSettings, directory: Path | None, show: Progress
) -> list[Run]:
    """Runs of all methods and steps from one phase point.

    Args:
        box: the liquid.
        point: where they start.
        settings: of the experiment.
        directory: for the file of runs; runs that it already has are not repeated. None writes nothing.
        show: gets the progress.
    """
    plan = {method: settings.steps_of(method, point) for method in METHODS}
    total, done = sum(1 / step for steps in plan.values() for step in steps), 0.0
    found = {(run.method, run.force_step_fs): run for run in read_runs(directory)}
    show("relaxing", 0.0)
    *_, phase = start.phase_points(
        box, point.kind, settings.cutoffs, settings.temperature, settings.relax, point.number, settings.seed
    )
    runs: list[Run] = []
    for method, steps in plan.items():
        context = _context(box, point.kind, method, settings)
        for step in steps:
            show(f"{method.name}, h/f = {step:g} fs", done / total)
            known = found.get((method.name, step))
            run = known or _run(context, phase, method, step, settings)
            runs.append(run)
            if directory is not None and known is None:
                keep_runs(runs, directory)
            done += 1 / step
            if run.broke_down:
                break
    return runs


def read_runs(directory: Path | None) -> list[Run]:
    """The runs of a phase point that are on disk."""
    if directory is None or not (directory / FILE).exists():
        return []
    rows = json.loads((directory / FILE).read_text())
    return [Run(method, step, None if found is None else tuple(found)) for method, step, found in rows]


def keep_runs(runs: Sequence[Run], directory: Path) -> None:
    """Write the runs of a phase point, for `read_runs`."""
    replace_file(directory / FILE, lambda path: path.write_text(json.dumps(runs, indent=1) + "\n"))


def _context(box: start.Box, kind: str, method: Method, settings: WaterSettings) -> openmm.Context:
    system = liquids.build(kind, box.molecules, box.edge, settings.cutoffs)
    integrator = SIERIntegrator(FS, scheme=method.scheme, rotation=method.rotation)
    return liquids.context(system, integrator, kind)


def _run(
    context: openmm.Context, phase: tuple[np.ndarray, np.ndarray], method: Method, step: float, settings: WaterSettings
) -> Run:
    h = step * method.forces * FS
    integrator = context.getIntegrator()
    integrator.setStepSize(h)
    context.setPositions(phase[0])
    context.setVelocities(phase[1])
    stride = max(1, round(settings.sample_fs * FS / h))
    energies = []
    try:
        # One step before the first energy makes velocities those of rigid bodies to rounding.
        integrator.step(1)
        for i in range(max(3, round(settings.span / (stride * h)) + 1)):
            if i > 0:
                integrator.step(stride)
            kinetic, potential = liquids.energies(context)
            energies.append((kinetic + potential, potential))
    except (openmm.OpenMMException, RigidityError):
        return Run(method.name, step, None)
    H, V = np.array(energies).T
    if not np.isfinite(H).all():
        return Run(method.name, step, None)
    time = h * stride * np.arange(len(H))
    # The paper takes H about its mean.
    return Run(method.name, step, (energy_fluctuation(time, H, window=None), rms(V), energy_drift(time, H)[0]))
