"""Cost of a step on a GPU, compared with OpenMM's integrators, and averages that would reveal a wrong program.

    python -m studies.gpu [--platform CUDA] [--benchmarks openmm/examples/benchmarks] [--boxes dhfr water-4096]

takes boxes of water and DHFR, that of OpenMM's own benchmark where its folder is given, which copies of it (dhfr-8)
need, in mixed precision. LangevinMiddle at 4 fs is as that benchmark has it: bonds to hydrogen constrained, hydrogens
of 1.5 dalton, 1/ps. Prepared Systems have hydrogens of 4 dalton, those of solutes 3. Steps are called by tens, as
`Simulation` calls them, all methods take turns, and times are those of the wall.

In the boxes of `--averages` the potential energy, the temperatures of water, and the energies of bonds, angles and
torsions are averaged over a run, and set beside those of LangevinMiddle at 1 fs. In those of `--energies` the energy of
runs without a bath is followed. With `--chains` so many chains of beads with rigid domains are timed, too, as bodies of
the exact engine, as frames, and with springs. Writes gpu.json.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import openmm
import pandas as pd
from openmm import app, unit

from openmm_sier import SIERHMCIntegrator
from openmm_sier.dynamics.schemes import SIER4G
from openmm_sier.inputs.equilibration import make_context
from studies import boxes, frame, text, timing
from studies.boxes import BoxSystem
from studies.command import SYSTEMS, Settings, chosen, command
from studies.domains import sheet
from studies.hmc import trials
from studies.methods import (
    HEAVY,
    MIDDLE,
    VERLET,
    Bath,
    Contestant,
    in_bath,
    middle_in_rigid_water,
    more_inner_steps,
    of_scheme,
    own,
    several_steps,
)
from studies.observers import OfSolution
from studies.records import Record
from studies.report import SILENT, Report

#: Cut-off of PME in nm, OpenMM's default tolerance, and the mass of hydrogens in dalton: those of OpenMM's benchmark.
CUTOFF, TOLERANCE, HYDROGEN = 0.9, 5e-4, 1.5

#: The PDB file of DHFR in OpenMM's benchmark, and its force field.
DHFR, FORCE_FIELD = "5dfr_solv-cube_equil.pdb", ("amber99sb.xml", "tip3p.xml")

#: Of baths, 1/ps.
FRICTION = 5.0

#: Time of LangevinMiddle at 2 fs from which all methods start, ps.
WARM = 5.0

#: Between samples for averages and of energies, fs.
EVERY, EVERY_ENERGY = 200.0, 24.0

#: What averages have, of all that is observed.
AVERAGED = ("potential", "translation", "rotation", "bonds", "angles", "torsions")

#: What ratios are taken over; what averages are compared with, and what is not timed.
REFERENCE, SHORT_STEPS = "LangevinMiddle, 4 fs", "LangevinMiddle, 1 fs"

#: SIER2 at the longest step that is recommended, and at constant energy.
LONG_STEPS = own(9)
STEADY = of_scheme(SIER4G).at(4, prepared=True)

#: It has the averages of the other engine.
EXACT_ENGINE = in_bath(engine="exact").at(9, **HEAVY, detail=", exact engine")

#: Compared in rigid water alone, and around a solute alone.
IN_WATER = (
    *(middle_in_rigid_water(step, ", heavy hydrogens") for step in (9, 10)),
    *(replace(LONG_STEPS, step=step) for step in (10, 11)),
    trials.METHODS[trials.USUAL],
)
AROUND_A_SOLUTE = (
    MIDDLE.at(5, hydrogens=3.0, friction=1.0),
    several_steps(8, friction=1.0),
    replace(LONG_STEPS, step=8),
    more_inner_steps(9, 3, ", five inner steps"),
    trials.METHODS[trials.SHORT],
)

#: Those whose energies are followed: Verlet with as many forces as SIER4G, and at its usual step.
AT_CONSTANT_ENERGY = (
    VERLET.at(2),
    VERLET.at(1),
    VERLET.at(1, prepared=True, detail=", prepared"),
    STEADY,
    replace(STEADY, step=3),
)

TIMES = {"method": "{method}", "us a step": "{microseconds:.0f}", "ns/day": "{ns_per_day:.0f}"}
OVER = "{over:.2f} ± {over_error:.2f}"

#: Titles and columns of the tables of a record.
TABLES = {
    "speeds": ("Speed", {"box": "{box}"} | TIMES | {f"over {REFERENCE}": OVER}),
    "domains": ("Chains with rigid domains", TIMES | {f"over {sheet.REFERENCE}": OVER}),
    "averages": (
        "Averages, kJ/mol and K",
        text.columns("box", "method") | {name: f"{{{name}_text}}" for name in (*AVERAGED, "accepted")},
    ),
    "energies": (
        "Energy without a bath",
        text.columns("box", "method", "fs_per_force")
        | {
            "rms(H)/rms(V), %": "{percent:.3g}",
            "walk, %": "{walk:.3g}",
            "drift, kJ/mol/ps": "{drift:+.3g} ± {drift_error:.1g}",
        },
    ),
}


@dataclass(frozen=True, kw_only=True)
class GpuSettings(Settings):
    """Choose what is measured.

    Attributes:
        boxes: by name, see `named`.
        averages: boxes in which averages are compared too.
        energies: boxes in which energies of runs without a bath are followed too.
        methods: names of those that are measured beside the one that ratios are taken over; all unless given.
        chains: number of chains with rigid domains that are timed too, a square; None: none.
        benchmarks: the folder examples/benchmarks of OpenMM's sources.
        platform: of OpenMM; None takes the fastest.
        temperature: K.
        rounds: in which all methods take their turns.
        turn: seconds of a turn.
        time: of runs for averages, ps.
        settle: before these, ps.
        energy_time: of runs without a bath, ps.
    """

    boxes: tuple[str, ...] = ("water-4096", "dhfr", "water-32768")
    averages: tuple[str, ...] = ("water-4096", "dhfr")
    energies: tuple[str, ...] = ("water-4096", "dhfr")
    methods: tuple[str, ...] = ()
    chains: int | None = None
    benchmarks: Path | None = None
    platform: str | None = None
    temperature: float = 300.0
    rounds: int = 5
    turn: float = 0.5
    time: float = 100.0
    settle: float = 10.0
    energy_time: float = 50.0


# --- boxes and contestants ---


def named(name: str, benchmarks: Path | None) -> BoxSystem:
    """Make a box by its name, as OpenMM's benchmark has it, with constrained bonds to hydrogen and a CMMotionRemover.

    Args:
        name: water-N, of N molecules; dhfr; dhfr-N, N copies of it.
        benchmarks: the folder examples/benchmarks of OpenMM's sources; None: none, and DHFR is that of openmmtools.

    Raises:
        ValueError: the box is unknown, or copies of DHFR are to be made without the folder.
        ImportError: dhfr is to be made without the folder and without openmmtools.
    """
    kind, _, number = name.partition("-")
    if kind == "water":
        pdb = app.PDBFile(str(SYSTEMS / "tip3p-512.pdb"))
        return _of_pdb(name, pdb, ("tip3p.xml",), boxes.copies_for(int(number), pdb.topology.getNumResidues()))
    if kind != "dhfr":
        raise ValueError(f"unknown box {name!r}; known are water-N, dhfr and dhfr-N")
    if benchmarks is not None:
        return _of_pdb(name, app.PDBFile(str(benchmarks / DHFR)), FORCE_FIELD, boxes.copies_for(int(number or 1), 1))
    if number:
        raise ValueError(
            f"the box {name} needs OpenMM's benchmark: give the folder examples/benchmarks of its sources with "
            "--benchmarks"
        )
    box = boxes.dhfr(CUTOFF, CUTOFF, TOLERANCE, HYDROGEN)
    box.system.addForce(openmm.CMMotionRemover())
    positions = box.positions.value_in_unit(unit.nanometer)
    return BoxSystem(box.topology.getNumResidues(), positions, box.system, name, has_solute=True)


def _of_pdb(name: str, pdb: app.PDBFile, fields: tuple[str, ...], copies: tuple[int, int, int]) -> BoxSystem:
    topology, positions = boxes.copied(pdb.topology, np.array(pdb.positions.value_in_unit(unit.nanometer)), copies)
    system = app.ForceField(*fields).createSystem(
        topology,
        nonbondedMethod=app.PME,
        nonbondedCutoff=CUTOFF * unit.nanometer,
        constraints=app.HBonds,
        hydrogenMass=HYDROGEN * unit.dalton,
    )
    return BoxSystem(topology.getNumResidues(), positions, system, name, not name.startswith("water"))


def methods(has_solute: bool) -> list[Contestant]:
    """Return all methods for a box; the bath of LangevinMiddle at 4 fs is that of OpenMM's benchmark."""
    return [
        VERLET.at(2),
        MIDDLE.at(4, friction=1.0),
        MIDDLE.at(1, **HEAVY),
        *(AROUND_A_SOLUTE if has_solute else IN_WATER),
        LONG_STEPS,
        in_bath(countsHeat=True).at(9, **HEAVY, detail=", heat counted"),
        EXACT_ENGINE,
        STEADY,
    ]


