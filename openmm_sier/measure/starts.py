"""The start of a run: positions and velocities at a temperature."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
import openmm
from openmm import unit

from openmm_sier.context.integrator import SIERIntegrator
from openmm_sier.context.langevin import SIERLangevinIntegrator
from openmm_sier.dynamics.bodies import NotFiniteError
from openmm_sier.dynamics.schemes import SIER2
from openmm_sier.studies.console import StepProgress, note

#: Net force on a molecule in kJ/mol/nm above which a start is minimized. Among 512 molecules of water at 297 K the
#: largest is 1000 to 2200.
LARGE_FORCE = 5e3

#: Equilibration: friction in 1/ps, step in ps.
FRICTION = 5.0
EQUILIBRATION_STEP = 0.002

#: Steps between two updates of the progress bar.
CHUNK = 20


class Start(Protocol):
    """The settings of a command that tell how to begin."""

    @property
    def temperature(self) -> float:
        """K."""

    @property
    def equilibrate(self) -> float:
        """Time, ps."""

    @property
    def seed(self) -> int:
        """Of velocities and noise."""

    @property
    def platform(self) -> str | None:
        """Of OpenMM; None takes the fastest."""


def equilibrated(box, settings: Start):
    """State of a box (`openmm_sier.measure.forcefields.Box`) at a temperature."""
    context = make_context(box.system, SIERIntegrator(EQUILIBRATION_STEP, SIER2), settings.platform)
    prepare(context, box.positions, settings)
    return context.getState(positions=True, velocities=True)


def make_context(system, integrator, platform: str | None):
    """A Context on a platform of a given name, in mixed precision where there is a choice; None takes the fastest."""
    for index in range(openmm.Platform.getNumPlatforms()):
        known = openmm.Platform.getPlatform(index)
        if "Precision" in known.getPropertyNames():
            known.setPropertyDefaultValue("Precision", "mixed")
    if platform is None:
        return openmm.Context(system, integrator)
    return openmm.Context(system, integrator, openmm.Platform.getPlatformByName(platform))


def prepare(context, positions, options: Start, minimize: bool | None = None) -> None:
    """Positions and velocities of a new run: minimized, thermalized, the centre of mass at rest.

    Args:
        context: with a SIERIntegrator.
        positions: (N, 3), a quantity.
        options: how to begin.
        minimize: whether to minimize first; None does where the start has forces that a liquid has not.
    """
    context.setPositions(positions)
    context.computeVirtualSites()
    context.applyConstraints(1e-6)
    strongest = _strongest_force(context)
    if minimize or (minimize is None and strongest > LARGE_FORCE):
        openmm.LocalEnergyMinimizer.minimize(context)
        note(f"minimized: the largest force on a molecule was {strongest:.3g} kJ/mol/nm")
    state = thermalize(context, options)
    # At constant pressure the box has changed.
    context.setPeriodicBoxVectors(*state.getPeriodicBoxVectors())
    context.setPositions(state.getPositions())
    context.setVelocities(state.getVelocities())
    stop_centre_of_mass(context)
    context.setTime(0)
    context.setStepCount(0)


def _strongest_force(context) -> float:
    """Largest net force on a body, kJ/mol/nm; infinite where one is not finite."""
    integrator = context.getIntegrator()
    forces = context.getState(forces=True).getForces(asNumpy=True)
    forces = forces.value_in_unit(unit.kilojoule_per_mole / unit.nanometer)
    try:
        F, _ = integrator.bodies.forces_and_torques(forces, integrator.getBodyState().A)
    except NotFiniteError:
        return math.inf
    return float(np.linalg.norm(F, axis=0).max())


def thermalize(context, options: Start):
    """A State at the wanted temperature, after a run at constant temperature, and pressure if one is kept.

    Args:
        context: holds the positions to start from, and the pressure in its integrator or System; it is left as it was.
        options: how to begin.
    """
    integrator = context.getIntegrator()
    pressure = integrator.getPressure() if isinstance(integrator, SIERLangevinIntegrator) else None
    langevin = SIERLangevinIntegrator(
        options.temperature, FRICTION, EQUILIBRATION_STEP, SIER2, integrator.bodies, pressure=pressure
    )
    langevin.setRandomNumberSeed(options.seed)
    bath = make_context(context.getSystem(), langevin, options.platform)
    bath.setState(context.getState(positions=True))
    bath.setVelocitiesToTemperature(options.temperature, options.seed)
    steps = round(options.equilibrate / EQUILIBRATION_STEP)
    with StepProgress(f"equilibration at {options.temperature:g} K", steps, EQUILIBRATION_STEP) as show:
        for done in range(0, steps, CHUNK):
            langevin.step(min(CHUNK, steps - done))
            show(done)
    if steps:
        note(f"equilibrated for {options.equilibrate:g} ps at {options.temperature:g} K")
    return bath.getState(positions=True, velocities=True)


def stop_centre_of_mass(context) -> None:
    """Bring the centre of mass of a Context to rest."""
    system = context.getSystem()
    masses = np.array([system.getParticleMass(i).value_in_unit(unit.dalton) for i in range(system.getNumParticles())])
    velocities = context.getState(velocities=True).getVelocities(asNumpy=True)
    velocities = velocities.value_in_unit(unit.nanometer / unit.picosecond)
    velocities[masses > 0] -= masses @ velocities / masses.sum()
    context.setVelocities(velocities)
