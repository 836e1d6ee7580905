"""Molecules and bodies that the periodic box has cut are made whole."""

from __future__ import annotations

import numpy as np
import openmm
from openmm import app

from openmm_sier.dynamics import bodies as dynamics
from openmm_sier.system.arguments import Positions, checked_positions, checked_system
from openmm_sier.system.cut_molecules import Wholeness, refuse_broken
from openmm_sier.system.find_bodies import BodyPlan, Rigid


def make_whole(
    system: openmm.System,
    positions: Positions,
    topology: app.Topology | None = None,
    bodies: dynamics.BodySet | Rigid = None,
) -> np.ndarray:
    """Return positions at which the periodic boundary cuts no molecule and no rigid body.

    Call it where a file has molecules that the box has cut: OpenMM's constraints, and most bonds, ignore the box.

    >>> whole = make_whole(system, positions, topology)

    Where a bond or a constraint is far too long, its atoms move next to each other by box vectors, together with the
    atoms bonded to them. Molecules that are whole already keep their positions to the last bit. Where no bonds join the
    atoms of a body, the widest gap between them along each edge of the box is taken for the space around the body; and
    so it is for molecules that bonds without strength join.

    Args:
        system: the System, with the periodic box, if any, as its default.
        positions: (N, 3), nm or a Quantity.
        topology: the topology of all particles, for the names of residues in messages, for bonds that the System
            does not have or has only as an expression (CustomBondForce), and for some choices of `bodies`.
        bodies: rigid bodies, as `RigidBodies` or as `rigid` of `RigidBodies.from_system`, such as lists of particle
            indices.

    Returns:
        (N, 3), nm.

    Raises:
        ValueError: a bond is broken, even between the nearest images of its atoms: one that has more than 1000 kJ/mol,
            a constraint that is 0.1 nm too long, or a bond of the topology alone of more than 0.4 nm. The message names
            the worst. Or `bodies` are refused, see `RigidBodies.from_system`.
    """
    x = checked_positions(positions, checked_system(system).getNumParticles())
    wholeness = Wholeness(system, topology)
    x = wholeness.whole(x, _clusters(system, topology, bodies))
    refuse_broken(wholeness.bonds, x, wholeness.box, topology)
    return x


def _clusters(
    system: openmm.System, topology: app.Topology | None, bodies: dynamics.BodySet | Rigid
) -> list[np.ndarray]:
    """Return particle indices of each body of several atoms."""
    if bodies is None:
        return []
    if isinstance(bodies, dynamics.BodySet):
        kinds = [species.atoms for species in bodies.species]
    else:
        kinds = [kind.clusters for kind in BodyPlan(system, topology, bodies).kinds]
    return [atoms for clusters in kinds if clusters.shape[1] > 1 for atoms in clusters]
