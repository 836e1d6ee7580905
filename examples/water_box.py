#!/usr/bin/env python3
"""A box of liquid water with the stock Simulation and reporters: two lines are new, preparation and integrator."""

import argparse
from io import StringIO
from pathlib import Path
from sys import stdout

import numpy as np
from openmm.app import PME, ForceField, PDBFile, Simulation, StateDataReporter
from openmm.unit import femtosecond, kelvin, nanometer

# from openmm import VerletIntegrator
from openmm_sier import SIERIntegrator, prepare_system

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=250, help="of 4 fs (default: 250)")
steps = parser.parse_args().steps

pdb = PDBFile(str(Path(__file__).parent.parent / "systems" / "tip3p-512.pdb"))
forcefield = ForceField("tip3p.xml")
system = forcefield.createSystem(
    pdb.topology,
    nonbondedMethod=PME,
    nonbondedCutoff=0.9 * nanometer,
    switchDistance=0.75 * nanometer,
    rigidWater=True,
)
prepare_system(system)  # more exact forces, as fast as before

# integrator = VerletIntegrator(1 * femtosecond)
integrator = SIERIntegrator(4 * femtosecond, "SIER4")  # as many force evaluations per ps as the line above

simulation = Simulation(pdb.topology, system, integrator)
simulation.context.setPositions(pdb.positions)
simulation.context.setVelocitiesToTemperature(297 * kelvin, 1)
energies = StringIO()
every = max(1, steps // 50)
columns = {"potentialEnergy": True, "totalEnergy": True}
simulation.reporters.append(StateDataReporter(energies, every, **columns))
simulation.reporters.append(
    StateDataReporter(stdout, max(1, steps // 10), step=True, time=True, temperature=True, speed=True, **columns)
)
simulation.step(steps)

potential, total = np.loadtxt(StringIO(energies.getvalue()), delimiter=",", ndmin=2).T
print(f"\nThe potential energy fluctuates by {potential.std():.1f} kJ/mol,")
share = total.std() / potential.std()
print(f"the total energy, which should not change, by {total.std():.3f} kJ/mol: {share:.3%} of it.")
