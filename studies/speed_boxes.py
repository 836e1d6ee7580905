"""Boxes in which speeds are compared: water of any size, a peptide, a protein, each with a start."""

from __future__ import annotations

from typing import NamedTuple

import openmm

from openmm_sier.inputs import forcefields
from openmm_sier.inputs.forcefields import Interactions
from studies import boxes
from studies.command import SYSTEMS, BoxSettings
from studies.report import Report
from studies.sampling import warmed
from studies.units import md

#: OpenMM's default ewaldErrorTolerance; nm.
TOLERANCE, CUTOFF, SWITCH = 5e-4, 0.9, 0.75

#: Mass of a solute's hydrogens in dalton, with which OpenMM's user guide has LangevinMiddle at 4 fs.
HYDROGEN = 1.5

#: LangevinMiddle before all methods start, ps.
SETTLE = 0.1

INTERACTIONS = Interactions(CUTOFF, SWITCH, TOLERANCE, HYDROGEN)

#: Boxes with a solute, by name.
SOLUTES = {"peptide": SYSTEMS / "peptide.pdb", "dhfr": boxes.DHFR}


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
        molecules, positions, system = _water(int(name.removeprefix("water-")), settings)
    else:
        box = boxes.solute(SOLUTES[name], INTERACTIONS)
        molecules, positions, system = box.topology.getNumResidues(), md(box.positions), box.system
    boxes.split_by_openmm(system)
    report.note(f"{name}: {system.getNumParticles()} atoms")
    return Start(name, molecules, system, warmed(system, positions, settings, SETTLE), name in SOLUTES)


def _water(molecules: int, settings: BoxSettings) -> boxes.Replica:
    box = forcefields.read_box(settings.box, settings.forcefield, None, INTERACTIONS)
    shape = boxes.copies_for(molecules, box.topology.getNumResidues())
    found = boxes.repeated(box, settings.box.parent, shape)
    boxes.with_tolerance(found.system, TOLERANCE)
    return found
