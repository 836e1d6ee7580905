"""Boxes of liquids: read, repeated, cut, and made on a lattice."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import openmm
from openmm import app, unit

from openmm_sier.inputs import forcefields
from openmm_sier.inputs.forcefields import Box, Interactions
from openmm_sier.prepare.pme import balance_pme, meshed_forces
from studies.command import BoxSettings
from systems import make

#: OpenMM's ewaldErrorTolerance: with balanced sums, forces exact enough to see what a scheme of fourth order does.
TOLERANCE = 1e-5

#: Stands for DHFR in water, the benchmark of Amber and CHARMM, whose files openmmtools has.
DHFR = Path("dhfr")

#: Names of residues that are water.
WATERS = ("HOH", "WAT")

#: Liquid water, g/cm^3.
DENSITY = 0.997


def read(settings: BoxSettings, constraints: str | None = None, tolerance: float = TOLERANCE) -> Box:
    """The box of a study, its PME at a tolerance; the other arguments are those of `forcefields.read_box`."""
    box = forcefields.read_box(settings.box, settings.forcefield, constraints)
    with_tolerance(box.system, tolerance)
    return box


def with_tolerance(system: openmm.System, tolerance: float = TOLERANCE) -> openmm.System:
    """A System with PME at a tolerance, its sums in balance."""
    for force in meshed_forces(system):
        force.setEwaldErrorTolerance(tolerance)
        force.setPMEParameters(0, 0, 0, 0)
    balance_pme(system)
    return system


def split_by_openmm(system: openmm.System) -> openmm.System:
    """A System whose sums of PME are no longer balanced: OpenMM splits them by the tolerance."""
    for force in meshed_forces(system):
        force.setPMEParameters(0, 0, 0, 0)
    return system


def on_lattice(molecules: int, forcefield: str = "tip3p.xml", seed: int = 3) -> tuple[app.Topology, np.ndarray]:
    """Topology, with its box, and positions in nm of water that has not been equilibrated."""
    topology = make.make_topology(molecules, 0)
    edge = make.box_edge(topology, DENSITY)
    topology.setUnitCellDimensions([edge] * 3 * unit.nanometer)
    geometry = make.water_geometry(forcefields.load([forcefield]))
    return topology, make.start_positions(molecules, 0, edge, geometry, np.random.default_rng(seed))


def write_lattice(path: Path, molecules: int = 27, forcefield: str = "tip3p.xml", named: bool = True) -> Path:
    """A PDB file of `on_lattice`, which names its force field if `named`."""
    topology, positions = on_lattice(molecules, forcefield)
    edge = topology.getUnitCellDimensions()[0].value_in_unit(unit.nanometer)
    remarks = [f"FORCEFIELD {forcefield}"] if named else []
    make.write(path, topology, positions * unit.nanometer, edge, remarks)
    return path


def dhfr(cutoff: float, switch: float, tolerance: float, hydrogen_mass: float) -> Any:
    """DHFR in water, the benchmark of Amber and CHARMM, 23558 atoms: openmmtools' test system, its CMMotionRemover out.

    Args:
        cutoff: of PME, nm.
        switch: where Lennard-Jones starts to be switched off, nm.
        tolerance: OpenMM's ewaldErrorTolerance.
        hydrogen_mass: dalton.

    Raises:
        ImportError: openmmtools is not installed.
    """
    try:
        from openmmtools import testsystems
    except ModuleNotFoundError as error:
        raise ImportError("the files of DHFR are in openmmtools; install it with: pip install openmmtools") from error
    test_system = testsystems.DHFRExplicit(
        nonbondedCutoff=cutoff * unit.nanometer,
        switch_width=(cutoff - switch) * unit.nanometer,
        ewaldErrorTolerance=tolerance,
        hydrogenMass=hydrogen_mass * unit.dalton,
    )
    for index in reversed(range(test_system.system.getNumForces())):
        if isinstance(test_system.system.getForce(index), openmm.CMMotionRemover):
            test_system.system.removeForce(index)
    return test_system


def solute(path: Path, interactions: Interactions, forcefield: Sequence[str] = ()) -> Any:
    """A solute in water with its bonds to hydrogen constrained; what has topology, positions and system.

    Args:
        path: PDB file, or `DHFR`.
        interactions: cut-offs, tolerance and mass of hydrogens.
        forcefield: files; without them those that the PDB file names.
    """
    if path != DHFR:
        return forcefields.read_box(path, forcefield or None, "hbonds", interactions)
    return dhfr(**interactions._asdict())


class BoxSystem(NamedTuple):
    """A box as studies move it: as it was read, repeated along its edges, or a part of one.

    Attributes:
        molecules: of water, or residues where there is more.
        positions: (N, 3), nm, virtual sites included.
        system: with PME.
        name: of the box, for tables.
        has_solute: whether there is more than water.
    """

    molecules: int
    positions: np.ndarray
    system: openmm.System
    name: str = ""
    has_solute: bool = False


def is_water(path: Path) -> bool:
    """Return whether a PDB file has nothing but water."""
    return all(residue.name in WATERS for residue in app.PDBFile(str(path)).topology.residues())


def copies_for(molecules: int, of: int) -> tuple[int, int, int]:
    """Copies of a box of `of` molecules along each edge of the most nearly cubic box of `molecules` molecules.

    Raises:
        ValueError: `molecules` is not a multiple of `of`.
    """
    times, rest = divmod(molecules, of)
    if rest or not times:
        raise ValueError(f"sizes are multiples of the {of} molecules of the box, got {molecules}")
    divisors = [n for n in range(1, times + 1) if times % n == 0]
    shapes = [(a, b, times // (a * b)) for a, b in itertools.product(divisors, repeat=2) if times % (a * b) == 0]
    return min(shapes, key=lambda shape: (max(shape) - min(shape), shape))


def repeated(box: Box, directory: Path, copies: tuple[int, int, int]) -> BoxSystem:
    """A box repeated along each edge.

    Args:
        box: the box.
        directory: of its PDB file, where force fields are looked for too.
        copies: along each edge.
    """
    positions = np.array(box.positions.value_in_unit(unit.nanometer))
    if copies == (1, 1, 1):
        return BoxSystem(box.topology.getNumResidues(), positions, box.system)
    topology, moved = copied(box.topology, positions, copies)
    return BoxSystem(topology.getNumResidues(), moved, _system(topology, box, directory))


def copied(
    topology: app.Topology, positions: np.ndarray, copies: tuple[int, int, int]
) -> tuple[app.Topology, np.ndarray]:
    """Return topology and positions of a box repeated along each edge; positions are (N, 3) in nm."""
    vectors = np.array(topology.getPeriodicBoxVectors().value_in_unit(unit.nanometer))
    places = np.array(list(itertools.product(*map(range, copies))))
    copy = app.Topology()
    for _ in places:
        _add(list(topology.residues()), topology, copy)
    copy.setPeriodicBoxVectors(np.array(copies)[:, None] * vectors * unit.nanometer)
    return copy, ((places @ vectors)[:, None] + positions).reshape(-1, 3)


def cropped(box: Box, directory: Path, molecules: int) -> BoxSystem:
    """Molecules around a corner of a box, in a smaller box of the same shape and density.

    The molecules are those nearest to the corner. They meet new neighbours across the faces of the smaller box, so
    minimize and equilibrate.

    Args:
        box: the box, rectangular.
        directory: see `repeated`.
        molecules: how many.

    Raises:
        ValueError: the box has no more molecules than that.
    """
    positions = np.array(box.positions.value_in_unit(unit.nanometer))
    residues = list(box.topology.residues())
    if not 0 < molecules < len(residues):
        raise ValueError(f"a part of a box of {len(residues)} molecules has 1 to {len(residues) - 1}, got {molecules}")
    edges = np.diag(np.array(box.topology.getPeriodicBoxVectors().value_in_unit(unit.nanometer)))
    atoms = [np.array([atom.index for atom in residue.atoms()]) for residue in residues]
    centres = np.array([positions[each].mean(axis=0) for each in atoms]) % edges
    reach = (centres / edges).max(axis=1)
    chosen = np.argsort(reach, kind="stable")[:molecules]
    share = (molecules / len(residues)) ** (1 / 3)
    topology = app.Topology()
    _add([residues[i] for i in chosen], box.topology, topology)
    topology.setPeriodicBoxVectors(np.diag(share * edges) * unit.nanometer)
    # Centres fill the smaller box as they filled their part of the larger one.
    shifts = centres[chosen] * share / reach[chosen[-1]] - [positions[atoms[i]].mean(axis=0) for i in chosen]
    centred = np.concatenate([positions[atoms[i]] + shift for i, shift in zip(chosen, shifts, strict=True)])
    return BoxSystem(molecules, centred, _system(topology, box, directory))


def _system(topology: app.Topology, box: Box, directory: Path) -> openmm.System:
    return with_tolerance(forcefields.pme_system(topology, forcefields.load(box.files, directory)))


def of_size(box: Box, directory: Path, molecules: int) -> BoxSystem:
    """A box of this many molecules: `cropped` where it is smaller than the one given, else `repeated`.

    Raises:
        ValueError: the number is neither smaller than that of the box nor a multiple of it.
    """
    present = box.topology.getNumResidues()
    if molecules < present:
        return cropped(box, directory, molecules)
    return repeated(box, directory, copies_for(molecules, present))


def _add(residues: Iterable[app.topology.Residue], bonded: app.Topology, topology: app.Topology) -> None:
    """Add molecules of a topology to another one, with their bonds, in a chain of their own."""
    atoms, chain = {}, topology.addChain()
    for residue in residues:
        place = topology.addResidue(residue.name, chain)
        for atom in residue.atoms():
            atoms[atom] = topology.addAtom(atom.name, atom.element, place)
    for first, second in bonded.bonds():
        if first in atoms:
            topology.addBond(atoms[first], atoms[second])
