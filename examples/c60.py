#!/usr/bin/env python3
"""A crystal of 32 molecules of C60 at constant pressure: each is one body of sixty atoms, and turns freely.

Lennard-Jones atoms with the parameters of L. A. Girifalco, J. Phys. Chem. 96, 858 (1992).
"""

import argparse
import itertools
import sys

import numpy as np
import openmm
from openmm import app, unit

from openmm_sier import BodyType, RigidBodies, SIERLangevinIntegrator, add_bodies, prepare_system

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=500, help="of 40 fs (default: 500)")
steps = parser.parse_args().steps

golden = (1 + 5**0.5) / 2
corners = set()
for corner in ((0, 1, 3 * golden), (1, 2 + golden, 2 * golden), (golden, 2, 2 * golden + 1)):
    for signs in itertools.product((1, -1), repeat=3):
        for shift in range(3):
            corners.add(tuple(np.round(np.roll(np.multiply(corner, signs), shift), 12) + 0.0))
c60 = BodyType("C60", 0.072 * np.array(sorted(corners)), 60 * [12.011])  # bonds of 0.144 nm

edge = 2 * 1.417  # nm: two cells, cubic and face-centred
faces = 0.5 * np.array([[0, 0, 0], [0, 1, 1], [1, 0, 1], [1, 1, 0]])
centres = 1.417 * np.array([cell + face for cell in itertools.product(range(2), repeat=3) for face in faces])
system, topology = openmm.System(), app.Topology()
turns = np.random.default_rng(1).normal(size=(32, 4))
molecules, positions = add_bodies(system, topology, c60, centres, turns)
system.setDefaultPeriodicBoxVectors([edge, 0, 0], [0, edge, 0], [0, 0, edge])
topology.setPeriodicBoxVectors(system.getDefaultPeriodicBoxVectors())

force = openmm.NonbondedForce()
force.setNonbondedMethod(force.CutoffPeriodic)
force.setCutoffDistance(1.25)
force.setUseSwitchingFunction(True)
force.setSwitchingDistance(1.1)
for molecule in molecules:
    for i in molecule:
        force.addParticle(0, 0.3469, 0.2763)
        for j in range(molecule[0], i):
            force.addException(j, i, 0, 1, 0)  # pairs within a body do no work
system.addForce(force)

bodies = RigidBodies.from_types(system, {c60: molecules}, positions)
print(bodies, prepare_system(system, bodies, positions=positions), sep="\n")
integrator = SIERLangevinIntegrator(
    300, 1 / unit.picosecond, 40 * unit.femtoseconds, pressure=1 * unit.bar, bodies=bodies
)
simulation = app.Simulation(topology, system, integrator)
simulation.context.setPositions(positions)
simulation.minimizeEnergy()
simulation.context.setVelocitiesToTemperature(300)
first = integrator.getBodyState().A
columns = {"step": True, "potentialEnergy": True, "temperature": True, "volume": True}
simulation.reporters.append(app.StateDataReporter(sys.stdout, max(1, steps // 5), **columns))
simulation.step(steps)

# A[:, :, k] has the principal axes of body k as rows; of two rotations, 1 + 2 cos(angle) is the trace.
traces = np.einsum("abn,abn->n", integrator.getBodyState().A, first)
angles = np.degrees(np.arccos(np.clip((traces - 1) / 2, -1, 1)))
print(integrator.computeTemperatures())
print(f"in {0.04 * steps:g} ps the molecules have turned by {angles.mean():.0f} degrees on average")
