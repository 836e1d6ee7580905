"""Patchy particles: soft spheres with four attractive patches at the corners of a tetrahedron.

In the manner of Z. Zhang and S. C. Glotzer, Nano Letters 4, 1407 (2004): a core that repels as the Lennard-Jones
potential does up to its minimum (J. D. Weeks, D. Chandler and H. C. Andersen, J. Chem. Phys. 54, 5237 (1971)), and
patches on its surface that attract each other, here with a Gaussian well.
"""

from __future__ import annotations

import itertools

import numpy as np
import openmm

from studies.domains.fullerenes import rotation
from studies.domains.models import INTERACTIONS, Model, exclude, pairs_within, with_network

#: nm and kJ/mol of the core; kJ/mol and nm of the wells of patches.
DIAMETER, REPULSION = 1.0, 2.5
DEPTH, WIDTH = 10.0, 0.1

#: dalton of the core and of each patch.
CORE, PATCH = 800.0, 50.0

#: Particles in nm^3, and nm up to which anything acts.
DENSITY, CUTOFF = 0.4, 1.15

#: Springs between core and patches and among patches: kJ/mol/nm^2, and nm, more than any distance within a particle.
STIFFNESS, REACH = 2e4, 2 * DIAMETER

WELLS = """
    core1*core2*step(contact - r)*(4*repulsion*((diameter/r)^12 - (diameter/r)^6) + repulsion)
    - (1 - core1)*(1 - core2)*depth*(exp(-r^2/(2*width^2)) - exp(-rc^2/(2*width^2))); contact = 2^(1/6)*diameter
"""


def model(edge: int = 4) -> Model:
    """`edge`^3 particles at 300 K and constant volume."""
    system, force = openmm.System(), openmm.CustomNonbondedForce(" ".join(WELLS.split()))
    force.addPerParticleParameter("core")
    constants = {"diameter": DIAMETER, "repulsion": REPULSION, "depth": DEPTH, "width": WIDTH, "rc": CUTOFF}
    for name, value in constants.items():
        force.addGlobalParameter(name, value)
    force.setNonbondedMethod(force.CutoffPeriodic)
    force.setCutoffDistance(CUTOFF)
    force.setName("contacts")
    force.setForceGroup(INTERACTIONS)
    tetrahedron = DIAMETER / 2 / 3**0.5 * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    spacing = DENSITY ** (-1 / 3)
    random = np.random.default_rng(1)
    places, bodies = [], []
    for corner in itertools.product(range(edge), repeat=3):
        sites = np.concatenate([np.zeros((1, 3)), tetrahedron @ rotation(random)])
        places.append(spacing * np.array(corner) + sites)
        bodies.append([system.addParticle(CORE if site == 0 else PATCH) for site in range(len(sites))])
        for site in range(len(sites)):
            force.addParticle([float(site == 0)])
    exclude(force, pairs_within(bodies))
    system.addForce(force)
    system.setDefaultPeriodicBoxVectors(*(edge * spacing * np.eye(3)))
    positions = np.concatenate(places)
    network = with_network(system, positions, bodies, REACH, STIFFNESS)
    return Model("patchy particles", system, network, positions, bodies, usual=10.0)
