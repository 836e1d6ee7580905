"""Averages of liquid water at 1 bar by hybrid Monte Carlo and by Langevin dynamics, and what a sample costs.

    python -m studies.hmc.liquid run --method hmc --step 2 --time 400 --out hmc-2
    python -m studies.hmc.liquid run --method sier2 --step 4 --time 400 --out sier2-4
    python -m studies.hmc.liquid run --method langevin --step 0.25 --time 400 --out langevin-0.25
    python -m studies.hmc.liquid table */liquid.json        runs with several seeds are pooled

Steps are in fs for each force evaluation. `hmc` and `sier4g` make steps of SIER4G, `langevin` is OpenMM's
LangevinMiddleIntegrator with its MonteCarloBarostat. All have the same System: PME with a cut-off of 0.7 nm, so that
many samples can be afforded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Literal

import numpy as np
import openmm
import pandas as pd
from openmm import app, unit
from tyro.conf import Positional

from openmm_sier import SIER2, SIER4G, RigidBodies, SIERHMCIntegrator, SIERLangevinIntegrator, balance_pme
from openmm_sier.dynamics.statistics import inefficiency
from openmm_sier.measure.starts import make_context
from openmm_sier.measure.statistics import Estimate, mean_and_error
from openmm_sier.observe.conservation import density
from studies import records
from studies.command import SYSTEMS, Settings, command
from studies.records import Record
from studies.report import SILENT, Report
from studies.sampling import observe
from studies.units import md

CUTOFF, TOLERANCE = 0.7, 1e-4

#: ps: from one sample to the next, which is the length of a trial; what is left out at the beginning.
EVERY, SETTLING = 0.12, 10.0

#: Samples between two records of a run that goes on.
SAVED = 17

COLUMNS = {
    "run": "{method} {step:g} fs",
    "ps": "{time:.0f}",
    "accepted": "{accepted:.3f}",
    "V, kJ/mol": "{potential_text}",
    "T_trans, K": "{translation_text}",
    "T_rot, K": "{rotation_text}",
    "g/cm³": "{density_text}",
    "forces per independent V": "{forces_per_potential:.0f}",
    "per dipole": "{forces_per_dipole:.0f}",
}


@dataclass(frozen=True)
class LiquidSettings(Settings):
    """What is run or read.

    Attributes:
        what: whether to make a run, or a table of runs.
        files: records of runs, for the table.
        method: of the run.
        step: fs for each force evaluation.
        time: of the run, ps.
        friction: 1/ps.
        temperature: K.
        platform: of OpenMM; None takes the fastest.
        box: of TIP3P.
    """

    what: Positional[Literal["run", "table"]] = "run"
    files: Positional[tuple[Path, ...]] = ()
    method: Literal["hmc", "sier4g", "sier2", "langevin"] = "hmc"
    step: float = 2.0
    time: float = 400.0
    friction: float = 2.0
    temperature: float = 297.0
    platform: str | None = None
    box: Path = SYSTEMS / "tip3p-512.pdb"


def study(settings: LiquidSettings, report: Report = SILENT) -> None:
    """Make a run, or a table of runs."""
    if settings.what == "run":
        run(settings)
    else:
        rows = records.with_text(table(settings.files), "potential", "translation", "rotation", "density")
        report.table(records.table("Liquid water at 1 bar", rows, COLUMNS))


def water(path: Path) -> tuple[app.PDBFile, openmm.System]:
    """A box of TIP3P."""
    pdb = app.PDBFile(str(path))
    system = app.ForceField("amber14/tip3p.xml").createSystem(
        pdb.topology,
        nonbondedMethod=app.PME,
        nonbondedCutoff=CUTOFF,
        switchDistance=CUTOFF - 0.15,
        ewaldErrorTolerance=TOLERANCE,
        removeCMMotion=False,
    )
    balance_pme(system)
    return pdb, system


def integrator_of(settings: LiquidSettings, system: openmm.System) -> tuple[openmm.Integrator, int]:
    """An integrator at 1 bar, and its number of steps in a sample."""
    temperature, friction = settings.temperature, settings.friction
    if settings.method == "langevin":
        step = settings.step / 1000
        steps = round(EVERY / step)
        system.addForce(openmm.MonteCarloBarostat(1 * unit.bar, temperature * unit.kelvin, steps))
        return openmm.LangevinMiddleIntegrator(temperature, friction, step), steps
    scheme = SIER2 if settings.method == "sier2" else SIER4G
    step = settings.step / 1000 * scheme.force_evaluations
    steps = round(EVERY / step)
    if settings.method == "hmc":
        return SIERHMCIntegrator(temperature, step, scheme, steps, pressure=1), 1
    return SIERLangevinIntegrator(temperature, friction, step, scheme, pressure=1, barostatInterval=steps), steps


def run(settings: LiquidSettings) -> Record:
    """One run, in liquid.json; results so far are saved every 2 ps."""
    pdb, system = water(settings.box)
    bodies = RigidBodies.from_system(system, pdb.topology)
    nonbonded = next(force for force in system.getForces() if isinstance(force, openmm.NonbondedForce))
    charges = np.array([md(nonbonded.getParticleParameters(i)[0]) for i in range(system.getNumParticles())])
    integrator, steps = integrator_of(settings, system)
    integrator.setRandomNumberSeed(settings.seed)
    context = make_context(system, integrator, settings.platform)
    context.setPositions(pdb.positions)
    context.setVelocitiesToTemperature(settings.temperature, settings.seed)
    integrator.step(round(SETTLING / EVERY) * steps)
    if settings.method == "hmc":
        integrator.resetStatistics()
    rows, begun = [], perf_counter()
    for done in range(1, round(settings.time / EVERY) + 1):
        integrator.step(steps)
        dipole = charges @ md(context.getState(positions=True).getPositions(asNumpy=True))
        sample = observe(context, bodies, False)
        rows.append(sample._asdict() | {"density": density(bodies.masses.sum(), sample.volume)})
        rows[-1] |= dict(zip(DIPOLE, dipole, strict=True))
        if done % SAVED == 0:
            accepted = integrator.acceptanceRate if settings.method == "hmc" else None
            notes = {"accepted": accepted, "seconds": perf_counter() - begun}
            Record(settings.recorded(), {"rows": pd.DataFrame(rows)}, notes).write(settings.out / "liquid.json")
    return records.read(settings.out / "liquid.json")


#: Components of the box's dipole moment, e nm.
DIPOLE = ("dipole_x", "dipole_y", "dipole_z")


def pooled_mean(series: Sequence[pd.Series]) -> Estimate:
    """Mean and standard error over all samples of independent runs, from the number of independent samples in each."""
    weights = np.array([len(values) for values in series]) / sum(len(values) for values in series)
    means = [mean_and_error(values.to_numpy()) for values in series]
    error = np.linalg.norm(weights * [mean.error for mean in means])
    return Estimate(float(weights @ [mean.value for mean in means]), float(error))


def table(files: Sequence[Path]) -> pd.DataFrame:
    """A row for each method and step; runs that differ in their seeds are pooled."""
    runs: dict[tuple[str, float], list[Record]] = {}
    for path in files:
        record = records.read(path)
        runs.setdefault((record.settings["method"], record.settings["step"]), []).append(record)
    rows = []
    for (method, step), several in sorted(runs.items()):
        tables = [record.tables["rows"] for record in several]
        lengths = [frame["time"].iloc[-1] - frame["time"].iloc[0] for frame in tables]
        accepted = [record.notes["accepted"] for record in several]
        row = {"method": method, "step": step, "time": sum(lengths)}
        row["accepted"] = np.nan if None in accepted else np.average(accepted, weights=lengths)
        for name in ("potential", "translation", "rotation", "density"):
            row[name], row[f"{name}_error"], _ = pooled_mean([frame[name] for frame in tables])
        forces = EVERY * 1000 / step
        row["forces_per_potential"] = forces * _inefficiency(tables, "potential")
        row["forces_per_dipole"] = forces * np.mean([_inefficiency(tables, name) for name in DIPOLE])
        rows.append(row)
    return pd.DataFrame(rows)


def _inefficiency(tables: Sequence[pd.DataFrame], name: str) -> float:
    """Samples per independent sample, averaged over the runs by their lengths."""
    return float(np.average([inefficiency(frame[name].to_numpy()) for frame in tables], weights=list(map(len, tables))))


main = command(LiquidSettings, study, __doc__, __name__)
