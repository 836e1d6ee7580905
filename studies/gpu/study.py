"""Measurements of each box, and their record."""

from __future__ import annotations

import copy
from typing import Any

import openmm
import pandas as pd

from openmm_sier.inputs.equilibration import make_context
from studies import text
from studies.boxes import BoxSystem
from studies.command import chosen
from studies.gpu import boxes, domains
from studies.gpu.averages import averages
from studies.gpu.energies import conservation
from studies.gpu.methods import REFERENCE, SHORT_STEPS, at_constant_energies, averaged, methods
from studies.gpu.settings import GpuSettings
from studies.gpu.speed import speeds
from studies.methods import Bath, Contestant
from studies.records import Record
from studies.report import SILENT, Report

#: Of baths, 1/ps.
FRICTION = 5.0

#: Time of LangevinMiddle at 2 fs from which all methods start, ps.
WARM = 5.0

TIMES = {"method": "{method}", "us a step": "{microseconds:.0f}", "ns/day": "{ns_per_day:.0f}"}
SPEEDS = {"box": "{box}"} | TIMES | {f"over {REFERENCE}": "{over:.2f} ± {over_error:.2f}"}
DOMAINS = TIMES | {f"over {domains.REFERENCE}": "{over:.2f} ± {over_error:.2f}"}
ENERGIES = text.columns("box", "method", "fs_per_force") | {
    "rms(H)/rms(V), %": "{percent:.3g}",
    "walk, %": "{walk:.3g}",
    "drift, kJ/mol/ps": "{drift:+.3g} ± {drift_error:.1g}",
}


class Tables:
    """Keep the rows that were found, by the names of their tables."""

    def __init__(self, report: Report):
        self._report = report
        self.rows: dict[str, list[dict[str, Any]]] = {}

    def add(self, table: str, place: dict[str, Any], row: dict[str, Any], form: str) -> None:
        """Keep a row, and report it."""
        self.rows.setdefault(table, []).append(place | row)
        self._report.note(text.cell(form, place | row))


class Started:
    """Start all methods in a box after a minimization and some ps of LangevinMiddle at 2 fs.

    Attributes:
        box: what is moved.
    """

    def __init__(self, box: BoxSystem, settings: GpuSettings):
        self.box = box
        self._settings = settings
        self._systems: dict[tuple[bool, float | None], openmm.System] = {}
        integrator = openmm.LangevinMiddleIntegrator(settings.temperature, 5.0, 0.002)
        context = make_context(box.system, integrator, settings.platform)
        context.setPositions(box.positions)
        context.applyConstraints(1e-6)
        openmm.LocalEnergyMinimizer.minimize(context, 10, 50)
        context.setVelocitiesToTemperature(settings.temperature, settings.seed)
        integrator.step(round(1000 * WARM / 2))
        self._state = context.getState(positions=True, velocities=True)

    def context(self, method: Contestant) -> openmm.Context:
        """Return a Context at the start, with velocities drawn for its masses."""
        bath = Bath(self._settings.temperature, FRICTION)
        context = make_context(self._system(method), method.integrator(bath), self._settings.platform)
        context.setState(self._state)
        context.setVelocitiesToTemperature(self._settings.temperature, self._settings.seed)
        return context

    def _system(self, method: Contestant) -> openmm.System:
        key = method.prepared, method.hydrogens
        if key not in self._systems:
            self._systems[key] = copy.deepcopy(self.box.system)
            method.fit(self._systems[key])
        return self._systems[key]


def measure(name: str, settings: GpuSettings, tables: Tables, report: Report) -> None:
    """Add the rows of a box."""
    box = boxes.named(name, settings.benchmarks)
    report.note(f"{name}: {box.system.getNumParticles()} atoms")
    place, started = {"box": name, "atoms": box.system.getNumParticles()}, Started(box, settings)
    by_name = {method.name: method for method in methods(box.has_solute)}
    chosen_names = {REFERENCE, *(method.name for method in chosen(settings.methods, by_name, "method"))}
    timed = [method for called, method in by_name.items() if called in chosen_names - {SHORT_STEPS}]
    contexts = {method.name: started.context(method) for method in timed}
    for row in speeds(contexts, {method.name: method.duration for method in timed}, REFERENCE, settings):
        tables.add("speeds", place, row, "{box}: {method}, {microseconds:.0f} µs a step, {over:.2f}")
    for method in averaged(box.has_solute, chosen_names) if name in settings.averages else ():
        row = averages(box.has_solute, contexts.get(method.name) or started.context(method), method, settings)
        tables.add("averages", place, row, "{box}: {method}, V {potential:.0f} ± {potential_error:.0f} kJ/mol")
    del contexts
    for method in at_constant_energies() if name in settings.energies else ():
        row = conservation(started.context(method), method, settings)
        tables.add("energies", place, row, "{box}: {method}, {percent:.3g} %")


def tell(record: Record, report: Report) -> None:
    """Report the results."""
    tables = record.tables
    for name, title, columns in (
        ("speeds", "Speed", SPEEDS),
        ("domains", "Chains with rigid domains", DOMAINS),
        ("energies", "Energy without a bath", ENERGIES),
    ):
        if name in tables:
            report.table(title, text.table(tables[name], columns))
    if "averages" in tables:
        means = tables["averages"]
        names = [name for name in means if f"{name}_error" in means]
        columns = {"box": "{box}", "method": "{method}"}
        columns |= {name: f"{{{name}:.6g}} ± {{{name}_error:.2g}}" for name in names}
        report.table("Averages, kJ/mol and K", text.table(means, columns))


def study(settings: GpuSettings, report: Report = SILENT) -> Record:
    """Measure, and write gpu.json after each box.

    Raises:
        ValueError: a box is unknown, its files are missing, or the number of chains is no square.
        ImportError: dhfr is to be measured without openmmtools and without `benchmarks`.
    """
    tables = Tables(report)

    def written() -> Record:
        frames = {name: pd.DataFrame(rows) for name, rows in tables.rows.items()}
        return Record(settings.recorded(), frames, device(settings.platform)).write(settings.out / "gpu.json")

    for row in domains.timed(settings) if settings.chains else ():
        tables.add("domains", {}, row, "{chains} chains: {method}, {microseconds:.0f} µs a step, {over:.2f}")
    for name in settings.boxes:
        measure(name, settings, tables, report)
        written()
    record = written()
    tell(record, report)
    return record


def device(platform: str | None) -> dict[str, str]:
    """Return the names of the platform and of the device on which it runs."""
    system = openmm.System()
    system.addParticle(1.0)
    context = make_context(system, openmm.VerletIntegrator(0.001), platform)
    chosen = context.getPlatform()
    names = chosen.getPropertyNames()
    relevant = [name for name in ("DeviceName", "Precision") if name in names]
    return {"platform": chosen.getName()} | {name: chosen.getPropertyValue(context, name) for name in relevant}
