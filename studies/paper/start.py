"""Where the runs of liquid water start."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import openmm
from openmm import app, unit

from openmm_sier.measure.forcefields import SHIPPED
from studies.paper import liquids, tip4p
from studies.paper.molecular_cutoff import SITES

#: An equilibrated box that comes with the project, and its number of molecules.
BOX, BOX_MOLECULES = "tip4p-512.pdb", 512

#: OpenMM's LangevinMiddleIntegrator: friction in 1/ps and step in ps.
FRICTION, STEP = 5.0, 0.004

#: A box that has to be made melts at 400 K and cools down, ps each.
MELTING, COOLING = 4.0, 6.0


@dataclass(frozen=True)
class Box:
    """Molecules in a cube: positions (4 n, 3) in nm of O, H, H, M, edge in nm, and where they come from."""

    positions: np.ndarray
    edge: float
    origin: str

    @property
    def molecules(self) -> int:
        return len(self.positions) // SITES


def water_box(n: int, cutoffs: liquids.Cutoffs, temperature: float, seed: int) -> Box:
    """Liquid TIP4P water at its experimental density: the project's box if it has as many molecules, else a new one."""
    if n == BOX_MOLECULES:
        for directory in SHIPPED:
            if (directory / BOX).is_file():
                return read_box(directory / BOX)
    return make_box(n, cutoffs, temperature, seed)


def read_box(path: Path) -> Box:
    """A PDB file of water, sites O, H and H with or without M after them.

    Raises:
        ValueError: there is no cubic box, or something else than such water.
    """
    pdb = app.PDBFile(str(path))
    vectors = pdb.topology.getPeriodicBoxVectors()
    if vectors is None:
        raise ValueError(f"{path} has no CRYST1 record with the periodic box")
    edges = np.diag(vectors.value_in_unit(unit.nanometer))
    if np.ptp(edges) > 1e-6:
        raise ValueError(f"{path} must hold a cubic box, got edges of {edges} nm")
    names = [[atom.name for atom in residue.atoms()][:3] for residue in pdb.topology.residues()]
    sizes = {residue.name + str(len(list(residue.atoms()))) for residue in pdb.topology.residues()}
    if any(name != ["O", "H1", "H2"] for name in names) or len(sizes) != 1:
        raise ValueError(f"{path} must hold water alone, its atoms in the order O, H1, H2")
    r = np.array(pdb.positions.value_in_unit(unit.nanometer)).reshape(len(names), -1, 3)
    return Box(_with_m(r[:, :3]), float(edges[0]), path.name)


def make_box(n: int, cutoffs: liquids.Cutoffs, temperature: float, seed: int) -> Box:
    """A new box: molecules with random orientations on a lattice, melted and cooled with PME."""
    edge = tip4p.box_edge(n)
    rng = np.random.default_rng(seed)
    side = math.ceil(n ** (1 / 3) - 1e-9)
    places = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    places = places[np.sort(rng.permutation(side**3)[:n])] * (edge / side)
    attitudes = tip4p.canonical_rotation(tip4p.molecules(n), temperature, rng).A
    r = places[:, None, :] + np.einsum("ka,abn->nkb", tip4p.GEOMETRY, attitudes)

    # A liquid needs no smooth forces to mix.
    system = liquids.build(liquids.PME, n, edge, replace(cutoffs, ewald_tolerance=5e-4))
    context = liquids.context(system, _langevin(400.0, seed), liquids.PME)
    context.setPositions(_with_m(r))
    openmm.LocalEnergyMinimizer.minimize(context, 100.0)
    context.setVelocitiesToTemperature(400.0, seed)
    integrator = context.getIntegrator()
    for kelvin, length in ((400.0, MELTING), (temperature, COOLING)):
        integrator.setTemperature(kelvin)
        integrator.step(round(length / STEP))
    return Box(_positions(context), edge, f"made from a lattice in {MELTING + COOLING:g} ps, seed {seed}")


def phase_points(
    box: Box, kind: str, cutoffs: liquids.Cutoffs, temperature: float, relax: float, count: int, seed: int
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Positions and fresh velocities (N, 3) from which independent runs start, one after another.

    Args:
        box: the liquid.
        kind: of the System, see `liquids.build`; the box is relaxed in it.
        cutoffs: of the System.
        temperature: K.
        relax: time in ps before the first phase point and between two.
        count: how many.
        seed: of bath and velocities.
    """
    system = liquids.build(kind, box.molecules, box.edge, cutoffs)
    context = liquids.context(system, _langevin(temperature, seed), kind)
    context.setPositions(box.positions)
    context.setVelocitiesToTemperature(temperature, seed)
    for i in range(count):
        context.getIntegrator().step(max(1, round(relax / STEP)))
        positions = _positions(context)
        context.setVelocitiesToTemperature(temperature, seed + 1 + i)
        velocities = context.getState(velocities=True).getVelocities(asNumpy=True)
        yield positions, velocities.value_in_unit(unit.nanometer / unit.picosecond)


def _langevin(temperature: float, seed: int) -> openmm.Integrator:
    integrator = openmm.LangevinMiddleIntegrator(temperature, FRICTION, STEP)
    integrator.setRandomNumberSeed(seed)
    return integrator


def _positions(context: openmm.Context) -> np.ndarray:
    return context.getState(positions=True).getPositions(asNumpy=True).value_in_unit(unit.nanometer)


def _with_m(r: np.ndarray) -> np.ndarray:
    """Positions (n, 3 sites, 3) of O, H, H to those of O, H, H, M, (4 n, 3)."""
    w = tip4p.M_WEIGHT
    m = (1 - 2 * w) * r[:, 0] + w * (r[:, 1] + r[:, 2])
    return np.concatenate([r, m[:, None, :]], axis=1).reshape(-1, 3)
