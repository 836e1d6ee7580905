#!/usr/bin/env python3
"""An ideal gas between a rigid wall, which stays, and a rigid piston, on which a constant force acts.

The wall is made of particles without mass, which OpenMM leaves where they are. The piston is a body.
"""

import argparse

import numpy as np
import openmm
from openmm import app, unit

from openmm_sier import BodyType, RigidBodies, SIERLangevinIntegrator, add_bodies, prepare_system

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=10000, help="of 20 fs (default: 10000)")
steps = parser.parse_args().steps

N, EDGE, SPACING, PUSH, KT = 60, 3.0, 0.375, 60.0, 0.00831446 * 300  # kJ/mol/nm on the piston, and kJ/mol
square = SPACING * np.array([[x, y, 0] for x in range(-4, 5) for y in range(-4, 5)])
plate = BodyType("plate", square, len(square) * [2])
system, topology = openmm.System(), app.Topology()
pistons, positions = add_bodies(system, topology, plate, [[0, 0, 4]])
(piston,) = pistons
random = np.random.default_rng(1)
atom = BodyType("atom", [[0, 0, 0]], [40])
gas, places = add_bodies(system, topology, atom, random.uniform([-1.2, -1.2, 0.5], [1.2, 1.2, 3.5], (N, 3)))
chain = topology.addChain()
wall = [system.addParticle(0) for _ in square]
for _ in wall:
    topology.addAtom("W", None, topology.addResidue("wall", chain))
positions = np.concatenate([positions, places, square])

# The gas is ideal, but for its contacts with wall and piston, and sides that hold it.
contacts = openmm.CustomNonbondedForce("step(0.4 - r)*500*(0.4 - r)^2")
contacts.addInteractionGroup([i for body in gas for i in body], piston + wall)
for _ in positions:
    contacts.addParticle([])
sides = openmm.CustomExternalForce(f"500*(max(0, abs(x) - {EDGE / 2})^2 + max(0, abs(y) - {EDGE / 2})^2)")
for (i,) in gas:
    sides.addParticle(i)

# A constant force in the lab. Springs keep the piston level and in the middle.
push = openmm.CustomExternalForce(f"{PUSH / len(piston)}*z + 50*((x - x0)^2 + (y - y0)^2)")
push.addPerParticleParameter("x0")
push.addPerParticleParameter("y0")
for i in piston:
    push.addParticle(i, positions[i, :2])
level = openmm.CustomCompoundBondForce(4, "1000*((z1 - z2)^2 + (z3 - z4)^2)")
level.addBond([piston[0], piston[-1], piston[8], piston[-9]])
for force in (contacts, sides, push, level):
    system.addForce(force)

bodies = RigidBodies.from_types(system, {plate: pistons, atom: gas}, positions)
print(bodies, prepare_system(system, bodies, positions=positions), sep="\n")
integrator = SIERLangevinIntegrator(300, 0.5 / unit.picosecond, 20 * unit.femtoseconds, bodies=bodies)
simulation = app.Simulation(topology, system, integrator)
simulation.context.setPositions(positions)
simulation.minimizeEnergy()
simulation.context.setVelocitiesToTemperature(300, 1)
simulation.step(steps // 5)
heights = []
for _ in range(steps // 10):
    simulation.step(10)
    heights.append(integrator.getBodyState().q[2, 0])
# The mean height of an ideal gas of N atoms under a weight; the contacts reach some 0.3 nm from wall and piston.
expected = (N + 1) * KT / PUSH + 0.6
print(f"height of the piston {np.mean(heights):.2f} nm; that of an ideal gas with its contacts is {expected:.2f} nm")
