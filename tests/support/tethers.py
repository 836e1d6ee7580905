"""Waters without interactions, in fields of which everything is known."""

from __future__ import annotations

import openmm

from studies.bench.layer import free_water

#: kJ/mol/nm^2, of the springs of O and H.
SPRINGS = (1e5, 7e3, 7e3)


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
