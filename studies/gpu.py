"""What a step costs on a GPU, beside OpenMM's integrators, with averages that would show a program that is wrong.

    python -m studies.gpu [--platform CUDA] [--benchmarks openmm/examples/benchmarks] [--boxes dhfr water-4096]

takes boxes of water and DHFR, or those of OpenMM's own benchmark where its folder is given (apoa1, cellulose and stmv
need it), in mixed precision. LangevinMiddle at 4 fs is as that benchmark has it: bonds to hydrogen constrained,
hydrogens of 1.5 dalton, 1/ps. Prepared Systems have hydrogens of 4 dalton, those of solutes 3. Steps are called by
tens, as `Simulation` calls them, all methods take turns, and times are those of the wall. In the boxes of `--averages`
the potential energy, the temperatures of water, and the energies of bonds, angles and torsions are averaged over a run,
and set beside those of LangevinMiddle at 1 fs. Writes gpu.json.
"""

from __future__ import annotations

import copy
import math
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import openmm
import pandas as pd
from openmm import unit

from openmm_sier.analysis.statistics import mean_and_error
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.constraints.graph import joined
from openmm_sier.dynamics.schemes import SIER4G
from openmm_sier.inputs.starts import make_context
from openmm_sier.system import tables
from studies import gpu_boxes, text
from studies.bench.timing import median_and_error, turns
from studies.command import Settings, command
from studies.contestants import (
    MIDDLE_IN_RIGID_WATER,
    SEVERAL_STEPS,
    Bath,
    Contestant,
    at_constant_energy,
    in_bath,
    middle,
    verlet,
)
from studies.gpu_boxes import GpuBox
from studies.records import Record
from studies.report import SILENT, Report

#: What ratios are taken over.
REFERENCE = "LangevinMiddle, 4 fs"

#: What averages are compared with.
SHORT_STEPS = "LangevinMiddle, 1 fs"

#: Of baths, 1/ps.
FRICTION = 5.0

#: Steps in one call of `step`, as `Simulation` makes them.
CALL = 10

#: Time between two samples, ps.
EVERY = 0.2

#: Forces whose energies are averaged, by the names of the columns.
BONDED = {
    "bonds": openmm.HarmonicBondForce,
    "angles": openmm.HarmonicAngleForce,
    "torsions": openmm.PeriodicTorsionForce,
}

SPEEDS = {"box": "{box}", "method": "{method}", "us a step": "{microseconds:.0f}", "ns/day": "{ns_per_day:.0f}"}
SPEEDS |= {f"over {REFERENCE}": "{over:.2f} ± {over_error:.2f}"}


@dataclass(frozen=True)
class GpuSettings(Settings):
    """What is measured.

    Attributes:
        boxes: by name, see `gpu_boxes.named`.
        averages: boxes in which averages are compared too.
        benchmarks: the folder examples/benchmarks of OpenMM's sources.
        platform: of OpenMM; None takes the fastest.
        temperature: K.
        rounds: in which all methods take their turns.
        turn: seconds of a turn.
        time: of runs for averages, ps.
        settle: before these, ps.
    """

    boxes: tuple[str, ...] = ("water-4096", "dhfr", "water-32768")
    averages: tuple[str, ...] = ("water-4096", "dhfr")
    benchmarks: Path | None = None
    platform: str | None = None
    temperature: float = 300.0
    rounds: int = 5
    turn: float = 0.5
    time: float = 100.0
    settle: float = 10.0


def methods(has_solute: bool) -> list[Contestant]:
    """Return all methods for a box; the bath of LangevinMiddle at 4 fs is that of OpenMM's benchmark."""
    long_steps = Contestant("SIER2", 9, in_bath, hydrogens=4.0, prepared=True)
    found = [
        Contestant("Verlet", 2, verlet, has_bath=False),
        Contestant("LangevinMiddle", 4, middle, friction=1.0),
        Contestant("LangevinMiddle", 1, middle, hydrogens=4.0, prepared=True),
    ]
    if has_solute:
        found.append(Contestant("LangevinMiddle", 5, middle, hydrogens=3.0, friction=1.0))
        found.append(replace(SEVERAL_STEPS, friction=1.0))
    else:
        found.append(replace(MIDDLE_IN_RIGID_WATER, detail="heavy hydrogens"))
    found.append(long_steps)
    if has_solute:
        found.append(replace(long_steps, make=partial(in_bath, substeps=2), detail="three inner steps"))
    found.append(replace(long_steps, make=partial(in_bath, countsHeat=True), detail="heat counted"))
    steady = partial(at_constant_energy, scheme=SIER4G)
    found.append(Contestant("SIER4G", 4, steady, SIER4G.force_evaluations, prepared=True, has_bath=False))
    return found


