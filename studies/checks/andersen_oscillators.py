"""Potential energy of harmonic oscillators in the heat baths of OpenMM's Verlet and LangevinMiddle integrators.

    python -m studies.checks.andersen_oscillators

AndersenThermostat draws velocities at whole steps, and the leapfrog of VerletIntegrator takes them as those of half a
step before. To leading order in the rate v of collisions, an oscillator of frequency w then has the mean potential
energy (kT/2) (1 - v h/2)/(1 - (w h)^2/2) at a step h. The table compares this with runs. LangevinMiddle, whose bath is
in the middle of its drift, has no such error at any stable step; at 1.5 the prediction for Verlet is infinite or below.
"""

from __future__ import annotations

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.constants import GAS_CONSTANT

OSCILLATORS, MASS, TEMPERATURE, RATE, STEP = 1000, 10.0, 300.0, 20.0, 0.004

#: Steps before the first sample, between two samples, and number of samples.
RELAXATION, BETWEEN, SAMPLES = 1000, 7, 1500


def mean_potential(wh: float, integrator: openmm.Integrator, andersen: bool) -> float:
    """Mean potential energy of a degree of freedom, in units of kT/2, for a frequency times step `wh`."""
    stiffness = MASS * (wh / STEP) ** 2
    system = openmm.System()
    force = openmm.CustomExternalForce(f"{stiffness / 2}*(x^2+y^2+z^2)")
    for i in range(OSCILLATORS):
        system.addParticle(MASS)
        force.addParticle(i)
    system.addForce(force)
    if andersen:
        system.addForce(openmm.AndersenThermostat(TEMPERATURE, RATE))
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions(np.zeros((OSCILLATORS, 3)))
    context.setVelocitiesToTemperature(TEMPERATURE, 1)
    integrator.step(RELAXATION)
    found = []
    for _ in range(SAMPLES):
        integrator.step(BETWEEN)
        energy = context.getState(energy=True).getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole)
        found.append(energy / (1.5 * OSCILLATORS * GAS_CONSTANT * TEMPERATURE))
    return float(np.mean(found))


def main() -> None:
    print("  w h   Verlet, Andersen   predicted   LangevinMiddle")
    for wh in (0.2, 0.4, 0.6, 0.8, 1.0, 1.5):
        verlet = mean_potential(wh, openmm.VerletIntegrator(STEP), True) if wh**2 < 2 else np.nan
        middle = mean_potential(wh, openmm.LangevinMiddleIntegrator(TEMPERATURE, RATE, STEP), False)
        predicted = (1 - RATE * STEP / 2) / (1 - wh**2 / 2) if wh**2 < 2 else np.nan
        print(f"{wh:5.1f} {verlet:18.3f} {predicted:11.3f} {middle:16.3f}")


if __name__ == "__main__":
    main()
