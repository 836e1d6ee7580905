#!/usr/bin/env python3
"""Gay-Berne ellipsoids at constant energy: with ex = ey = ez forces of OpenMM's GayBerneForce are exact.

With unequal well depths they are not the gradient of the energy, and no integrator conserves it: take attractive sites
on the body instead.
"""

import argparse

import numpy as np
import openmm
from openmm import app, unit

from openmm_sier import BodyType, RigidBodies, SIERIntegrator, add_bodies, check_forces, prepare_system

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=200, help="of 20 fs (default: 200)")
steps = parser.parse_args().steps

# OpenMM reads the axes x and y of an ellipsoid from two other particles. They have no mass: the moments are those of a
# solid ellipsoid with these radii, about x, y and z.
x, y, z = radii = 0.2, 0.2, 0.5
mass = 300.0
moments = mass / 5 * np.array([y * y + z * z, x * x + z * z, x * x + y * y])
ellipsoid = BodyType("ellipsoid", [[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]], [mass, 0, 0], moments)

centres = 0.95 * np.array([[i, j, k] for i in range(4) for j in range(4) for k in range(4)])
turns = np.random.default_rng(1).normal(size=(64, 4))
system, topology = openmm.System(), app.Topology()
lists, positions = add_bodies(system, topology, ellipsoid, centres, turns)
system.setDefaultPeriodicBoxVectors([3.8, 0, 0], [0, 3.8, 0], [0, 0, 3.8])

force = openmm.GayBerneForce()
force.setNonbondedMethod(force.CutoffPeriodic)
force.setCutoffDistance(1.8)
force.setUseSwitchingFunction(True)
force.setSwitchingDistance(1.4)
for _, along_x, along_y in lists:
    force.addParticle(0.4, 2.0, along_x, along_y, *radii, 1, 1, 1)
    for _ in (along_x, along_y):
        force.addParticle(0.4, 0, -1, -1, 1, 1, 1, 1, 1, 1)
system.addForce(force)

bodies = RigidBodies.from_types(system, {ellipsoid: lists}, positions)
print(bodies, prepare_system(system, bodies), sep="\n")
integrator = SIERIntegrator(20 * unit.femtoseconds, bodies=bodies)
simulation = app.Simulation(topology, system, integrator)
simulation.context.setPositions(positions)
simulation.minimizeEnergy(maxIterations=50)
simulation.context.setVelocitiesToTemperature(300, 1)
print(check_forces(simulation.context))
energies = []
for _ in range(steps):
    simulation.step(1)
    state = simulation.context.getState(energy=True)
    energies.append([state.getPotentialEnergy()._value, state.getKineticEnergy()._value])
potential, kinetic = np.array(energies).T
print(f"the potential energy fluctuates by {potential.std():.1f} kJ/mol, the sum by {(potential + kinetic).std():.1e}")
