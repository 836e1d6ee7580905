"""The net force that PME leaves on a box of water, with the sums as OpenMM splits them and balanced.

    python -m studies.checks.net_force

It should be zero, since all forces are between particles. What is left pushes the centre of mass of a run at constant
energy. Lennard-Jones is switched from 0.75 to 0.9 nm; the mean is over 20 states 20 fs apart.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import openmm
from openmm import app, unit

from openmm_sier import balance_pme

SYSTEMS = Path(__file__).parents[2] / "systems"
BOXES = {"tip3p-512.pdb": "tip3p.xml", "spce-512.pdb": "spce.xml"}
STATES, STEPS = 20, 10


def net_force(box: str, tolerance: float, balanced: bool, states: int = STATES) -> float:
    """Mean magnitude of the sum of all forces, kJ/mol/nm."""
    pdb = app.PDBFile(str(SYSTEMS / box))
    system = app.ForceField(BOXES[box]).createSystem(
        pdb.topology,
        nonbondedMethod=app.PME,
        nonbondedCutoff=0.9 * unit.nanometer,
        switchDistance=0.75 * unit.nanometer,
        ewaldErrorTolerance=tolerance,
    )
    if balanced:
        balance_pme(system)
    context = openmm.Context(system, openmm.VerletIntegrator(0.002), openmm.Platform.getPlatformByName("CPU"))
    context.setPositions(pdb.positions)
    context.setVelocitiesToTemperature(297, 1)
    found = []
    for _ in range(states):
        context.getIntegrator().step(STEPS)
        forces = context.getState(forces=True).getForces(asNumpy=True)
        found.append(np.linalg.norm(forces.value_in_unit(unit.kilojoule_per_mole / unit.nanometer).sum(axis=0)))
    return float(np.mean(found))


def main() -> None:
    print("box            tolerance   as OpenMM splits   balanced, kJ/mol/nm")
    for box in BOXES:
        for tolerance in (5e-4, 1e-4):
            split, balanced = (net_force(box, tolerance, done) for done in (False, True))
            print(f"{box:14s} {tolerance:9g} {split:18.2f} {balanced:10.2f}")


if __name__ == "__main__":
    main()
