"""Liquid water as OpenMM Systems: with the paper's smooth molecular cut-off, and with PME; and starts of runs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import openmm

from openmm_sier.dynamics.schemes import SIER2
from openmm_sier.inputs import forcefields
from openmm_sier.inputs.equilibration import equilibrate
from openmm_sier.integrators.integrator import SIERIntegrator
from studies import boxes
from studies.command import SYSTEMS
from studies.paper import tip4p
from studies.paper.molecular_cutoff import MolecularCutoff
from studies.units import md

#: The project's box of the paper's water.
BOX = "tip4p-512.pdb"

#: Threads of OpenMM in the process of a run, of which there are as many as cores.
THREADS = "1"


@dataclass(frozen=True)
class Cutoffs:
    """Cut-offs of the interactions of a liquid.

    Attributes:
        molecular_on, molecular_off: distances of the oxygens, nm, between which the interaction of two molecules is
            switched off.
        pme: direct-space cut-off of the PME system, nm.
        pme_switch: where its Lennard-Jones interaction starts to be switched off, nm.
        ewald_tolerance: OpenMM's ewaldErrorTolerance. The direct-space sum is cut, not switched, at `pme`; at OpenMM's
            default of 5e-4 the jump hides the error of a fourth-order integrator.
    """

    molecular_on: float = 0.9
    molecular_off: float = 1.1
    pme: float = 1.1
    pme_switch: float = 0.9
    ewald_tolerance: float = 1e-6


MOLECULAR, PME = "molecular cut-off", "PME"


class Water(NamedTuple):
    """Molecules in a cube: a System of theirs, positions (4 n, 3) in nm of O, H, H, M, and the edge in nm."""

    system: openmm.System
    positions: np.ndarray
    edge: float

    @property
    def molecules(self) -> int:
        return len(self.positions) // 4


def water_box(n: int) -> Water:
    """Liquid TIP4P water: the project's box, or molecules of it in a smaller box of the same density."""
    box = boxes.of_size(forcefields.read_box(SYSTEMS / BOX), SYSTEMS, n)
    return Water(box.system, box.positions, md(box.system.getDefaultPeriodicBoxVectors()[0][0]))


def build(kind: str, water: Water, cutoffs: Cutoffs) -> openmm.System:
    """The System of a box with one of the two interactions.

    Args:
        kind: `MOLECULAR` or `PME`.
        water: the box.
        cutoffs: where the interactions end.

    Raises:
        ValueError: the kind is unknown or the box too small.
    """
    if kind not in (MOLECULAR, PME):
        raise ValueError(f"the kind of liquid must be one of {MOLECULAR}, {PME}, got {kind!r}")
    system = openmm.XmlSerializer.clone(water.system)
    (nonbonded,) = (i for i, force in enumerate(system.getForces()) if isinstance(force, openmm.NonbondedForce))
    if kind == MOLECULAR:
        while system.getNumForces():
            system.removeForce(0)
        system.addForce(molecular_force(water.edge, cutoffs))
    else:
        _set_pme(system.getForce(nonbonded), cutoffs)
    return system


def molecular_force(edge: float, cutoffs: Cutoffs) -> openmm.Force:
    """The interaction with a smooth molecular cut-off, see `MolecularCutoff`."""
    potential = MolecularCutoff(tip4p.SIGMA, tip4p.EPSILON, tip4p.CHARGE, cutoffs.molecular_on, cutoffs.molecular_off)
    potential.check_box(np.full(3, edge))
    force = openmm.PythonForce(potential)
    force.setUsesPeriodicBoundaryConditions(True)
    return force


def _set_pme(force: openmm.NonbondedForce, cutoffs: Cutoffs) -> None:
    """OpenMM's own sums, without the correction for the tail of Lennard-Jones, a constant."""
    force.setCutoffDistance(cutoffs.pme)
    force.setUseSwitchingFunction(True)
    force.setSwitchingDistance(cutoffs.pme_switch)
    force.setEwaldErrorTolerance(cutoffs.ewald_tolerance)
    force.setPMEParameters(0, 0, 0, 0)
    force.setUseDispersionCorrection(False)


def context(system: openmm.System, integrator: openmm.Integrator, kind: str) -> openmm.Context:
    """A Context for a liquid, in double precision with the molecular cut-off.

    The PME system runs as its users run it: on the CPU platform, whose nonbonded forces are in single precision.
    """
    if kind == MOLECULAR:
        return openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
    platform = openmm.Platform.getPlatformByName("CPU")
    return openmm.Context(system, integrator, platform, {"DeterministicForces": "true", "Threads": THREADS})


def phase_point(
    water: Water, kind: str, cutoffs: Cutoffs, temperature: float, time: float | None, seed: int
) -> openmm.State:
    """Positions and velocities from a run at constant temperature with an interaction of the two.

    Args:
        water: the box, which is minimized first.
        kind, cutoffs: see `build`.
        temperature: K.
        time: of the run, ps; None goes on until the liquid has settled.
        seed: of bath and velocities.
    """
    simulation = context(build(kind, water, cutoffs), SIERIntegrator(0.001, SIER2), kind)
    simulation.setPositions(water.positions)
    simulation.computeVirtualSites()
    simulation.applyConstraints(1e-6)
    openmm.LocalEnergyMinimizer.minimize(simulation, 100.0)
    equilibrate(simulation, temperature, seed, time)
    return simulation.getState(positions=True, velocities=True)
