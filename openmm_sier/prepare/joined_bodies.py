"""Bonds of zero strength between the atoms of bodies without constraints, which also record the bodies in a System.

OpenMM finds molecules by bonds, and a rigid body needs none. OpenMM's trajectories move molecules into the box, and its
barostats scale their centres: without such bonds the atoms of a body would be scattered over the box, and separated
from its linkers. A System prepared for bodies must not be used without them: fast forces would move other bodies.
"""

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import RigidityError
from openmm_sier.dynamics.index_ranges import distinct
from openmm_sier.system import tables
from openmm_sier.system.bonded_terms import bonded_terms

#: Name of the Force of these bonds, which identifies it when a System is prepared again.
NAME = "openmm_sier: atoms of bodies"


def join_bodies(system: openmm.System, owner: np.ndarray, moving: np.ndarray) -> int:
    """Join the atoms of each body without constraints by bonds of zero strength.

    Args:
        system: openmm.System, to which a HarmonicBondForce is added if there are such bodies.
        owner: body index of each particle, (N,); -1 without a body.
        moving: whether each particle is an atom of a body, (N,).

    Returns:
        Number of bodies joined.
    """
    members = np.flatnonzero(moving)
    atoms = members[np.argsort(owner[members], kind="stable")]
    sizes = np.bincount(owner[atoms])
    ends = owner[tables.constraints(system).pairs]
    inside = ends[(ends[:, 0] == ends[:, 1]) & (ends[:, 0] >= 0), 0]
    is_rigid = np.bincount(inside, minlength=len(sizes)) >= sizes * (sizes - 1) // 2
    pairs = np.column_stack([atoms[:-1], atoms[1:]])
    pairs = pairs[(owner[pairs[:, 0]] == owner[pairs[:, 1]]) & ~is_rigid[owner[pairs[:, 0]]]]
    if not len(pairs):
        return 0
    force = openmm.HarmonicBondForce()
    force.setName(NAME)
    add = tables.compiled(force, "addBond")
    # Bodies are numbered by their masses, which a hydrogenMass changes.
    for one, other in sorted(pairs.tolist()):
        add(force, one, other, 0.0, 0.0)
    system.addForce(force)
    return len(distinct(owner[pairs[:, 0]]))


def remembered_pairs(system: openmm.System) -> np.ndarray:
    """Return pairs of atoms in bodies for which a System was prepared, (p, 2).

    Pairs with virtual sites are left out: in a System with frames the atoms of bodies are virtual sites.
    """
    bonds = [bonded_terms(force) for force in system.getForces() if force.getName() == NAME]
    pairs = np.concatenate([np.empty((0, 2), dtype=np.int64), *bonds])
    return pairs[~np.isin(pairs, tables.virtual_sites(system)).any(axis=1)]


def refuse_torn_bodies(pairs: np.ndarray, owner: np.ndarray) -> None:
    """Refuse bodies other than those for which a System was prepared.

    Args:
        pairs: see `remembered_pairs`.
        owner: body index of each particle, (N,); -1 without a body.

    Raises:
        RigidityError: two atoms of one body no longer share a body.
    """
    ends = owner[pairs]
    torn = pairs[(ends[:, 0] != ends[:, 1]) | (ends[:, 0] < 0)]
    if len(torn):
        one, other = torn[0].tolist()
        raise RigidityError(
            f"prepare_system prepared this System for a rigid body with atoms {one} and {other}, but the integrator "
            "has no such body. Give the integrator the same `bodies`, or prepare a new System for its bodies"
        )
