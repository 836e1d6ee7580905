"""Bodies whose atoms no bond joins, made molecules for OpenMM.

OpenMM finds molecules by bonds, which a rigid body needs none of. Its trajectories move molecules into the box, and its
barostats scale their centres: without this the atoms of such a body would be scattered over the box, and their linkers
be left behind.
"""

import numpy as np
import openmm

from openmm_sier.dynamics.constraints.graph import joined
from openmm_sier.system import tables
from openmm_sier.system.find_bodies import Links

#: Name of the Force of bonds without strength, by which a prepared System is renewed.
NAME = "openmm_sier: atoms of bodies"


def join_bodies(system: openmm.System, owner: np.ndarray) -> int:
    """Join the molecules of a periodic System that a body consists of, by bonds without strength.

    Args:
        system: openmm.System, to which a HarmonicBondForce is added where there is something to join.
        owner: for each particle the number of its body, (N,), -1 where it has none.

    Returns:
        How many bodies were joined.
    """
    if not system.usesPeriodicBoundaryConditions():
        return 0
    links = Links(system)
    # Those that OpenMM knows. Angles and torsions are none of them.
    pairs = np.concatenate([links.constraints.pairs, links.bonds, links.custom])
    molecules = joined(links.n_particles, pairs)
    moving = np.flatnonzero((owner >= 0) & (tables.masses(system) > 0))
    # Each molecule that has an atom in a body, once.
    parts, first = np.unique(np.stack([owner[moving], molecules[moving]], axis=1), axis=0, return_index=True)
    atoms = moving[first]
    same = np.flatnonzero(parts[1:, 0] == parts[:-1, 0])
    if not same.size:
        return 0
    force = openmm.HarmonicBondForce()
    force.setName(NAME)
    for place in same.tolist():
        force.addBond(int(atoms[place]), int(atoms[place + 1]), 0.0, 0.0)
    system.addForce(force)
    return len(np.unique(parts[same, 0]))
