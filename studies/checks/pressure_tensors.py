"""The pressure tensor of this package beside that of OpenMM's MonteCarloFlexibleBarostat.

    python -m studies.checks.pressure_tensors

512 molecules of TIP3P on the Reference platform, one state. The third row is this package's tensor with two choices
of OpenMM in place of its own: centres of molecules are the means of their atoms, not centres of mass, and the shear is
simple: it is not symmetrized, and leaves the orientation of molecules as it is.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import openmm
from openmm import app, unit

from openmm_sier.observe import pressure

BOX = Path(__file__).parents[2] / "systems" / "tip3p-512.pdb"


class GeometricCentres(pressure.MolecularPressure):
    """With OpenMM's choices: centres that are means of the atoms, and simple shears."""

    def __init__(self, context: openmm.Context) -> None:
        super().__init__(context)
        self._strains = [
            (_shear(axes, pressure.STRAIN), _shear(axes, -pressure.STRAIN)) for axes in pressure.COMPONENTS
        ]

    def _slopes(self, positions: np.ndarray, box: np.ndarray) -> np.ndarray:
        masses, totals = self._masses, self._molecule_masses
        self._masses = np.ones_like(masses)
        self._molecule_masses = np.bincount(self._owners).astype(float)
        slopes = super()._slopes(positions, box)
        self._masses, self._molecule_masses = masses, totals
        return slopes


def _shear(axes: tuple[int, int], size: float) -> tuple[np.ndarray, np.ndarray]:
    stretch = np.eye(3)
    stretch[axes] += size
    return stretch, np.eye(3)


def main() -> None:
    pdb = app.PDBFile(str(BOX))
    system = app.ForceField("tip3p.xml").createSystem(
        pdb.topology, nonbondedMethod=app.PME, nonbondedCutoff=0.9 * unit.nanometer
    )
    barostat = openmm.MonteCarloFlexibleBarostat(1, 297, 0)
    system.addForce(barostat)
    platform = openmm.Platform.getPlatformByName("Reference")
    context = openmm.Context(system, openmm.LangevinMiddleIntegrator(297, 1, 0.002), platform)
    context.setPositions(pdb.positions)
    context.setVelocitiesToTemperature(297, 1)
    context.getIntegrator().step(50)
    state = context.getState(positions=True, velocities=True)
    theirs = -np.array([value.value_in_unit(unit.bar) for value in barostat.computeStressTensor(context, True)])
    print("bar" + " " * 28 + "".join(f"{'xyz'[i]}{'xyz'[j]:>1}".rjust(9) for i, j in pressure.COMPONENTS))
    for name, tensor in (
        ("this package", pressure.MolecularPressure(context).components(state)),
        ("computeStressTensor", theirs),
        ("this package, OpenMM's choices", GeometricCentres(context).components(state)),
    ):
        print(f"{name:31s}" + "".join(f"{value:9.1f}" for value in tensor))


if __name__ == "__main__":
    main()
