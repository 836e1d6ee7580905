"""Types of rigid bodies, and Systems that are made of them."""

import numpy as np
import openmm
from openmm import app
from scipy.spatial.transform import Rotation

from openmm_sier import BodyType, RigidBodies, add_bodies
from tests.support.systems import field

#: An asymmetric top of four atoms, by its masses.
TOP = BodyType("top", [[0, 0, 0], [0.15, 0, 0], [0, 0.13, 0], [0, 0, 0.11]], [12, 14, 16, 19])

#: A core with patches in a plane, which no masses at these sites could turn like a sphere.
PATCHY = BodyType("patchy", [[0, 0, 0], [0.3, 0, 0], [0, 0.3, 0]], [50, 0, 0], moments=[2, 2.2, 2.1])


def built(counts, seed=0, size=3.0, sites=slice(None), periodic=False, flat=False):
    """A System of bodies of types in a field, their positions and lists of particles.

    Args:
        counts: number of bodies by type.
        seed: of places and orientations.
        size: of the cube of their places, nm.
        sites: of each body on which the field acts.
        flat: whether the last principal axes are along z.
        periodic: whether there is a triclinic box, smaller than the cube, in which nothing else acts.
    """
    rng = np.random.default_rng(seed)
    system, topology = openmm.System(), app.Topology()
    positions, lists = [], {}
    for kind, count in counts.items():
        centres = size * rng.random((count, 3))
        turns = rng.normal(size=(count, 4))
        if flat:
            about_z = Rotation.from_rotvec(np.outer(rng.uniform(0, 6, count), [0, 0, 1]))
            turns = (about_z * Rotation.from_matrix(kind.axes)).as_quat(scalar_first=True)
        lists[kind], places = add_bodies(system, topology, kind, centres, turns)
        positions.append(places)
    acting = [i for bodies in lists.values() for body in bodies for i in body[sites]]
    system.addForce(field("20*(x^2 + y^2 + 2*z^2) + 30*x*y + 10*sin(3*z)", acting))
    if periodic:
        system.setDefaultPeriodicBoxVectors([2, 0, 0], [0.5, 2, 0], [-0.5, 0.5, 2])
        nothing = openmm.NonbondedForce()
        nothing.setNonbondedMethod(nothing.CutoffPeriodic)
        nothing.setCutoffDistance(0.5)
        for _ in range(system.getNumParticles()):
            nothing.addParticle(0, 1, 0)
        system.addForce(nothing)
    return system, np.concatenate(positions), lists


def typed(counts, **options):
    """The same, with bodies in place of lists."""
    system, positions, lists = built(counts, **options)
    return system, positions, RigidBodies.from_types(system, lists, positions)
