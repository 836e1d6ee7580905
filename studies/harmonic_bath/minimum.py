"""A box at a minimum of its energy."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import openmm

from openmm_sier.inputs.equilibration import make_context
from openmm_sier.prepare.close_pairs import fast_force_groups
from openmm_sier.prepare.masses import set_hydrogen_masses
from openmm_sier.system import tables
from studies import boxes
from studies.harmonic_bath.steps import Case
from studies.harmonic_bath.surfaces import Surface
from studies.heat_bath import BONDED, BathSettings, read_box
from studies.methods import own
from studies.units import md

#: nm. Displacement of an atom for second derivatives.
DISPLACEMENT = 2e-4

#: nm. Molecules with an atom as near to one of a molecule are its neighbours.
NEAR = 0.3

#: Bonded energies whose averages are compared, each with a force group for itself.
KINDS = {"bonds": 20, "angles": 21}


@dataclass(frozen=True)
class Minimum:
    """A box at a minimum of its energy.

    Attributes:
        system: prepared.
        positions: (N, 3), nm.
        edges: of the box, which is rectangular, (3,), nm.
        molecules: number of the molecule of each atom, (N,).
        solute: numbers of the molecules of the solute that are compared.
        surfaces: of the slow and the fast forces, and of `KINDS`; kJ/mol and nm.
        energies: of `KINDS`, mean over the molecules of the solute, kJ/mol.
    """

    system: openmm.System
    positions: np.ndarray
    edges: np.ndarray
    molecules: np.ndarray
    solute: np.ndarray
    surfaces: dict[str, Surface]
    energies: dict[str, float]


def minimum(path: Path, temperature: float, time: float, steps: int, seed: int, most: int | None = None) -> Minimum:
    """Return a minimum near the end of a run.

    Args:
        path: PDB file of a solute in water that names its force field.
        temperature: K.
        time: of the run, ps.
        steps: of the minimization, at most.
        seed: of the run.
        most: number of molecules of the solute that are compared; None: all.
    """
    box = read_box(BathSettings(box=path))
    own(9).fit(box.system)
    groups = _separated(box.system)
    integrator = openmm.LangevinMiddleIntegrator(temperature, 5, 0.002)
    integrator.setRandomNumberSeed(seed)
    context = make_context(box.system, integrator, "CPU")
    context.setPositions(box.positions)
    openmm.LocalEnergyMinimizer.minimize(context, 10, steps // 10)
    context.setVelocitiesToTemperature(temperature, seed)
    integrator.step(max(1, round(time / 0.002)))
    openmm.LocalEnergyMinimizer.minimize(context, 0.05, steps)
    context.applyConstraints(1e-8)
    state = context.getState(positions=True)
    positions, edges = md(state.getPositions(asNumpy=True)), np.diag(md(state.getPeriodicBoxVectors(asNumpy=True)))

    molecules = np.empty(len(positions), dtype=int)
    for number, atoms in enumerate(context.getMolecules()):
        molecules[list(atoms)] = number
    is_solute = [atom.residue.name not in boxes.WATERS for atom in box.topology.atoms()]
    solute = np.unique(molecules[is_solute])
    energies = {
        kind: md(context.getState(energy=True, groups={group}).getPotentialEnergy()) / len(solute)
        for kind, group in KINDS.items()
    }
    solute = solute[:most]
    moving = [neighbourhood(positions, edges, molecules, each) for each in solute]
    surfaces = _surfaces(context, groups, positions, np.unique(np.concatenate(moving)))
    return Minimum(box.system, positions, edges, molecules, solute, surfaces, energies)


def neighbourhood(positions: np.ndarray, edges: np.ndarray, molecules: np.ndarray, molecule: int) -> np.ndarray:
    """Return the atoms of a molecule and of its neighbours."""
    apart = positions[:, None] - positions[molecules == molecule]
    apart -= edges * np.round(apart / edges)
    near = (apart**2).sum(axis=2).min(axis=1) < NEAR**2
    return np.flatnonzero(np.isin(molecules, molecules[near]))


def _separated(system: openmm.System) -> dict[str, set[int]]:
    """Give each of `KINDS` a force group, and return the groups of all surfaces."""
    fast = fast_force_groups(system)
    slow = {group for group in range(32) if not fast >> group & 1} - set(KINDS.values())
    for force in system.getForces():
        for kind, group in KINDS.items():
            if type(force).__name__ == BONDED[kind]:
                force.setForceGroup(group)
    alone = {kind: {group} for kind, group in KINDS.items()}
    return {"slow": slow, "fast": set(range(32)) - slow, **alone}


def _surfaces(
    context: openmm.Context, groups: dict[str, set[int]], positions: np.ndarray, moving: np.ndarray
) -> dict[str, Surface]:
    """Return surfaces, complete for the atoms that move, from differences of forces."""

    def gradients(coordinate: int | None = None, displacement: float = 0.0) -> dict[str, np.ndarray]:
        displaced = positions.copy()
        if coordinate is not None:
            displaced.flat[coordinate] += displacement
        context.setPositions(displaced)
        states = {name: context.getState(forces=True, groups=several) for name, several in groups.items()}
        return {name: -md(state.getForces(asNumpy=True)).ravel() for name, state in states.items()}

    curvatures = {name: np.zeros((positions.size, positions.size)) for name in groups}
    for coordinate in (3 * moving[:, None] + np.arange(3)).ravel().tolist():
        forward, backward = gradients(coordinate, DISPLACEMENT), gradients(coordinate, -DISPLACEMENT)
        for name, curvature in curvatures.items():
            curvature[coordinate] = (forward[name] - backward[name]) / (2 * DISPLACEMENT)
    at_minimum = gradients()
    return {name: Surface(at_minimum[name], (each + each.T) / 2) for name, each in curvatures.items()}


def masses_of(box: Minimum, case: Case) -> np.ndarray:
    """Return the masses of a case, (N,), dalton."""
    system = openmm.XmlSerializer.clone(box.system)
    set_hydrogen_masses(system, case.hydrogens)
    is_solute = np.isin(box.molecules, box.solute)
    return tables.masses(system) * np.where(is_solute, case.solute, 1.0)
