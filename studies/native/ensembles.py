"""Temperatures and density with the native engine beside the exact one, at 2 fs per force evaluation.

    python -m studies.native.ensembles [--ensemble npt] [--engines native exact] [--molecules 125] [--time 100]
        [--friction 50] [--on CPU] [--seed 5]

SIER4G with a heat bath; in npt at 1 bar, by OpenMM's MonteCarloBarostat with the native engine and by `pressure=` with
the exact one. T_trans, T_rot and the density have standard errors. Writes native-ensembles.json.

A box of 125 molecules is as good as a large one here: errors depend on molecules times simulated time, and both
engines have the same box.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import openmm
import pandas as pd
from openmm import unit

from openmm_sier import SIER4G, SIERLangevinIntegrator
from openmm_sier.measure.statistics import mean_and_error
from openmm_sier.observe.conservation import density
from studies import records
from studies.command import command
from studies.native.accuracy import NativeSettings, context_on, start
from studies.records import Record
from studies.report import SILENT, Report
from studies.units import md

#: ps: the step, and what is left out at the beginning; steps between two moves of the volume.
STEP, SETTLING, MOVES = 0.006, 2.0, 5

TOLERANCE = 1e-4

COLUMNS = {
    "engine": "{engine}",
    "T_trans/K": "{translation:.2f} ± {translation_error:.2f}",
    "T_rot/K": "{rotation:.2f} ± {rotation_error:.2f}",
    "T_rot - T_trans/K": "{difference:.2f} ± {difference_error:.2f}",
    "g/cm³": "{density:.4f} ± {density_error:.4f}",
}


@dataclass(frozen=True)
class EnsembleSettings(NativeSettings):
    """What is run.

    Attributes:
        ensemble: of the runs.
        engines: that make them.
        friction: of the bath, 1/ps.
    """

    ensemble: Literal["nvt", "npt"] = "nvt"
    engines: tuple[Literal["native", "exact"], ...] = ("native", "exact")
    friction: float = 50.0
    molecules: int | None = 125
    time: float = 100.0
    seed: int = 5


def _run(engine: str, settings: EnsembleSettings) -> dict[str, Any]:
    system, state, _ = start(replace(settings, seed=NativeSettings.seed), TOLERANCE)
    pressure = None
    if settings.ensemble == "npt" and engine == "native":
        system.addForce(openmm.MonteCarloBarostat(1 * unit.bar, settings.temperature, MOVES))
    elif settings.ensemble == "npt":
        pressure = 1 * unit.bar
    integrator = SIERLangevinIntegrator(
        settings.temperature,
        settings.friction,
        STEP,
        SIER4G,
        engine=engine,
        pressure=pressure,
        barostatInterval=MOVES,
    )
    integrator.setRandomNumberSeed(settings.seed)
    context = context_on(settings.on[0], system, integrator)
    context.setState(state)
    integrator.step(round(SETTLING / STEP) * (10 if settings.ensemble == "npt" else 1))
    mass = sum(md(system.getParticleMass(i)) for i in range(system.getNumParticles()))
    rows = []
    for _ in range(round(settings.time / STEP)):
        integrator.step(1)
        found = integrator.computeTemperatures()
        volume = md(context.getState().getPeriodicBoxVolume())
        rows.append([found.translation, found.rotation, found.rotation - found.translation, density(mass, volume)])
    row: dict[str, Any] = {"engine": engine}
    for name, values in zip(("translation", "rotation", "difference", "density"), np.array(rows).T, strict=True):
        row[name], row[f"{name}_error"], _ = mean_and_error(values)
    return row


def study(settings: EnsembleSettings, report: Report = SILENT) -> Record:
    """Run the engines, and write native-ensembles.json."""
    rows = pd.DataFrame([_run(engine, settings) for engine in settings.engines])
    report.table(records.table(f"{settings.ensemble.upper()}, {settings.time:g} ps", rows, COLUMNS))
    return Record(settings.recorded(), {"rows": rows}, {}).write(settings.out / "native-ensembles.json")


main = command(EnsembleSettings, study, __doc__, __name__)
