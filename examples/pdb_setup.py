#!/usr/bin/env python3
"""From a PDB file to a trajectory, step by step: salt water, with the force field of the ions from your own XML."""

import argparse
from io import StringIO
from pathlib import Path

from openmm.app import PME, DCDReporter, ForceField, Modeller, PDBFile, Simulation
from openmm.unit import femtosecond, kelvin, kilojoule_per_mole, nanometer

from openmm_sier import RigidBodies, SIERIntegrator, prepare_system

# The ions of Joung and Cheatham (J. Phys. Chem. B 112, 9020 (2008)) for TIP3P water; lengths in nm, energies in kJ/mol.
IONS = """
<ForceField>
 <AtomTypes>
  <Type name="my-Na" class="my-Na" element="Na" mass="22.99"/>
  <Type name="my-Cl" class="my-Cl" element="Cl" mass="35.45"/>
 </AtomTypes>
 <Residues>
  <Residue name="NA"><Atom name="NA" type="my-Na"/></Residue>
  <Residue name="CL"><Atom name="CL" type="my-Cl"/></Residue>
 </Residues>
 <NonbondedForce coulomb14scale="0.833333" lj14scale="0.5">
  <Atom type="my-Na" charge="1" sigma="0.2439281" epsilon="0.3658460"/>
  <Atom type="my-Cl" charge="-1" sigma="0.4477657" epsilon="0.1489127"/>
 </NonbondedForce>
</ForceField>
"""

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=250, help="of 4 fs (default: 250)")
parser.add_argument("--out", default="salt.dcd", help="trajectory (default: salt.dcd)")
options = parser.parse_args()

pdb = PDBFile(str(Path(__file__).parent.parent / "systems" / "tip3p-nacl-512.pdb"))
forcefield = ForceField("tip3p.xml", StringIO(IONS))
modeller = Modeller(pdb.topology, pdb.positions)
modeller.addExtraParticles(forcefield)  # the virtual sites of TIP4P or TIP5P; TIP3P has none
system = forcefield.createSystem(
    modeller.topology,
    nonbondedMethod=PME,
    nonbondedCutoff=0.9 * nanometer,
    switchDistance=0.75 * nanometer,
    rigidWater=True,
)
print(prepare_system(system))

# The integrator finds the bodies by itself; here it gets them, so that they can be shown.
bodies = RigidBodies.from_system(system, modeller.topology)
for species in bodies.species:
    name = list(modeller.topology.atoms())[species.atoms[0, 0]].residue.name
    freedoms = species.dof
    print(f"{len(species.atoms):4d} x {name:3}  {species.mass:7.3f} dalton, {freedoms} degrees of freedom")

integrator = SIERIntegrator(4 * femtosecond, "SIER4", bodies=bodies)
simulation = Simulation(modeller.topology, system, integrator)
simulation.context.setPositions(modeller.positions)
simulation.context.setVelocitiesToTemperature(297 * kelvin, 1)
simulation.reporters.append(DCDReporter(options.out, max(1, options.steps // 10)))
simulation.step(options.steps)

state = simulation.context.getState(energy=True)
_, translation, rotation, _ = integrator.computeTemperatures().in_kelvin()
potential = state.getPotentialEnergy().value_in_unit(kilojoule_per_mole)
print(f"after {options.steps} steps the potential energy is {potential:.0f} kJ/mol,")
print(f"translation at {translation:.0f} K, rotation at {rotation:.0f} K; the trajectory is in {options.out}")
