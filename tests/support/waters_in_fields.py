"""Waters without interactions in external fields, with known averages."""

import numpy as np
import openmm

from tests.support.starts import displaced

OH, HH = 0.09572, 0.15139

#: kJ/mol/nm^2, of the springs of O and H.
SPRINGS = (1e5, 7e3, 7e3)


def free_water(n):
    """Water molecules without interactions: the System and positions (3 n, 3)."""
    system = openmm.System()
    for _ in range(n):
        oxygen, *hydrogens = (system.addParticle(mass) for mass in (15.99943, 1.007947, 1.007947))
        for hydrogen in hydrogens:
            system.addConstraint(oxygen, hydrogen, OH)
        system.addConstraint(*hydrogens, HH)
    half = np.arcsin(HH / 2 / OH)
    sites = OH * np.array([[0, 0, 0], [np.cos(half), np.sin(half), 0], [np.cos(half), -np.sin(half), 0]])
    places = np.random.default_rng(1).uniform(0, 10, (n, 1, 3))
    return system, displaced((places + sites).reshape(-1, 3), system)


def tethered_water(n):
    """Waters that springs hold by their atoms, so that they shake and librate: a System, and positions (3 n, 3) in nm.

    Translation is harmonic, and libration nearly so.
    """
    system, positions = free_water(n)
    force = openmm.CustomExternalForce("0.5*spring*((x-x0)^2+(y-y0)^2+(z-z0)^2)")
    for name in ("spring", "x0", "y0", "z0"):
        force.addPerParticleParameter(name)
    for i, x in enumerate(positions):
        force.addParticle(i, (SPRINGS[i % 3], *x))
    system.addForce(force)
    return system, positions


def falling_water(n, gravity):
    """Waters that fall: a System, and positions (3 n, 3) in nm.

    Args:
        n: number of molecules.
        gravity: acceleration along -x, nm/ps^2.
    """
    system, positions = free_water(n)
    force = openmm.CustomExternalForce(f"mass*{gravity}*x")
    force.addPerParticleParameter("mass")
    for i in range(3 * n):
        force.addParticle(i, (system.getParticleMass(i)._value,))
    system.addForce(force)
    return system, positions
