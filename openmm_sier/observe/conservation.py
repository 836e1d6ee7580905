"""Conserved quantities and temperatures of a simulation: columns of the command's log and of ConservationReporter."""

import math
from collections.abc import Iterable
from typing import TypeVar

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.constants import GRAM_PER_CM3
from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.observe.openmm_integrators import OpenMMIntegrator
from openmm_sier.system import checks
from openmm_sier.system.temperature import temperatures

#: Columns of the potential energy, and of the total energy less the heat.
POTENTIAL, CONSERVED = "Potential Energy (kJ/mole)", "Conserved Energy (kJ/mole)"

#: Columns of the temperatures of translation, of rotation and of flexible molecules.
TEMPERATURES = ("Translational Temperature (K)", "Rotational Temperature (K)", "Flexible Temperature (K)")

#: All columns, named as in OpenMM's StateDataReporter where possible.
COLUMNS = (
    "Step",
    "Time (ps)",
    POTENTIAL,
    "Kinetic Energy (kJ/mole)",
    "Total Energy (kJ/mole)",
    CONSERVED,
    "Temperature (K)",
    *TEMPERATURES,
    *(f"Momentum {axis} (dalton nm/ps)" for axis in "xyz"),
    *(f"Angular Momentum {axis} (dalton nm^2/ps)" for axis in "xyz"),
    "Box Volume (nm^3)",
    "Density (g/mL)",
)


Volume = TypeVar("Volume", float, np.ndarray)


def density(mass: float, volume: Volume) -> Volume:
    """Return the density in g/ml of a mass in dalton in a volume, or an array of volumes, in nm^3."""
    return mass / volume / GRAM_PER_CM3


def sier_integrator(context: openmm.Context) -> SIERIntegrator | OpenMMIntegrator:
    """Return the integrator of a Context, a `SIERIntegrator` or `OpenMMIntegrator`.

    Raises:
        TypeError: the Context has another integrator.
    """
    integrator = context.getIntegrator()
    if not isinstance(integrator, SIERIntegrator | OpenMMIntegrator):
        raise TypeError(f"this report requires a SIER integrator, but the Context has a {type(integrator).__name__}")
    return integrator


def columns(integrator: openmm.Integrator) -> tuple[str, ...]:
    """Return `COLUMNS`, and the additional columns of an integrator of this package."""
    return (*COLUMNS, *integrator.reported()) if isinstance(integrator, SIERIntegrator) else COLUMNS


def row(context: openmm.Context, observed: openmm.State | None = None) -> tuple[float, ...]:
    """Return values of `columns` at the last completed step.

    The kinetic energy includes all motion. The conserved energy is the total energy minus the heat from thermostats and
    volume moves of this package, with velocities of whole steps (`SIERIntegrator.getWholeStepState`). Thermostats and
    barostats of OpenMM do not count their heat: the conserved energy is NaN if one acts. Temperatures follow the rule
    of `openmm_sier.system.temperature`, or `computeTemperatures` of an integrator of this package. Angular momentum is
    about the origin, with the positions of the Context; periodic boundaries do not conserve it. Volume and density are
    NaN for a System without periodic boundaries.

    Args:
        context: a Context with a `SIERIntegrator` or `OpenMMIntegrator`.
        observed: a State of the Context with energies; None computes one, at the cost of an energy evaluation.

    Raises:
        TypeError: the Context has another integrator.
    """
    integrator = sier_integrator(context)
    observed = context.getState(energy=True) if observed is None else observed
    bodies, motion = integrator.bodies, integrator.getBodyState()
    potential = observed.getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole)
    kinetic = sum(bodies.kinetic_energies(motion))
    conserved = kinetic
    if isinstance(integrator, OpenMMIntegrator):
        kelvins = temperatures(bodies, motion, integrator.conservesMomentum)
    else:
        kelvins = integrator.computeTemperatures().in_kelvin()
        if integrator.scheme.momentum_lag:
            conserved = sum(bodies.kinetic_energies(integrator.getWholeStepState()))
    if checks.gives_uncounted_heat(context):
        conserved = math.nan
    momentum, angular_momentum = bodies.total_momenta(motion)
    periodic = context.getSystem().usesPeriodicBoundaryConditions()
    volume = observed.getPeriodicBoxVolume().value_in_unit(unit.nanometer**3) if periodic else math.nan
    values = (
        observed.getTime().value_in_unit(unit.picosecond),
        potential,
        kinetic,
        potential + kinetic,
        potential + conserved - integrator.countedHeat,
        *kelvins,
        *momentum,
        *angular_momentum,
        volume,
        density(bodies.masses.sum(), volume),
        *integrator.reported().values(),
    )
    return (observed.getStepCount(), *(float(value) for value in values))


def csv_line(values: Iterable[str | float]) -> str:
    """Return a line of a CSV file: names without commas, and numbers with the fewest digits that represent them."""
    return ",".join(map(str, values)) + "\n"