def start(box: GpuBox, settings: GpuSettings) -> openmm.State:
    """Return positions, velocities and box after a minimization and 1 ps of LangevinMiddle at 2 fs."""
    integrator = openmm.LangevinMiddleIntegrator(settings.temperature, 5.0, 0.002)
    context = make_context(copy.deepcopy(box.system), integrator, settings.platform)
    if box.vectors is not None:
        context.setPeriodicBoxVectors(*box.vectors)
    context.setPositions(box.positions)
    context.applyConstraints(1e-6)
    openmm.LocalEnergyMinimizer.minimize(context, 10, 50)
    context.setVelocitiesToTemperature(settings.temperature, settings.seed)
    integrator.step(500)
    return context.getState(positions=True, velocities=True)


# --- speed ---


def run(context: openmm.Context, steps: int) -> None:
    """Make steps by tens, and wait for the GPU."""
    for _ in range(0, steps, CALL):
        context.getIntegrator().step(CALL)
    context.getState(positions=True)


def speeds(
    box: GpuBox, contexts: dict[str, openmm.Context], chosen: list[Contestant], settings: GpuSettings
) -> list[dict]:
    """Return a row for each timed method."""
    timed = [method for method in chosen if method.name != SHORT_STEPS]
    counts = {method.name: _steps_of_turn(contexts[method.name], settings.turn) for method in timed}

    def seconds(name: str) -> float:
        begin = time.perf_counter()
        run(contexts[name], counts[name])
        return (time.perf_counter() - begin) / counts[name]

    found = turns({method.name: partial(seconds, method.name) for method in timed}, settings.rounds)
    rates = {method.name: method.step / found[method.name] for method in timed}
    rows = []
    for method in timed:
        over, error, _ = median_and_error(rates[method.name] / rates[REFERENCE])
        middle = float(np.median(found[method.name]))
        rows.append(
            {
                "box": box.name,
                "atoms": box.system.getNumParticles(),
                "method": method.name,
                "engine": getattr(contexts[method.name].getIntegrator(), "engine", ""),
                "microseconds": 1e6 * middle,
                # 86400 s a day, 1e6 fs a ns.
                "ns_per_day": 0.0864 * method.step / middle,
                "over": over,
                "over_error": 0.0 if method.name == REFERENCE else error,
            }
        )
    return rows


def _steps_of_turn(context: openmm.Context, seconds: float) -> int:
    run(context, CALL)
    begin = time.perf_counter()
    run(context, CALL)
    return CALL * max(1, math.ceil(seconds / (time.perf_counter() - begin)))


# --- averages ---


class Observed:
    """Energies and temperatures of a Context of a box.

    Bonded energies are those of another Context, without the Forces that take time.
    """

    def __init__(self, system: openmm.System, has_solute: bool, settings: GpuSettings):
        self._masses = tables.masses(system)
        self._waters = _waters(system)
        self._bonded = _bonded_context(system, settings) if has_solute else None

    def sample(self, context: openmm.Context) -> dict[str, float]:
        """Return what is averaged, energies in kJ/mol and temperatures in K."""
        context.applyVelocityConstraints(1e-6)
        state = context.getState(positions=True, velocities=True, energy=True)
        found = {"potential": state.getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole)}
        velocities = state.getVelocities(asNumpy=True).value_in_unit(unit.nanometer / unit.picosecond)
        found |= self._temperatures(velocities)
        if self._bonded is not None:
            self._bonded.setPositions(state.getPositions(asNumpy=True))
            for group, name in enumerate(BONDED):
                energy = self._bonded.getState(energy=True, groups=1 << group).getPotentialEnergy()
                found[name] = energy.value_in_unit(unit.kilojoule_per_mole)
        return found

    def _temperatures(self, velocities: np.ndarray) -> dict[str, float]:
        """Return those of translation and rotation of water."""
        masses, velocities = self._masses[self._waters], velocities[self._waters]
        whole = masses.sum(axis=1)
        centres = np.einsum("na,nax->nx", masses, velocities) / whole[:, None]
        moving = 0.5 * float(whole @ (centres**2).sum(axis=1))
        kinetic = 0.5 * float(np.einsum("na,nax,nax->", masses, velocities, velocities))
        freedoms = 3 * len(self._waters) * GAS_CONSTANT
        return {"translation": 2 * moving / freedoms, "rotation": 2 * (kinetic - moving) / freedoms}


def _bonded_context(system: openmm.System, settings: GpuSettings) -> openmm.Context:
    """Return a Context of the bonded Forces alone, each in the group of its place in `BONDED`."""
    bonded = openmm.XmlSerializer.clone(system)
    for index in reversed(range(bonded.getNumForces())):
        if not isinstance(bonded.getForce(index), tuple(BONDED.values())):
            bonded.removeForce(index)
    for force in bonded.getForces():
        force.setForceGroup(list(BONDED.values()).index(type(force)))
    return make_context(bonded, openmm.VerletIntegrator(0.001), settings.platform)


