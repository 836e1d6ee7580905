"""Make molecules and bodies whole across the periodic boundary."""

from __future__ import annotations

import numpy as np
import openmm
from openmm import app

from openmm_sier.dynamics import bodies as dynamics
from openmm_sier.system import tables
from openmm_sier.system.arguments import Positions, checked_positions, checked_system
from openmm_sier.system.cut_molecules import Wholeness, refuse_broken
from openmm_sier.system.find_bodies import BodyPlan, Rigid


@tables.read_once()
def make_whole(
    system: openmm.System,
    positions: Positions,
    topology: app.Topology | None = None,
    bodies: dynamics.BodySet | Rigid = None,
) -> np.ndarray:
    """Return positions at which the periodic boundary cuts no molecule and no rigid body.

    Use it for files whose molecules are wrapped atom by atom: OpenMM's constraints, and most bonds, ignore the box.

    >>> whole = make_whole(system, positions, topology)

    If a bond or constraint is far too long, box vectors bring its atoms next to each other, together with the atoms
    bonded to them. Whole molecules keep their positions bit for bit. Atoms of a body that no bonds join are brought to
    the images nearest to its first atom, and so are the particles that place a virtual site.

    Args:
        system: the System, with the periodic box, if any, as its default.
        positions: (N, 3), nm or a Quantity.
        topology: topology of all particles: for residue names in messages, for bonds that the System lacks or has only
            as an expression (CustomBondForce).
        bodies: rigid bodies, as `RigidBodies` or lists of particle indices.

    Returns:
        (N, 3), nm.

    Raises:
        ValueError: a bond is broken even between the nearest images of its atoms: its energy exceeds 1000 kJ/mol, a
            constraint is 0.1 nm too long, or a bond known only from the topology is longer than 0.4 nm. The message
            names the longest. Or a body that no bonds join, or the particles that place a virtual site, extend over
            more than half the box and are not whole about the first of them; or `bodies` are refused, see
            `RigidBodies.from_system`.
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
