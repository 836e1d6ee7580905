"""Boxes for comparisons of speed: water of any size, a peptide, a protein, each with a start."""

from __future__ import annotations

import openmm

from openmm_sier.inputs import forcefields
from openmm_sier.inputs.forcefields import Interactions
from studies import boxes
from studies.boxes import BoxSystem
from studies.command import SYSTEMS, BoxSettings
from studies.frame import warmed
from studies.report import Report
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


def start(name: str, settings: BoxSettings, report: Report) -> tuple[BoxSystem, openmm.State]:
    """Return a box by its name, as OpenMM makes it, and the phase point from which all methods start.

    Raises:
        ValueError: the number of molecules of water is not a multiple of that of the box.
    """
    if name.startswith("water-"):
        box = _water(int(name.removeprefix("water-")), settings)._replace(name=name)
    else:
        solute = boxes.solute(SOLUTES[name], INTERACTIONS)
        box = BoxSystem(solute.topology.getNumResidues(), md(solute.positions), solute.system, name, has_solute=True)
    boxes.split_by_openmm(box.system)
    report.note(f"{name}: {box.system.getNumParticles()} atoms")
    start = warmed(box.system, box.positions, settings.temperature, settings.seed, SETTLE, settings.platform)
    return box, start


def _water(molecules: int, settings: BoxSettings) -> BoxSystem:
    box = forcefields.read_box(settings.box, settings.forcefield, None, INTERACTIONS)
    shape = boxes.copies_for(molecules, box.topology.getNumResidues())
    repeated = boxes.repeated(box, settings.box.parent, shape)
    boxes.with_tolerance(repeated.system, TOLERANCE)
    return repeated
