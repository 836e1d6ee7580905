#!/usr/bin/env python3
"""500 patchy colloids of two types, from nothing to a trajectory with orientations, patchy.gsd, which OVITO shows."""

import numpy as np
import openmm
from openmm import app, unit

from openmm_sier import BodyType, RigidBodies, SIERLangevinIntegrator, add_bodies, prepare_system
from openmm_sier.observe.gsd_reporter import GSDReporter

# Solid spheres 1 nm across, whose patches have no mass: the moments are given.
tetrahedron = 0.5 / 3**0.5 * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
node = BodyType("node", [[0, 0, 0], *tetrahedron], [1000, 0, 0, 0, 0], moments=[100, 100, 100])
link = BodyType("link", [[0, 0, 0], [0.5, 0, 0], [-0.25, 0.433, 0]], [1000, 0, 0], moments=[100, 100, 100])

random = np.random.default_rng(1)
places = 1.4 * random.permutation([[x, y, z] for x in range(8) for y in range(8) for z in range(8)])
turns = random.normal(size=(500, 4))  # quaternions of any length
system, topology = openmm.System(), app.Topology()
nodes, first = add_bodies(system, topology, node, places[:150], turns[:150])
links, second = add_bodies(system, topology, link, places[150:500], turns[150:])
positions = np.concatenate([first, second])
system.setDefaultPeriodicBoxVectors([11.2, 0, 0], [0, 11.2, 0], [0, 0, 11.2])

force = openmm.CustomNonbondedForce(
    "core1*core2*step(1.122462 - r)*(10*(r^-12 - r^-6) + 2.5) - (1 - core1)*(1 - core2)*12*exp(-50*r^2)"
)
force.addPerParticleParameter("core")
force.setNonbondedMethod(force.CutoffPeriodic)
force.setCutoffDistance(1.15)
for body in nodes + links:
    for i in body:
        force.addParticle([i == body[0]])
        for j in range(body[0], i):
            force.addExclusion(j, i)
system.addForce(force)

bodies = RigidBodies.from_types(system, {node: nodes, link: links}, positions)
print(bodies, prepare_system(system, bodies), sep="\n")
friction = {"node": 2, "link": (2, 2, 4)}  # 1/ps, about each axis
integrator = SIERLangevinIntegrator(300, 1, 40 * unit.femtoseconds, bodies=bodies, rotationalFriction=friction)
simulation = app.Simulation(topology, system, integrator)
simulation.context.setPositions(positions)
simulation.context.setVelocitiesToTemperature(300)
simulation.reporters.append(GSDReporter("patchy.gsd", 100))
simulation.step(1000)
print(integrator.computeTemperatures(), bodies.orientations(integrator.getBodyState()), sep="\n")
