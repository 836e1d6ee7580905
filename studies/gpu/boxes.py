"""Boxes for GPUs: OpenMM's own benchmark, if its files exist, water, and boxes repeated along their edges."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import openmm
from openmm import app, unit

from studies import boxes
from studies.boxes import BoxSystem
from studies.command import SYSTEMS

#: Cut-off of PME in nm, OpenMM's default tolerance, and the mass of hydrogens in dalton: those of OpenMM's benchmark.
CUTOFF, TOLERANCE, HYDROGEN = 0.9, 5e-4, 1.5

#: The PDB file of DHFR in OpenMM's benchmark, and its force field.
DHFR, FORCE_FIELD = "5dfr_solv-cube_equil.pdb", ("amber99sb.xml", "tip3p.xml")


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