class Started:
    """Start all methods in a box after a minimization and some ps of LangevinMiddle at 2 fs."""

    def __init__(self, box: BoxSystem, settings: GpuSettings):
        self._box = box
        self._settings = settings
        self._systems: dict[tuple[bool, float | None], openmm.System] = {}
        self._state = frame.warmed(
            box.system, box.positions, settings.temperature, settings.seed, WARM, settings.platform, iterations=50
        )

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
            self._systems[key] = copy.deepcopy(self._box.system)
            method.fit(self._systems[key])
        return self._systems[key]


# --- measurements ---


def averages(context: openmm.Context, method: Contestant, settings: GpuSettings) -> dict[str, Any]:
    """Return means and their errors over a run of a method, and of trials the share that was accepted."""
    integrator = context.getIntegrator()
    frame.advance(integrator, round(1000 * settings.settle / method.duration))
    observe = OfSolution(context.getSystem(), platform=settings.platform)
    if isinstance(integrator, SIERHMCIntegrator):
        integrator.resetStatistics()
    table = frame.sampled(context, observe, method.duration, settings.time, EVERY).table
    found = frame.means(table[["time", *(name for name in AVERAGED if name in table)]])
    if isinstance(integrator, SIERHMCIntegrator):
        found |= {"trials": integrator.trials, "accepted": integrator.acceptanceRate}
    # What is not known has a column all the same.
    return {"method": method.name} | dict.fromkeys((*AVERAGED, "accepted"), math.nan) | found


