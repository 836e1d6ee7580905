"""The net force that PME leaves on a box of water, with the sums as OpenMM splits them and balanced.

    python -m studies.checks.net_force

It should be zero, since all forces are between particles. What is left pushes the centre of mass of a run at constant
energy. Lennard-Jones is switched from 0.75 to 0.9 nm; the mean is over 20 states 20 fs apart.
"""

from __future__ import annotations

import numpy as np
import openmm

from openmm_sier.inputs import forcefields
from openmm_sier.inputs.forcefields import Interactions
from studies import boxes
from studies.command import SYSTEMS
from studies.units import md

BOXES = ("tip3p-512.pdb", "spce-512.pdb")
STATES, STEPS = 20, 10


def net_force(box: str, tolerance: float, balanced: bool, states: int = STATES) -> float:
    """Mean magnitude of the sum of all forces, kJ/mol/nm."""
    found = forcefields.read_box(SYSTEMS / box, interactions=Interactions(0.9, 0.75, tolerance))
    system = found.system if balanced else boxes.split_by_openmm(found.system)
    context = openmm.Context(system, openmm.VerletIntegrator(0.002), openmm.Platform.getPlatformByName("CPU"))
    context.setPositions(found.positions)
    context.setVelocitiesToTemperature(297, 1)
    sizes = []
    for _ in range(states):
        context.getIntegrator().step(STEPS)
        forces = md(context.getState(forces=True).getForces(asNumpy=True))
        sizes.append(np.linalg.norm(forces.sum(axis=0)))
    return float(np.mean(sizes))


def main() -> None:
    print("box            tolerance   as OpenMM splits   balanced, kJ/mol/nm")
    for box in BOXES:
        for tolerance in (5e-4, 1e-4):
            split, balanced = (net_force(box, tolerance, done) for done in (False, True))
            print(f"{box:14s} {tolerance:9g} {split:18.2f} {balanced:10.2f}")


if __name__ == "__main__":
    main()
