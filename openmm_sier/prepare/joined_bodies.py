"""Bonds without strength between the atoms of a body that no constraints hold: the record of bodies in a System.

OpenMM finds molecules by bonds, and a rigid body needs none. OpenMM's trajectories move molecules into the box, and its
barostats scale their centres: without such bonds the atoms of a body would be scattered over the box, and its linkers
left behind. And a System that was prepared for bodies is wrong without them: fast forces would move other bodies.
"""

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import RigidityError
from openmm_sier.system import tables
from openmm_sier.system.bonded_terms import bonded_terms

#: Name of the Force of bonds without strength, by which a prepared System is renewed.
NAME = "openmm_sier: atoms of bodies"


def join_bodies(system: openmm.System, owner: np.ndarray) -> int:
    """Join the atoms of each body that no constraints hold, by bonds without strength.

    Args:
        system: openmm.System, to which a HarmonicBondForce is added where there is something to join.
        owner: for each particle the number of its body, (N,), -1 where it has none.

    Returns:
        How many bodies were joined.
    """
    moving = np.flatnonzero((owner >= 0) & (tables.masses(system) > 0))
    atoms = moving[np.argsort(owner[moving], kind="stable")]
    sizes = np.bincount(owner[atoms])
    ends = owner[tables.constraints(system).pairs]
    inside = ends[(ends[:, 0] == ends[:, 1]) & (ends[:, 0] >= 0), 0]
    held = np.bincount(inside, minlength=len(sizes)) >= sizes * (sizes - 1) // 2
    pairs = np.column_stack([atoms[:-1], atoms[1:]])
    pairs = pairs[(owner[pairs[:, 0]] == owner[pairs[:, 1]]) & ~held[owner[pairs[:, 0]]]]
    if not len(pairs):
        return 0
    force = openmm.HarmonicBondForce()
    force.setName(NAME)
    for one, other in pairs.tolist():
        force.addBond(one, other, 0.0, 0.0)
    system.addForce(force)
    return len(np.unique(owner[pairs[:, 0]]))


def remembered_pairs(system: openmm.System) -> np.ndarray:
    """Return pairs of atoms that share a body for which a System was prepared, (p, 2).

    Pairs with virtual sites are left out: in a System with frames the atoms of bodies are such sites.
    """
    bonds = [bonded_terms(force) for force in system.getForces() if force.getName() == NAME]
    pairs = np.concatenate([np.empty((0, 2), dtype=np.int64), *bonds])
    return pairs[(tables.masses(system)[pairs] > 0).all(axis=1)] if len(pairs) else pairs


def refuse_torn_bodies(pairs: np.ndarray, owner: np.ndarray) -> None:
    """Refuse bodies other than those for which a System was prepared.

    Args:
        pairs: see `remembered_pairs`.
        owner: for each particle the number of its body, (N,), -1 where it has none.

    Raises:
        RigidityError: two atoms that shared a body no longer do.
    """
    ends = owner[pairs]
    torn = pairs[(ends[:, 0] != ends[:, 1]) | (ends[:, 0] < 0)]
    if len(torn):
        one, other = torn[0].tolist()
        raise RigidityError(
            f"prepare_system prepared this System for a rigid body that has atoms {one} and {other}, but the "
            "integrator has no such body: give the integrator these `bodies`, or prepare a new System for its own"
        )
