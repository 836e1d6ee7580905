"""A rigid cage of 60 atoms with the shape of C60: a large body without constraints."""

import itertools

import numpy as np
import openmm
from openmm import app, unit

from openmm_sier import RigidBodies
from tests.support.starts import displaced
from tests.support.waters import array, water_box

GOLDEN = (1 + np.sqrt(5)) / 2


def cage(edge=0.144):
    """Positions (60, 3) in nm of a truncated icosahedron about the origin."""
    corners = []
    for corner in ((0, 1, 3 * GOLDEN), (1, 2 + GOLDEN, 2 * GOLDEN), (GOLDEN, 2, 2 * GOLDEN + 1)):
        for signs in itertools.product((1, -1), repeat=3):
            signed = np.array(corner) * signs
            corners += [np.roll(signed, shift) for shift in range(3)]
    return edge / 2 * np.unique(np.round(corners, 12) + 0.0, axis=0)


def cage_in_water(nonbonded=app.PME, molecules=None, **options):
    """System of a polar cage amid TIP3P, its positions (N, 3) in nm, and the body of the cage.

    Args:
        nonbonded: method of `createSystem`.
        molecules: of water, those nearest to the cage; None takes all of a periodic box of 216 less what overlaps.
        options: of `createSystem`.
    """
    topology, positions, field = water_box(molecules=216)
    edge = topology.getPeriodicBoxVectors()[0][0].value_in_unit(unit.nanometer)
    modeller = app.Modeller(topology, positions * unit.nanometer)
    distances = np.linalg.norm(positions[::3] - edge / 2, axis=1)
    # Beyond the carbon atoms at 0.36 nm by a little less than the sum of radii, 0.33 nm.
    order = [i for i in np.argsort(distances, kind="stable") if distances[i] > 0.64][:molecules]
    residues = list(topology.residues())
    modeller.delete([residues[i] for i in set(range(len(residues))) - set(order)])
    if molecules is not None:
        modeller.topology.setPeriodicBoxVectors(None)
    system = field.createSystem(modeller.topology, nonbondedMethod=nonbonded, **options)
    (force,) = (force for force in system.getForces() if isinstance(force, openmm.NonbondedForce))
    shape = cage()
    # Polar, so that water turns it.
    atoms = [system.addParticle(12.011) for _ in shape]
    for charge in 0.3 * np.sign(shape[:, 2] + 1e-6):
        force.addParticle(charge, 0.34, 0.36)
    for i, j in itertools.combinations(atoms, 2):
        force.addException(i, j, 0, 1, 0)
    result = displaced(np.concatenate([array(modeller.positions), shape + edge / 2]), system, [atoms])
    bodies = RigidBodies.from_system(system, rigid=[atoms], positions=result)
    return system, result, bodies
