"""Boxes in which speeds are compared: water of any size, a peptide, a protein, each with a start."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import openmm
from openmm import unit

from openmm_sier.measure import forcefields
from openmm_sier.measure.forcefields import Interactions
from openmm_sier.measure.starts import make_context
from openmm_sier.prepare.pme import meshed_forces
from studies import boxes
from studies.command import SYSTEMS, BoxSettings
from studies.report import Report

#: OpenMM's default ewaldErrorTolerance; nm.
TOLERANCE, CUTOFF, SWITCH = 5e-4, 0.9, 0.75

#: Mass of a solute's hydrogens in dalton, with which OpenMM's user guide has LangevinMiddle at 4 fs.
HYDROGEN = 1.5

#: LangevinMiddle before all methods start, steps of 2 fs.
SETTLE = 50

INTERACTIONS = Interactions(CUTOFF, SWITCH, TOLERANCE, HYDROGEN)


class Start(NamedTuple):
    """A box and the phase point from which all methods start.

    Attributes:
        name: of the box.
        molecules: of pure water, else of residues.
        system: as OpenMM makes it.
        state: positions, velocities and box.
        has_solute: whether there is more than water.
    """

    name: str
    molecules: int
    system: openmm.System
    state: openmm.State
    has_solute: bool


def start(name: str, settings: BoxSettings, report: Report) -> Start:
    """A box by its name.

    Raises:
        ValueError: the number of molecules of water is not a multiple of that of the box.
    """
    if name.startswith("water-"):
        molecules, system, positions = _water(int(name.removeprefix("water-")), settings)
    else:
        molecules, system, positions = SYSTEMS_OF[name]()
    report.note(f"{name}: {system.getNumParticles()} atoms")
    return Start(name, molecules, system, _settled(system, positions, settings), name in SYSTEMS_OF)


def _water(molecules: int, settings: BoxSettings) -> tuple[int, openmm.System, np.ndarray]:
    box = forcefields.read_box(settings.box, settings.forcefield, None, INTERACTIONS)
    shape = boxes.copies_for(molecules, box.topology.getNumResidues())
    found = boxes.repeated(box, settings.box.parent, shape)
    for force in meshed_forces(found.system):
        force.setEwaldErrorTolerance(TOLERANCE)
    return found.molecules, boxes.split_by_openmm(found.system), found.positions


def _peptide() -> tuple[int, openmm.System, np.ndarray]:
    box = forcefields.read_box(SYSTEMS / "peptide.pdb", None, "hbonds", INTERACTIONS)
    positions = np.array(box.positions.value_in_unit(unit.nanometer))
    return box.topology.getNumResidues(), boxes.split_by_openmm(box.system), positions


def _dhfr() -> tuple[int, openmm.System, np.ndarray]:
    made = boxes.dhfr(CUTOFF, SWITCH, TOLERANCE, HYDROGEN)
    return made.topology.getNumResidues(), made.system, np.array(made.positions.value_in_unit(unit.nanometer))


#: Boxes with a solute, by name: residues, System and positions.
SYSTEMS_OF: dict[str, Callable[[], tuple[int, openmm.System, np.ndarray]]] = {"peptide": _peptide, "dhfr": _dhfr}


def _settled(system: openmm.System, positions: np.ndarray, settings: BoxSettings) -> openmm.State:
    integrator = openmm.LangevinMiddleIntegrator(settings.temperature, 5.0, 0.002)
    integrator.setRandomNumberSeed(settings.seed)
    context = make_context(system, integrator, settings.platform)
    context.setPositions(positions)
    context.applyConstraints(1e-6)
    context.setVelocitiesToTemperature(settings.temperature, settings.seed)
    integrator.step(SETTLE)
    return context.getState(positions=True, velocities=True)
