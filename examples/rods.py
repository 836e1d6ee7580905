#!/usr/bin/env python3
"""Rods in a bath: how far they move and turn, and how their directions agree, from their orientations."""

import argparse

import numpy as np
import openmm
from openmm import app, unit

from openmm_sier import BodyType, RigidBodies, SIERLangevinIntegrator, add_bodies, prepare_system

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=2000, help="of 20 fs (default: 2000)")
steps = parser.parse_args().steps

# Five beads on the x axis: a line, which has no moment about itself.
rod = BodyType("rod", [[0.3 * i, 0, 0] for i in range(-2, 3)], 5 * [50])
centres = np.array([[2 * x, y, z] for x in range(4) for y in range(8) for z in range(8)], dtype=float)
system, topology = openmm.System(), app.Topology()
rods, positions = add_bodies(system, topology, rod, centres)
system.setDefaultPeriodicBoxVectors([8, 0, 0], [0, 8, 0], [0, 0, 8])

force = openmm.CustomNonbondedForce("step(0.561231 - r)*(8*((0.5/r)^12 - (0.5/r)^6) + 2)")  # repulsive beads
force.setNonbondedMethod(force.CutoffPeriodic)
force.setCutoffDistance(0.6)
for body in rods:
    for i in body:
        force.addParticle([])
        for j in range(body[0], i):
            force.addExclusion(j, i)
system.addForce(force)

bodies = RigidBodies.from_types(system, {rod: rods}, positions)
print(bodies, prepare_system(system, bodies), sep="\n")
integrator = SIERLangevinIntegrator(300, 5 / unit.picosecond, 20 * unit.femtoseconds, bodies=bodies)
simulation = app.Simulation(topology, system, integrator)
simulation.context.setPositions(positions)
simulation.context.setVelocitiesToTemperature(300)
start = integrator.getBodyState()
for _ in range(5):
    simulation.step(max(1, steps // 5))
    state = integrator.getBodyState()
    # The first rows of A are axes without a moment, which are the rods.
    directions = state.A[0]
    order = np.linalg.eigvalsh(1.5 * directions @ directions.T / bodies.n - 0.5 * np.eye(3))[-1]
    moved = np.sqrt(((state.q - start.q) ** 2).sum(axis=0).mean())
    turned = (directions * start.A[0]).sum(axis=0).mean()
    time = simulation.context.getTime().value_in_unit(unit.picosecond)
    print(f"{time:6.1f} ps: moved by {moved:.2f} nm, cosine to the start {turned:.2f}, nematic order {order:.2f}")
kinetic = bodies.kinetic_energies_by_axis(integrator.getBodyState()).mean(axis=2)
print("kinetic energies in kT/2, along and about the axes:", (kinetic / (0.5 * 0.00831446 * 300)).round(2).tolist())
