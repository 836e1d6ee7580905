"""Solutes in water for the studies of hybrid Monte Carlo: read, prepared, in part frozen, and equilibrated."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import openmm
import pandas as pd
from openmm import app, unit
from tyro.conf import Positional

from openmm_sier import prepare_system
from openmm_sier.measure import forcefields
from openmm_sier.measure.forcefields import Interactions
from openmm_sier.measure.starts import make_context
from studies import boxes, records
from studies.command import Settings
from studies.records import Record
from studies.report import Report

#: The name that stands for DHFR in water, the benchmark of Amber and CHARMM, whose files openmmtools has.
DHFR = "dhfr"

#: Masses of hydrogen and of water, dalton.
HYDROGEN, WATER = 1.008, 18.0154

#: Which atoms move: all of them, or water or the solute alone while the others are frozen.
Moving = Literal["all", "water", "solute"]


@dataclass(frozen=True)
class SoluteSettings(Settings):
    """What studies of a solvated molecule take.

    Attributes:
        box: PDB file that names its force field, or `dhfr`.
        temperature: K.
        cutoff: of PME, nm; interactions are switched off over the last sixth.
        tolerance: OpenMM's ewaldErrorTolerance; the sums of PME are balanced.
        hydrogen_mass: of hydrogens outside water, dalton.
        heavy_water: whether those of water have it too; averages of positions depend on no mass.
        moving: atoms that are not frozen.
        platform: of OpenMM; None takes the fastest.
        equilibrate: ps with LangevinMiddle before the first run of a box, whose end `--out` keeps.
    """

    box: Positional[Path] = Path(DHFR)
    temperature: float = 297.0
    cutoff: float = 0.9
    tolerance: float = 1e-4
    hydrogen_mass: float = 3.0
    heavy_water: bool = False
    moving: Moving = "all"
    platform: str | None = None
    equilibrate: float = 1.0


class Solution(NamedTuple):
    """A solute in water, bonds to hydrogen constrained, prepared for long steps.

    Attributes:
        name: of the box.
        topology: of it.
        positions: (N, 3), nm.
        system: prepared; frozen atoms have no mass.
        solute: indices of the atoms outside water.
        waters: number of molecules of water.
    """

    name: str
    topology: app.Topology
    positions: np.ndarray
    system: openmm.System
    solute: np.ndarray
    waters: int


def read(settings: SoluteSettings) -> Solution:
    """The box of a study."""
    system, topology, positions = _dhfr(settings) if settings.box == Path(DHFR) else _of_pdb(settings)
    dry = np.array([atom.residue.name != "HOH" for atom in topology.atoms()])
    waters = sum(residue.name == "HOH" for residue in topology.residues())
    _weigh_water(system, topology, settings.hydrogen_mass if settings.heavy_water else HYDROGEN)
    if settings.moving != "all":
        freeze(system, np.flatnonzero(dry == (settings.moving == "water")))
    prepare_system(system)
    return Solution(settings.box.stem, topology, positions, system, np.flatnonzero(dry), waters)


def _of_pdb(settings: SoluteSettings) -> tuple[openmm.System, app.Topology, np.ndarray]:
    mass, cutoff = settings.hydrogen_mass, settings.cutoff
    interactions = Interactions(cutoff, cutoff * 5 / 6, settings.tolerance, mass)
    box = forcefields.read_box(settings.box, None, "hbonds", interactions)
    return box.system, box.topology, np.array(box.positions.value_in_unit(unit.nanometer))


def _dhfr(settings: SoluteSettings) -> tuple[openmm.System, app.Topology, np.ndarray]:
    made = boxes.dhfr(settings.cutoff, settings.cutoff * 5 / 6, settings.tolerance, settings.hydrogen_mass)
    return made.system, made.topology, np.array(made.positions.value_in_unit(unit.nanometer))


def _weigh_water(system: openmm.System, topology: app.Topology, hydrogen: float) -> None:
    """Set the masses of water; hydrogens have 3.024 dalton in the file of DHFR."""
    for residue in topology.residues():
        if residue.name == "HOH":
            for atom in residue.atoms():
                light = atom.element is app.element.hydrogen
                system.setParticleMass(atom.index, hydrogen if light else WATER - 2 * hydrogen)


def freeze(system: openmm.System, atoms: np.ndarray) -> None:
    """Take the masses of atoms, and the constraints between them, which OpenMM allows between moving atoms alone."""
    frozen = np.zeros(system.getNumParticles(), dtype=bool)
    frozen[atoms] = True
    for index in atoms:
        system.setParticleMass(int(index), 0.0)
    for index in reversed(range(system.getNumConstraints())):
        first, second, _ = system.getConstraintParameters(index)
        if frozen[first] and frozen[second]:
            system.removeConstraint(index)


def context(solution: Solution, integrator: openmm.Integrator, settings: SoluteSettings) -> openmm.Context:
    """A Context at the equilibrated start of a box, which is made where `--out` does not have it."""
    made = make_context(solution.system, integrator, settings.platform)
    positions, vectors = _start(solution, settings)
    made.setPeriodicBoxVectors(*vectors)
    made.setPositions(positions)
    made.setVelocitiesToTemperature(settings.temperature, settings.seed)
    return made


def _start(solution: Solution, settings: SoluteSettings) -> tuple[np.ndarray, np.ndarray]:
    """Positions and box vectors, nm; the whole box is equilibrated, whatever is frozen afterwards."""
    kept = settings.out / f"start-{solution.name}.npz"
    if not kept.exists():
        if settings.moving != "all":
            raise ValueError(f"{settings.out} has no start of {solution.name}: make a run with --moving all first")
        integrator = openmm.LangevinMiddleIntegrator(settings.temperature, 5.0, 0.002)
        integrator.setRandomNumberSeed(settings.seed)
        running = make_context(solution.system, integrator, settings.platform)
        running.setPositions(solution.positions)
        running.applyConstraints(1e-6)
        running.setVelocitiesToTemperature(settings.temperature, settings.seed)
        integrator.step(round(settings.equilibrate / 0.002))
        state = running.getState(positions=True)
        vectors = state.getPeriodicBoxVectors(asNumpy=True).value_in_unit(unit.nanometer)
        np.savez(kept, positions=state.getPositions(asNumpy=True).value_in_unit(unit.nanometer), vectors=vectors)
    found = np.load(kept)
    return found["positions"], found["vectors"]


# --- runs that are kept as they go on ---


def kept_series(
    settings: Settings,
    name: str,
    label: str,
    count: int,
    every: int,
    sample: Callable[[], dict[str, float]],
    notes: Callable[[int], dict[str, Any]],
    report: Report,
) -> Record:
    """Take samples, and write them to a file of their own, NAME.json in `out`, as the run goes on.

    Args:
        settings: of the run.
        name, label: of the file, and for the report.
        count, every: number of samples, and between two records.
        sample: goes on to the next sample.
        notes: of a record after so many samples.
        report: gets progress.
    """
    rows = []
    with report.progress(label, count) as show:
        for done in range(1, count + 1):
            rows.append(sample())
            if done % every == 0 or done == count:
                record = Record(settings.recorded(), {"samples": pd.DataFrame(rows)}, {"label": label, **notes(done)})
                record.write(settings.out / f"{name}.json")
                show(done)
    return record


def by_label(files: Sequence[Path]) -> dict[str, list[Record]]:
    """Records of `kept_series` by their labels; those of one label differ in their seeds alone."""
    runs: dict[str, list[Record]] = {}
    for path in files:
        record = records.read(path)
        runs.setdefault(record.notes["label"], []).append(record)
    return runs
