"""Solutes in water for the studies of hybrid Monte Carlo: read, prepared, partly frozen, and equilibrated."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import openmm
from openmm import app

from openmm_sier import prepare_system
from openmm_sier.inputs.equilibration import make_context
from openmm_sier.inputs.forcefields import Interactions
from studies import boxes
from studies.command import BoxSettings, RunsSettings
from studies.sampling import warmed
from studies.units import md

#: Masses of hydrogen and of water, dalton.
HYDROGEN, WATER = 1.008, 18.0154

#: Which atoms move: all of them, or water or the solute alone while the others are frozen.
Moving = Literal["all", "water", "solute"]


@dataclass(frozen=True, kw_only=True)
class SoluteSettings(BoxSettings, RunsSettings):
    """Settings of studies of a solvated molecule.

    Attributes:
        box: PDB file that names its force field, or `dhfr`.
        cutoff: of PME, nm; interactions are switched off over the last sixth.
        tolerance: OpenMM's ewaldErrorTolerance; the sums of PME are balanced.
        hydrogen_mass: of hydrogens outside water, dalton.
        heavy_water: whether those of water have it too; averages of positions depend on no mass.
        moving: atoms that are not frozen.
        equilibrate: ps with LangevinMiddle before the first run of a box, whose end `--out` keeps.
    """

    box: Path = field(default=boxes.DHFR, kw_only=False)
    cutoff: float = 0.9
    tolerance: float = 1e-4
    hydrogen_mass: float = 3.0
    heavy_water: bool = False
    moving: Moving = "all"
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
    cutoff = settings.cutoff
    interactions = Interactions(cutoff, cutoff * 5 / 6, settings.tolerance, settings.hydrogen_mass)
    box = boxes.solute(settings.box, interactions, settings.forcefield)
    topology, system = box.topology, box.system
    dry = np.array([atom.residue.name != "HOH" for atom in topology.atoms()])
    waters = sum(residue.name == "HOH" for residue in topology.residues())
    _weigh_water(system, topology, settings.hydrogen_mass if settings.heavy_water else HYDROGEN)
    if settings.moving != "all":
        freeze(system, np.flatnonzero(dry == (settings.moving == "water")))
    prepare_system(system)
    return Solution(settings.box.stem, topology, np.array(md(box.positions)), system, np.flatnonzero(dry), waters)


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
        state = warmed(solution.system, solution.positions, settings, settings.equilibrate)
        vectors = md(state.getPeriodicBoxVectors(asNumpy=True))
        np.savez(kept, positions=md(state.getPositions(asNumpy=True)), vectors=vectors)
    found = np.load(kept)
    return found["positions"], found["vectors"]
