"""The points of `flexible` as OpenMM Systems, with or without rigid water, and comparisons of their runs."""

import numpy as np
import openmm

from tests.support.flexible import Points
from tests.support.starts import displaced
from tests.support.systems import assembled
from tests.support.waters import platform

#: TIP3P.
WATER = np.array([[0.0, 0.0, 0.0], [0.09572, 0.0, 0.0], [-0.0239872, 0.0926627, 0.0]])
WATER_MASSES = (15.999, 1.008, 1.008)

FAST = 1


def system_of(points: Points, waters=0, ions=0, box=None):
    """A System, and positions (N, 3) in nm, of points, then rigid waters and ions of one soft repulsion.

    Springs are in the force group `FAST`. With a box, its edge in nm, interactions are periodic.
    """
    constraints = zip(*points.pairs.T.tolist(), points.lengths.tolist(), strict=True)
    system = assembled(points.masses, constraints=constraints)
    n = len(points.masses)
    positions = [*points.x.T]
    for number in range(waters):
        start = system.getNumParticles()
        positions += list(WATER + np.array([0.45 * (number % 3) - 0.4, -0.45, 0.45 * (number // 3)]))
        for mass in WATER_MASSES:
            system.addParticle(mass)
        for i, j in ((0, 1), (0, 2), (1, 2)):
            system.addConstraint(start + i, start + j, np.linalg.norm(WATER[i] - WATER[j]))
    for number in range(ions):
        system.addParticle(22.99)
        positions.append(np.array([0.3 * number, 0.9, 0.1]))
    system.addForce(_springs(points))
    system.addForce(_field(points))
    system.addForce(_charges(points, system.getNumParticles() - n, waters, box))
    if box:
        system.setDefaultPeriodicBoxVectors(*(box * np.eye(3)))
    return system, displaced(np.array(positions), system)


def _springs(points):
    force = openmm.HarmonicBondForce()
    for i, j, length, constant in zip(*points.springs, strict=True):
        force.addBond(int(i), int(j), length, constant)
    force.setForceGroup(FAST)
    return force


def _field(points):
    force = openmm.CustomExternalForce("charge*sin(kx*x + ky*y + kz*z + phase)")
    for name in ("charge", "kx", "ky", "kz", "phase"):
        force.addPerParticleParameter(name)
    if points.field:
        for i, (charge, wave) in enumerate(zip(points.charges, points.waves.T, strict=True)):
            force.addParticle(i, [charge * points.field, *wave, i])
    return force


def _charges(points, others, waters, box):
    """Soft charges between molecules; those of water are -0.8 and 0.4, of ions 0.5 and -0.5 by turns."""
    force = openmm.CustomNonbondedForce(f"{points.COULOMB}*c1*c2/sqrt(r^2 + {points.SOFTENING}^2)")
    force.addPerParticleParameter("c")
    ions = others - 3 * waters
    for charge in (*points.charges, *(waters * (-0.8, 0.4, 0.4)), *(0.5 * (-1.0) ** np.arange(ions))):
        force.addParticle([charge])
    n = len(points.masses)
    for i in range(n):
        for j in range(i):
            if points.molecules[i] == points.molecules[j]:
                force.addExclusion(i, j)
    for start in range(n, n + 3 * waters, 3):
        for i, j in ((0, 1), (0, 2), (1, 2)):
            force.addExclusion(start + i, start + j)
    if box:
        force.setNonbondedMethod(openmm.CustomNonbondedForce.CutoffPeriodic)
        force.setCutoffDistance(0.35 * box)
        force.setUseSwitchingFunction(True)
        force.setSwitchingDistance(0.25 * box)
    return force


def started(system, integrator, positions, temperature=300.0, seed=3, name="Reference", steps=None):
    """A Context at positions, with velocities that satisfy the constraints, after steps if these are given."""
    context = openmm.Context(system, integrator, platform(name))
    context.setPositions(positions)
    context.setVelocitiesToTemperature(temperature, seed)
    if steps is not None:
        integrator.step(steps)
    return context


def total_energy(context):
    state = context.getState(energy=True)
    return state.getPotentialEnergy()._value + state.getKineticEnergy()._value
