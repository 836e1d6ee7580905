"""Largest differences of a component of a force between two evaluations at the same positions, on the CPU platform.

    OPENMM_CPU_THREADS=1 python -m studies.checks.repeatability
    OPENMM_CPU_THREADS=2 python -m studies.checks.repeatability

512 molecules of TIP3P, PME, cut-off 0.9 nm. The number of threads is that of the variable, which OpenMM reads when it
is imported. With one thread what is left comes from the neighbour list, which remembers positions between evaluations.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import openmm
from openmm import app, unit

BOX = Path(__file__).parents[2] / "systems" / "tip3p-512.pdb"

#: How far all atoms are moved, in random directions, between two evaluations, nm.
DISTANCES = (0.001, 0.02, 0.05, 0.1, 0.2)


class Forces:
    """Forces of the box in one Context."""

    def __init__(self) -> None:
        pdb = app.PDBFile(str(BOX))
        self.positions = pdb.getPositions(asNumpy=True).value_in_unit(unit.nanometer)
        system = app.ForceField("tip3p.xml").createSystem(
            pdb.topology, nonbondedMethod=app.PME, nonbondedCutoff=0.9 * unit.nanometer
        )
        platform = openmm.Platform.getPlatformByName("CPU")
        properties = {"Threads": os.environ.get("OPENMM_CPU_THREADS", ""), "DeterministicForces": "true"}
        self.context = openmm.Context(system, openmm.VerletIntegrator(0.001), platform, properties)

    def at(self, positions: np.ndarray) -> np.ndarray:
        """Forces (N, 3) in kJ/mol/nm."""
        self.context.setPositions(positions)
        forces = self.context.getState(forces=True).getForces(asNumpy=True)
        return np.array(forces.value_in_unit(unit.kilojoule_per_mole / unit.nanometer))

    def here(self) -> np.ndarray:
        """Those at the positions of the file."""
        return self.at(self.positions)


def differences() -> dict[str, float]:
    """The largest difference for each way of evaluating twice, kJ/mol/nm."""
    forces, random = Forces(), np.random.default_rng(1)
    first = forces.here()
    found = {
        "the same Context again": np.abs(forces.here() - first).max(),
        "a new Context": np.abs(Forces().here() - first).max(),
    }
    for distance in DISTANCES:
        direction = random.standard_normal(forces.positions.shape)
        forces.context.reinitialize()  # forgets the list, so that the next is that of the positions moved to
        forces.at(forces.positions + distance * direction / np.linalg.norm(direction, axis=1, keepdims=True))
        found[f"after positions {distance:g} nm away"] = np.abs(forces.here() - first).max()
    return {what: float(value) for what, value in found.items()}


def main() -> None:
    print(f"OPENMM_CPU_THREADS={os.environ.get('OPENMM_CPU_THREADS', '')}; kJ/mol/nm")
    for what, value in differences().items():
        print(f"{what:32s} {value:.2g}")


if __name__ == "__main__":
    main()
