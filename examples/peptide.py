#!/usr/bin/env python3
"""A solvated peptide with constrained hydrogens, at 297 K and 1 bar: steps of 6 fs, bonded forces in inner steps."""

import argparse
from pathlib import Path

from openmm.app import PME, ForceField, HBonds, PDBFile, Simulation
from openmm.unit import bar, femtosecond, kelvin, nanometer, picosecond

from openmm_sier import SIERLangevinIntegrator, prepare_system
from openmm_sier.observe.reporters import ConservationReporter

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=500, help="of 6 fs (default: 500)")
steps = parser.parse_args().steps

pdb = PDBFile(str(Path(__file__).parent.parent / "systems" / "peptide.pdb"))
forcefield = ForceField("amber14-all.xml", "amber14/tip3p.xml")
system = forcefield.createSystem(
    pdb.topology,
    nonbondedMethod=PME,
    nonbondedCutoff=0.9 * nanometer,
    switchDistance=0.75 * nanometer,
    constraints=HBonds,
)
print(prepare_system(system))

integrator = SIERLangevinIntegrator(297 * kelvin, 1 / picosecond, 6 * femtosecond, pressure=1 * bar)
simulation = Simulation(pdb.topology, system, integrator)
simulation.context.setPositions(pdb.positions)
simulation.context.setVelocitiesToTemperature(297 * kelvin, 1)
simulation.reporters.append(ConservationReporter("peptide.csv", max(1, steps // 50)))
simulation.step(steps)

found = integrator.computeTemperatures().in_kelvin()
print(f"water's translation at {found.translation:.0f} K, its rotation at {found.rotation:.0f} K,")
print(f"the peptide at {found.flexible:.0f} K after {steps} steps; peptide.csv has the conserved energy.")
