"""The native engine beside the exact one: rms(H)/rms(V) of liquids by scheme, platform and number of substeps.

    python -m studies.native.accuracy [BOX.pdb] [--time 0.3] [--schemes sier4g ...] [--substeps 2 3 5] [--fs 1 2]
        [--on CPU OpenCL:double OpenCL:mixed]

has a line for each run: the exact engine's on the CPU first, then the native engine's with the ratio of both. All runs
of a box start from one phase point. The step is `--fs` times the force evaluations of the scheme. Writes
native-accuracy.json.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import openmm
import pandas as pd

from openmm_sier import SIERIntegrator, prepare_system
from openmm_sier.dynamics.schemes import CATALOGUE, Scheme
from openmm_sier.measure.starts import make_context
from openmm_sier.measure.statistics import rms, slope_and_error
from studies import boxes, records
from studies.command import BoxSettings, chosen, command
from studies.records import Record
from studies.report import SILENT, Report
from studies.units import md

#: Steps of 2 fs before the runs.
EQUILIBRATION = 1000

#: ps between two energies.
INTERVAL = 0.004

COLUMNS = {
    "scheme": "{scheme}",
    "engine": "{engine}",
    "platform": "{platform}",
    "substeps": "{substeps}",
    "fs per force": "{fs_per_force:g}",
    "rms(H)/rms(V)/%": "{percent:.5f}",
    "over the exact engine's": "{ratio:.3f}",
    "drift/kJ/mol/ps": "{drift:+.3f}",
}


@dataclass(frozen=True)
class NativeSettings(BoxSettings):
    """What is compared.

    Attributes:
        schemes: by name; all unless given.
        substeps: of the native engine; the usual ones unless given.
        fs: simulated time per force evaluation.
        on: platforms of the native engine, and after a colon their precision.
        exact_on: platform of the exact engine.
        time: of each run, ps.
    """

    schemes: tuple[str, ...] = ()
    substeps: tuple[int, ...] = ()
    fs: tuple[float, ...] = (1.0, 2.0)
    on: tuple[str, ...] = ("CPU",)
    exact_on: str = "CPU"
    time: float = 0.3
    seed: int = 7


class Started(NamedTuple):
    """A System, a State of it, and its fast force groups."""

    system: openmm.System
    state: openmm.State
    fast: frozenset[int]


def start(settings: NativeSettings) -> Started:
    """A box, equilibrated; hydrogens of solutes are constrained."""
    box = boxes.read(settings, "hbonds")
    fast = prepare_system(box.system).fastForceGroups
    bath = openmm.LangevinMiddleIntegrator(settings.temperature, 5.0, 0.002)
    bath.setRandomNumberSeed(settings.seed)
    bath.setConstraintTolerance(1e-9)
    context = make_context(box.system, bath, "CPU")
    context.setPositions(box.positions)
    openmm.LocalEnergyMinimizer.minimize(context, 10, 100)
    context.setVelocitiesToTemperature(settings.temperature, settings.seed)
    bath.step(EQUILIBRATION)
    return Started(box.system, context.getState(positions=True, velocities=True), fast)


def context_on(place: str, system: openmm.System, integrator: openmm.Integrator) -> openmm.Context:
    """A Context on `place`: a platform, and after a colon its precision."""
    name, _, precision = place.partition(":")
    properties = {"Precision": precision} if precision else {}
    return openmm.Context(system, integrator, openmm.Platform.getPlatformByName(name), properties)


def run(context: openmm.Context, state: openmm.State, step: float, time: float) -> tuple[float, float]:
    """rms(H)/rms(V) in % and drift in kJ/mol/ps, from energies as OpenMM computes them."""
    integrator = context.getIntegrator()
    integrator.setStepSize(step)
    context.setState(state)
    every = max(1, round(INTERVAL / step))
    rows = []
    for _ in range(round(time / (step * every))):
        integrator.step(every)
        found = context.getState(energy=True)
        rows.append([md(found.getTime()), md(found.getPotentialEnergy()), md(found.getKineticEnergy())])
    times, potential, kinetic = np.array(rows).T
    total = potential + kinetic
    return 100 * rms(total) / rms(potential), slope_and_error(times, total).value


def compare(begun: Started, scheme: Scheme, settings: NativeSettings, report: Report) -> list[dict[str, Any]]:
    """Rows of one scheme."""
    cases: list[tuple[str, str, int | None]] = [("exact", settings.exact_on, None)]
    cases += [("native", place, k) for place in settings.on for k in settings.substeps or (None,)]
    exact: dict[float, float] = {}
    rows: list[dict[str, Any]] = []
    for engine, place, k in cases:
        integrator = SIERIntegrator(0.001, scheme, engine=engine, substeps=k, fastForceGroups=begun.fast)
        context = context_on(place, begun.system, integrator)
        for fs in settings.fs:
            error, drift = run(context, begun.state, 1e-3 * fs * scheme.force_evaluations, settings.time)
            row = {"scheme": scheme.name, "fs_per_force": fs, "engine": engine, "platform": place, "substeps": k or ""}
            rows.append(row | {"percent": error, "ratio": error / exact.setdefault(fs, error), "drift": drift})
            report.note(
                records.cell("{scheme} at {fs_per_force:g} fs, {engine} on {platform}: {percent:.5f} %", rows[-1])
            )
        del context, integrator
    return rows


def study(settings: NativeSettings, report: Report = SILENT) -> Record:
    """Compare the engines, and write native-accuracy.json."""
    schemes = chosen(settings.schemes, CATALOGUE, "scheme")
    begun = start(settings)
    rows = pd.DataFrame([row for scheme in schemes for row in compare(begun, scheme, settings, report)])
    title = f"{settings.box.stem}, {settings.time:g} ps"
    report.table(records.table(title, rows, COLUMNS, left=4))
    return Record(settings.recorded(), {"rows": rows}, {}).write(settings.out / "native-accuracy.json")


main = command(NativeSettings, study, __doc__, __name__)