def _waters(system: openmm.System) -> np.ndarray:
    """Return the atoms of molecules of three atoms that three constraints hold, (m, 3)."""
    pairs = tables.constraints(system).pairs
    molecules = joined(system.getNumParticles(), pairs)
    numbers, sizes = np.unique(molecules, return_counts=True)
    held = np.bincount(molecules[pairs[:, 0]], minlength=numbers.max() + 1)
    chosen = numbers[(sizes == 3) & (held[numbers] == 3)]
    atoms = np.flatnonzero(np.isin(molecules, chosen))
    return atoms[np.argsort(molecules[atoms], kind="stable")].reshape(-1, 3)


def averages(box: GpuBox, context: openmm.Context, method: Contestant, settings: GpuSettings) -> dict[str, Any]:
    """Return a row of means and their errors over a run of a method."""
    observed = Observed(context.getSystem(), box.has_solute, settings)
    between = round(1000 * EVERY / method.step / CALL) * CALL or CALL
    run(context, round(1000 * settings.settle / method.step / CALL) * CALL)
    samples = []
    for _ in range(round(1000 * settings.time / method.step / between)):
        run(context, between)
        samples.append(observed.sample(context))
    row: dict[str, Any] = {"box": box.name, "method": method.name}
    for name, series in pd.DataFrame(samples).items():
        row[str(name)], row[f"{name}_error"], _ = mean_and_error(series.to_numpy())
    return row


# --- the study ---


def measured(name: str, settings: GpuSettings, report: Report) -> tuple[list[dict], list[dict]]:
    """Return the rows of speeds and of averages of a box."""
    box = gpu_boxes.named(name, settings.benchmarks)
    report.note(f"{name}: {box.system.getNumParticles()} atoms")
    state, bath = start(box, settings), Bath(settings.temperature, FRICTION)
    with_averages = name in settings.averages
    chosen = [method for method in methods(box.has_solute) if method.name != SHORT_STEPS or with_averages]
    contexts = {}
    for method in chosen:
        system = copy.deepcopy(box.system)
        method.fit(system)
        contexts[method.name] = make_context(system, method.integrator(bath), settings.platform)
        contexts[method.name].setState(state)
        # Masses differ from those of the start.
        contexts[method.name].setVelocitiesToTemperature(settings.temperature, settings.seed)
    timings = speeds(box, contexts, chosen, settings)
    for row in timings:
        report.note(text.cell("{box}: {method}, {microseconds:.0f} µs a step, {over:.2f}", row))
    means = []
    for method in chosen:
        if with_averages and method.has_bath:
            means.append(averages(box, contexts[method.name], method, settings))
            report.note(text.cell("{box}: {method}, V {potential:.0f} ± {potential_error:.0f} kJ/mol", means[-1]))
    return timings, means


def tell(record: Record, report: Report) -> None:
    """Report speeds and averages."""
    report.table("Speed", text.table(record.tables["speeds"], SPEEDS))
    if "averages" in record.tables:
        means = record.tables["averages"]
        names = [name for name in means if f"{name}_error" in means]
        columns = {"box": "{box}", "method": "{method}"}
        columns |= {name: f"{{{name}:.6g}} ± {{{name}_error:.2g}}" for name in names}
        report.table("Averages, kJ/mol and K", text.table(means, columns))


def study(settings: GpuSettings, report: Report = SILENT) -> Record:
    """Measure, and write gpu.json after each box.

    Raises:
        ValueError: a box is unknown, or its files are missing.
        ImportError: dhfr is to be measured without openmmtools and without `benchmarks`.
    """
    timings: list[dict] = []
    means: list[dict] = []
    record = Record(settings.recorded(), {}, {})
    for name in settings.boxes:
        more_timings, more_means = measured(name, settings, report)
        timings += more_timings
        means += more_means
        found = {"speeds": pd.DataFrame(timings)}
        if means:
            found["averages"] = pd.DataFrame(means)
        record = Record(settings.recorded(), found, device(settings.platform)).write(settings.out / "gpu.json")
    tell(record, report)
    return record


def device(platform: str | None) -> dict[str, str]:
    """Return the names of the platform and of the device on which it runs."""
    system = openmm.System()
    system.addParticle(1.0)
    context = make_context(system, openmm.VerletIntegrator(0.001), platform)
    chosen = context.getPlatform()
    names = chosen.getPropertyNames()
    kept = [name for name in ("DeviceName", "Precision") if name in names]
    return {"platform": chosen.getName()} | {name: chosen.getPropertyValue(context, name) for name in kept}


main = command(GpuSettings, study, __doc__, __name__)