def conservation(context: openmm.Context, method: Contestant, settings: GpuSettings) -> dict[str, Any]:
    """Return how well a run without a bath conserves its energy, see `frame.conservation`."""
    table = frame.sampled(context, frame.energies, method.step, settings.energy_time, EVERY_ENERGY).table
    found = frame.conservation(table)
    row = {"method": method.name, "fs_per_force": method.step / method.forces}
    return row | found | {"drift_error": found["its_error"]}


class Tables:
    """Keep the rows that were found, by the names of their tables."""

    def __init__(self, report: Report):
        self._report = report
        self.rows: dict[str, list[dict[str, Any]]] = {}

    def add(self, table: str, place: dict[str, Any], row: dict[str, Any], form: str) -> None:
        """Keep a row, and report it."""
        self.rows.setdefault(table, []).append(place | row)
        self._report.note(text.cell(form, place | row))


def measure(name: str, settings: GpuSettings, tables: Tables, report: Report) -> None:
    """Add the rows of a box."""
    box = named(name, settings.benchmarks)
    report.note(f"{name}: {box.system.getNumParticles()} atoms")
    place, started = {"box": name, "atoms": box.system.getNumParticles()}, Started(box, settings)
    by_name = {method.name: method for method in methods(box.has_solute)}
    wanted = {REFERENCE, *(method.name for method in chosen(settings.methods, by_name, "method"))}
    compared = [method for called, method in by_name.items() if called in wanted]
    contexts = {method.name: started.context(method) for method in compared if method.name != SHORT_STEPS}
    durations = {name: by_name[name].duration for name in contexts}
    for row in timing.speeds(contexts, durations, {"over": REFERENCE}, settings.rounds, settings.turn):
        row["method"] = row.pop("name")
        tables.add("speeds", place, row, "{box}: {method}, {microseconds:.0f} µs a step, {over:.2f}")
    for method in compared if name in settings.averages else ():
        if method.method.has_bath and method != EXACT_ENGINE:
            row = averages(contexts.get(method.name) or started.context(method), method, settings)
            tables.add("averages", place, row, "{box}: {method}, V {potential:.0f} ± {potential_error:.0f} kJ/mol")
    del contexts
    for method in AT_CONSTANT_ENERGY if name in settings.energies else ():
        row = conservation(started.context(method), method, settings)
        tables.add("energies", place, row, "{box}: {method}, {percent:.3g} %")


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

    for row in sheet.timed(settings) if settings.chains else ():
        tables.add("domains", {}, row, "{chains} chains: {method}, {microseconds:.0f} µs a step, {over:.2f}")
    for name in settings.boxes:
        measure(name, settings, tables, report)
        written()
    record = written()
    for name, (title, columns) in TABLES.items():
        if name in record.tables:
            report.table(title, text.table(record.tables[name], columns))
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


main = command(GpuSettings, study, __doc__, __name__)
