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

#: Force fields of the PDB files of OpenMM's benchmark.
FORCE_FIELDS = {
    "dhfr": ("5dfr_solv-cube_equil.pdb", ("amber99sb.xml", "tip3p.xml")),
    "apoa1": ("apoa1.pdb", ("amber14/protein.ff14SB.xml", "amber14/lipid17.xml", "amber14/tip3p.xml")),
}

#: Its AMBER files, in the folder that its script downloads.
AMBER = {"cellulose": "Cellulose", "stmv": "STMV"}


def named(name: str, benchmarks: Path | None) -> BoxSystem:
    """Make a box by its name, as OpenMM's benchmark has it, with constrained bonds to hydrogen and a CMMotionRemover.

    Args:
        name: water-N, of N molecules; dhfr, apoa1, cellulose or stmv; dhfr-N, N copies of it.
        benchmarks: the folder examples/benchmarks of OpenMM's sources; None: none, and DHFR is that of openmmtools.

    Raises:
        ValueError: the box is unknown, or its files are not in the folder.
        ImportError: dhfr is to be made without the folder and without openmmtools.
    """
    kind, _, number = name.partition("-")
    if kind == "water":
        pdb = app.PDBFile(str(SYSTEMS / "tip3p-512.pdb"))
        return _of_pdb(name, pdb, ("tip3p.xml",), boxes.copies_for(int(number), pdb.topology.getNumResidues()))
    if kind in AMBER and not number:
        return _of_amber(name, _file(benchmarks, Path("Amber20_Benchmark_Suite", "PME"), name))
    if kind == "dhfr" and benchmarks is None and not number:
        box = boxes.dhfr(CUTOFF, CUTOFF, TOLERANCE, HYDROGEN)
        box.system.addForce(openmm.CMMotionRemover())
        positions = box.positions.value_in_unit(unit.nanometer)
        return BoxSystem(box.topology.getNumResidues(), positions, box.system, name, has_solute=True)
    if kind not in FORCE_FIELDS:
        raise ValueError(f"unknown box {name!r}; known are water-N, dhfr, dhfr-N, apoa1, {', '.join(AMBER)}")
    file, fields = FORCE_FIELDS[kind]
    pdb = app.PDBFile(str(_file(benchmarks, Path(file), name)))
    return _of_pdb(name, pdb, fields, boxes.copies_for(int(number or 1), 1))


def _file(folder: Path | None, name: Path, box: str) -> Path:
    if folder is None or not (folder / name).exists():
        raise ValueError(
            f"the box {box} needs {name} of OpenMM's benchmark: give the folder examples/benchmarks of its sources "
            "with --benchmarks"
        )
    return folder / name


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


def _of_amber(name: str, folder: Path) -> BoxSystem:
    topology = app.AmberPrmtopFile(str(folder / "Topologies" / f"{AMBER[name]}.prmtop"))
    start = app.AmberInpcrdFile(str(folder / "Coordinates" / f"{AMBER[name]}.inpcrd"))
    system = topology.createSystem(
        nonbondedMethod=app.PME, nonbondedCutoff=CUTOFF * unit.nanometer, constraints=app.HBonds
    )
    vectors = start.boxVectors
    box = None if vectors is None else np.array(vectors.value_in_unit(unit.nanometer))
    positions = np.array(start.positions.value_in_unit(unit.nanometer))
    return BoxSystem(topology.topology.getNumResidues(), positions, system, name, has_solute=True, vectors=box)
