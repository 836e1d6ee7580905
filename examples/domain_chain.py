#!/usr/bin/env python3
"""A protein of one bead per residue with two folded domains, which are rigid, on flexible linkers.

Bonds and sticky beads in the manner of HPS and CALVADOS; a domain is a bundle of beads, named by its residues.
"""

import argparse
import itertools
import sys

import numpy as np
import openmm
from openmm import app, unit

from openmm_sier import RigidBodies, SIERLangevinIntegrator, prepare_system, select_bodies

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=2000, help="of 40 fs (default: 2000)")
steps = parser.parse_args().steps

BOND, STIFFNESS, MASS = 0.38, 8033.0, 110.0  # nm, kJ/mol/nm^2, dalton


def bundle():
    """Return 36 beads along a path through a brick of 3 x 4 x 3, a bond apart."""
    path = []
    for x in range(3):
        rows = [[(x, y, z) for z in range(3)[:: (-1) ** (4 * x + y)]] for y in range(4)]
        path += itertools.chain(*rows[:: (-1) ** x])
    return BOND * np.array(path, dtype=float)


# Tails and a linker of twelve and twenty-four beads, and domains of residues 13-48 and 73-108.
places = np.empty((120, 3))
end = np.zeros(3)
for first, last, shape in ((0, 12, None), (12, 48, bundle()), (48, 72, None), (72, 108, bundle()), (108, 120, None)):
    count = last - first
    shape = BOND * np.array([[k, 0, 0] for k in range(count)]) if shape is None else shape
    places[first:last] = end + shape
    end = places[last - 1] + [BOND, 0, 0]

system, topology = openmm.System(), app.Topology()
chain = topology.addChain("A")
for number in range(1, 121):
    system.addParticle(MASS)
    topology.addAtom("CA", None, topology.addResidue("ALA", chain, str(number)))
domains = select_bodies(topology, ["A:13-48", "A:73-108"])

bonds, contacts = openmm.HarmonicBondForce(), openmm.CustomNonbondedForce("4*0.8*((0.5/r)^12 - 0.7*(0.5/r)^6)")
inside = [set(domain) for domain in domains]
for i in range(119):
    if not any({i, i + 1} <= domain for domain in inside):
        bonds.addBond(i, i + 1, BOND, STIFFNESS)
for _ in range(120):
    contacts.addParticle([])
excluded = {(i, i + 1) for i in range(119)}
for domain in domains:
    excluded |= set(itertools.combinations(domain, 2))  # they do no work, and would only cost time
for pair in sorted(excluded):
    contacts.addExclusion(*pair)
system.addForce(bonds)
system.addForce(contacts)

bodies = RigidBodies.from_system(system, topology, domains, places)
print(bodies, prepare_system(system, bodies), sep="\n")
integrator = SIERLangevinIntegrator(300, 1 / unit.picosecond, 40 * unit.femtoseconds, bodies=bodies)
simulation = app.Simulation(topology, system, integrator)
simulation.context.setPositions(places)
simulation.minimizeEnergy()
simulation.context.setVelocitiesToTemperature(300, 1)
columns = {"step": True, "potentialEnergy": True, "temperature": True}
simulation.reporters.append(app.StateDataReporter(sys.stdout, max(1, steps // 5), **columns))
simulation.step(steps)
distance = np.linalg.norm(np.diff(integrator.getBodyState().q[:, :2], axis=1))
print(integrator.computeTemperatures())
print(f"the centres of the domains are {distance:.1f} nm apart")
