"""What an independent sample of a solvated dipeptide costs with hybrid Monte Carlo and with Langevin dynamics.

    python -m studies.hmc.samples --method hmc --step 2 --length 120 --time 80 --out samples
    python -m studies.hmc.samples --method hmc --length 30 --friction 2 --time 80 --out samples
    python -m studies.hmc.samples --method langevin --step 4 --time 80 --out samples
    python -m studies.hmc.samples --table samples/*.json       runs with several seeds are pooled
    for method in hmc langevin wrong; do python -m studies.hmc.samples --method $method --held --out held; done

Constant pressure of 1 bar; steps are in fs for each force evaluation, trials are of SIER4G. `langevin` is OpenMM's
LangevinMiddleIntegrator with its MonteCarloBarostat, and a friction of 2/ps unless another is given. An energy counts
as a force. `--held` compares the dihedrals in one of their basins, at constant volume: phi and psi turn too rarely at
297 K for anything else. `wrong` is LangevinMiddle with forces that are too weak, which must show there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import process_time
from typing import Any, ClassVar, Literal

import numpy as np
import openmm
import pandas as pd
from openmm import unit

from openmm_sier import SIER4G, SIERHMCIntegrator
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.statistics import inefficiency_and_error
from openmm_sier.measure.statistics import Estimate, mean_and_error, pooled
from studies import records
from studies.command import command
from studies.hmc import solutes
from studies.hmc.dihedrals import backbone, dihedral
from studies.hmc.solutes import SoluteSettings, Solution
from studies.records import Record
from studies.report import SILENT, Report
from studies.units import md

#: fs: between two attempts to change the volume, and between two samples at least.
EVERY = 120.0

#: Friction of Langevin dynamics, 1/ps, unless another is given.
FRICTION = 2.0

#: ps between two records of a run that goes on.
SAVED = 5.0

#: By which the forces of `wrong` are multiplied.
WEAKER = 0.6

#: Where `--held` holds phi and psi, rad, and how firmly, kJ/mol.
CENTRES, FIRMNESS = (-1.3, 2.5), 50.0

#: Components of the box's dipole moment, e nm.
DIPOLE = ("dipole_x", "dipole_y", "dipole_z")

ANGLES = ("phi", "psi")

#: The cosine of psi tells alpha from beta, the sine of phi both from the left-handed helix; `about` are cosines of the
#: distance from where angles are held.
OBSERVED = ("potential", "volume", "cos psi", "sin psi", "cos phi", "sin phi", "about phi", "about psi")

COLUMNS = {
    "run": "{label}",
    "ps": "{time:.0f}",
    "accepted": "{accepted:.3f}",
    "V, kJ/mol": "{potential_text}",
    "volume, nm³": "{volume_text}",
    "<cos psi>": "{cos psi_text}",
    "<sin psi>": "{sin psi_text}",
    "<cos phi>": "{cos phi_text}",
    "<sin phi>": "{sin phi_text}",
    "about phi": "{about phi_text}",
    "about psi": "{about psi_text}",
}

COSTS = {
    "run": "{label}",
    "ms per force": "{milliseconds:.1f}",
    "forces for an independent V": "{potential_cost_text}",
    "volume": "{volume_cost_text}",
    "dipole": "{dipole_cost_text}",
    "cos psi": "{cos psi_cost_text}",
    "sin phi": "{sin phi_cost_text}",
}


@dataclass(frozen=True)
class SampleSettings(SoluteSettings):
    """What is run or read.

    Attributes:
        table: records of runs to be read, in place of a run.
        method: of the run.
        step: fs for each force evaluation.
        length: of a trial, fs, rounded to a whole number of steps.
        friction: 1/ps; hybrid Monte Carlo draws momenta anew without it.
        held: whether torsions hold phi and psi in one basin, at constant volume.
        time: of the run, ps.
        settling: ps before it.
        skip: ps to leave out at the beginning of each run, for the table.
    """

    box: Path = Path("systems/dipeptide.pdb")
    cutoff: float = 0.7
    table: tuple[Path, ...] = ()
    method: Literal["hmc", "langevin", "wrong"] = "hmc"
    step: float = 2.0
    length: float = 120.0
    friction: float | None = None
    held: bool = False
    time: float = 100.0
    settling: float = 5.0
    skip: float = 0.0

    ANY_SIGN: ClassVar[tuple[str, ...]] = ("skip",)

    @property
    def name(self) -> str:
        """Of its file."""
        length = f"-{self.length:g}" if self.method == "hmc" else ""
        held = "-held" if self.held else ""
        return f"{self.method}-{self.step:g}{length}-{self.friction or 0:g}{held}-{self.seed}"

    @property
    def label(self) -> str:
        """The run in a few words."""
        kind = {"langevin": "LangevinMiddle", "wrong": "wrong on purpose"}.get(self.method, "HMC")
        length = f", trials of {self.length:g} fs" if self.method == "hmc" else ""
        momenta = f", friction {self.friction:g}/ps" if self.friction else ""
        return f"{kind}, {self.step:g} fs{length}{momenta}{', held' if self.held else ''}"


def study(settings: SampleSettings, report: Report = SILENT) -> None:
    """Make a run, or tables of runs, which are written to samples.json."""
    if not settings.table:
        run(settings, report)
        return
    rows = table(settings.table, settings.skip)
    means = records.with_text(rows, *OBSERVED)
    report.table(records.table("Means at 1 bar", means, COLUMNS))
    costs = records.with_text(rows, *(name for name in rows if name.endswith("_cost")))
    report.table(records.table("Cost of an independent sample", costs, COSTS))
    Record(settings.recorded(), {"rows": rows}, {}).write(settings.out / "samples.json")


# --- runs ---


def hold(solution: Solution) -> None:
    """Add torsions that hold phi and psi in one basin."""
    for atoms, centre in zip(backbone(solution.topology), CENTRES, strict=True):
        held = openmm.CustomTorsionForce(f"{FIRMNESS}*(1 - cos(theta - {centre}))".replace("- -", "+ "))
        held.addTorsion(*atoms, [])
        solution.system.addForce(held)


def wrong_integrator(settings: SampleSettings) -> openmm.CustomIntegrator:
    """LangevinMiddle with kicks that are too weak. A `Scheme` whose kicks do not sum to 1 cannot be made."""
    made = openmm.CustomIntegrator(1e-3 * settings.step)
    kept = math.exp(-1e-3 * settings.step * (settings.friction or FRICTION))
    made.addGlobalVariable("kept", kept)
    made.addGlobalVariable("noise", math.sqrt((1 - kept**2) * GAS_CONSTANT * settings.temperature))
    made.addPerDofVariable("free", 0)
    made.addUpdateContextState()
    made.addComputePerDof("v", f"v + {WEAKER}*dt*f/m")
    made.addConstrainVelocities()
    made.addComputePerDof("x", "x + 0.5*dt*v")
    made.addComputePerDof("v", "kept*v + noise*gaussian/sqrt(m)")
    made.addComputePerDof("x", "x + 0.5*dt*v")
    made.addComputePerDof("free", "x")
    made.addConstrainPositions()
    made.addComputePerDof("v", "v + (x - free)/dt")
    return made


def integrator_of(settings: SampleSettings, system: openmm.System) -> tuple[openmm.Integrator, int]:
    """An integrator, and its number of steps from one sample to the next."""
    friction, temperature = settings.friction or FRICTION, settings.temperature
    if settings.method != "hmc":
        every = round(EVERY / settings.step)
        if not settings.held:
            system.addForce(openmm.MonteCarloBarostat(1 * unit.bar, temperature * unit.kelvin, every))
        if settings.method == "wrong":
            return wrong_integrator(settings), every
        return openmm.LangevinMiddleIntegrator(temperature, friction, 1e-3 * settings.step), every
    step = settings.step * SIER4G.force_evaluations
    steps = max(1, round(settings.length / step))
    every = max(1, round(EVERY / (step * steps)))
    pressure = None if settings.held else 1.0
    made = SIERHMCIntegrator(temperature, 1e-3 * step, SIER4G, steps, settings.friction, pressure, every)
    return made, every


def run(settings: SampleSettings, report: Report = SILENT) -> Record:
    """One run, in a file of its own, which is written as it goes on."""
    solution = solutes.read(settings)
    if settings.held:
        hold(solution)
    integrator, every = integrator_of(settings, solution.system)
    integrator.setRandomNumberSeed(settings.seed)
    context = solutes.context(solution, integrator, settings)
    interval = 1e3 * every * md(integrator.getStepSize())
    observe = Observer(solution)
    integrator.step(round(1e3 * settings.settling / interval) * every)
    is_hmc = isinstance(integrator, SIERHMCIntegrator)
    if is_hmc:
        integrator.resetStatistics()
    before, begun = getattr(integrator, "forceEvaluations", 0), process_time()

    def sample() -> dict[str, float]:
        integrator.step(every)
        return observe(context)

    def notes(done: int) -> dict[str, Any]:
        steps = getattr(integrator, "forceEvaluations", before + done * every) - before
        # A trial takes an energy, and a move of the volume another one.
        forces = steps + (0 if settings.held else done) + (integrator.trials if is_hmc else 0)
        accepted = integrator.acceptanceRate if is_hmc else None
        cost = {"forces": forces / done, "milliseconds": 1e3 * (process_time() - begun) / forces}
        return {"interval": interval, "accepted": accepted, **cost}

    count, saved = round(1e3 * settings.time / interval), max(1, round(1e3 * SAVED / interval))
    return solutes.kept_series(settings, settings.name, settings.label, count, saved, sample, notes, report)


class Observer:
    """Takes a sample of a Context."""

    def __init__(self, solution: Solution) -> None:
        nonbonded = next(f for f in solution.system.getForces() if isinstance(f, openmm.NonbondedForce))
        particles = range(solution.system.getNumParticles())
        self.charges = np.array([md(nonbonded.getParticleParameters(i)[0]) for i in particles])
        self.phi, self.psi = backbone(solution.topology)

    def __call__(self, context: openmm.Context) -> dict[str, float]:
        state = context.getState(positions=True, energy=True)
        positions = md(state.getPositions(asNumpy=True))
        found = {"potential": md(state.getPotentialEnergy()), "volume": md(state.getPeriodicBoxVolume())}
        found |= {"phi": dihedral(positions, self.phi), "psi": dihedral(positions, self.psi)}
        return found | dict(zip(DIPOLE, self.charges @ positions, strict=True))


# --- tables ---


def samples_of(record: Record, skip: float = 0.0) -> pd.DataFrame:
    """The samples of a run after a time to be skipped, ps, with the cosines and sines of the angles."""
    samples = record.tables["samples"].iloc[round(1e3 * skip / record.notes["interval"]) :]
    angles = {f"{f.__name__} {angle}": f(samples[angle]) for angle in ANGLES for f in (np.cos, np.sin)}
    about = {f"about {angle}": np.cos(samples[angle] - centre) for angle, centre in zip(ANGLES, CENTRES, strict=True)}
    return samples.assign(**angles, **about)


def table(files: Sequence[Path], skip: float = 0.0) -> pd.DataFrame:
    """A row for each kind of run; runs that differ in their seeds alone are pooled."""
    rows = []
    for label, several in solutes.by_label(files).items():
        tables = [samples_of(record, skip) for record in several]
        lengths = np.array([len(samples) for samples in tables])
        first = several[0].notes
        row: dict[str, Any] = {"label": label, "time": 1e-3 * first["interval"] * lengths.sum()}
        row["milliseconds"] = np.average([record.notes["milliseconds"] for record in several], weights=lengths)
        accepted = [record.notes["accepted"] for record in several]
        row["accepted"] = math.nan if None in accepted else np.average(accepted, weights=lengths)
        for name in OBSERVED:
            means = [mean_and_error(samples[name].to_numpy()) for samples in tables]
            row[name], row[f"{name}_error"], _ = pooled(means)
        costs = {name: [cost(samples[[name]], first["forces"]) for samples in tables] for name in OBSERVED}
        costs["dipole"] = [cost(samples[list(DIPOLE)], first["forces"]) for samples in tables]
        for name, found in costs.items():
            row[f"{name}_cost"], row[f"{name}_cost_error"], _ = pooled(found)
        rows.append(row)
    return pd.DataFrame(rows)


def cost(samples: pd.DataFrame, forces: float) -> Estimate:
    """Forces for an independent sample; the mean over columns, which are components of one vector."""
    found = np.array([inefficiency_and_error(samples[name].to_numpy()) for name in samples])
    return Estimate(forces * float(found[:, 0].mean()), forces * float(np.linalg.norm(found[:, 1])) / len(found))


main = command(SampleSettings, study, __doc__, __name__)
