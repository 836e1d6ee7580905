"""Integrators to compare, and time series of their runs."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.backend.formulas import body_frame
from openmm_sier.dynamics.bodies import BodyState, NotFiniteError, RigidBodies, RigidityError
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.schemes import CATALOGUE, SIER2, Scheme
from openmm_sier.engines.temperature import MomentumConservation, degrees_of_freedom, temperatures
from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.integrators.langevin import SIERLangevinIntegrator
from openmm_sier.observe import stock

#: Tolerance of constraints for OpenMM's own integrators.
CONSTRAINT_TOLERANCE = stock.CONSTRAINT_TOLERANCE

#: K, beyond which a run counts as broken.
HIGHEST_TEMPERATURE = 3000.0


class Unstable(RuntimeError):
    """The simulation has left the range of sensible energies."""


@dataclass(frozen=True)
class Energies:
    """Energies at whole steps of one run, one-dimensional arrays of equal length.

    Attributes:
        time: ps.
        potential, kinetic: kJ/mol.
    """

    time: np.ndarray
    potential: np.ndarray
    kinetic: np.ndarray

    @property
    def total(self) -> np.ndarray:
        return self.potential + self.kinetic


@dataclass(frozen=True)
class Series(Energies):
    """Samples of one run.

    Attributes:
        translation, rotation: temperatures in K.
        volume: nm^3.
    """

    translation: np.ndarray
    rotation: np.ndarray
    volume: np.ndarray


@dataclass(frozen=True)
class Method:
    """An integrator to compare.

    Attributes:
        name: for tables.
        force_evaluations: per step.
        make: step in ps -> integrator.
        bias: a step h changes the temperature of a degree of freedom of frequency w by the fraction -bias (h w)^2, to
            leading order; NaN where there is no such law. There is none for Verlet: SETTLE's free rotation, which is
            not exact, has a bias of its own.
    """

    name: str
    force_evaluations: int
    make: Callable[[float], openmm.Integrator]
    bias: float = math.nan


#: `Method.bias` of SIER2 at constant energy: the modified Hamiltonian of kick, drift, kick has the inverse
#: mass (1 + (h w)^2/6)/m; and of SIER2 with the bath in its middle, where a harmonic oscillator has
#: <p^2/m> = kT (1 - (h w)^2/4) exactly (Leimkuhler and Matthews, Appl. Math. Res. Express 2013, 34).
BIAS_NVE, BIAS_NVT = 1 / 6, 1 / 4


def nve_methods() -> dict[str, Method]:
    """OpenMM's Verlet with SETTLE and every scheme of the catalogue, by lower-case name."""
    methods = {"verlet": Method("OpenMM Verlet", 1, openmm.VerletIntegrator)}
    for name, scheme in CATALOGUE.items():
        bias = BIAS_NVE if scheme is SIER2 else math.nan
        methods[name] = Method(scheme.name, scheme.force_evaluations, partial(SIERIntegrator, scheme=scheme), bias)
    return methods


def nvt_methods(temperature: float, friction: float, seed: int) -> dict[str, Method]:
    """OpenMM's LangevinMiddle and every scheme of the catalogue with a heat bath, by lower-case name."""

    def middle(h: float) -> openmm.Integrator:
        integrator = openmm.LangevinMiddleIntegrator(temperature, friction, h)
        integrator.setRandomNumberSeed(seed)
        return integrator

    def langevin(h: float, scheme: Scheme) -> openmm.Integrator:
        integrator = SIERLangevinIntegrator(temperature, friction, h, scheme=scheme)
        integrator.setRandomNumberSeed(seed)
        return integrator

    methods = {"langevinmiddle": Method("OpenMM LangevinMiddle", 1, middle)}
    for name, scheme in CATALOGUE.items():
        make = partial(langevin, scheme=scheme)
        bias = BIAS_NVT if scheme is SIER2 else math.nan
        methods[name] = Method(f"{scheme.name} Langevin", scheme.force_evaluations, make, bias)
    return methods


def sample(
    context: openmm.Context, bodies: RigidBodies, steps: int, every: int, progress: Callable[[int], None] | None = None
) -> Series:
    """Run a Context and record energies and temperatures at whole steps.

    OpenMM's leapfrog keeps velocities half a step behind. Its temperatures are taken at the whole step, from velocities
    that the forces have advanced by half a step, as OpenMM's own kinetic energy is.

    Args:
        context: with positions and velocities.
        bodies: its rigid bodies.
        steps: number of steps.
        every: steps between two samples.
        progress: called with the number of steps done.

    Raises:
        Unstable: an energy is not finite, a temperature is above `HIGHEST_TEMPERATURE`, or molecules are torn apart.
    """
    integrator = context.getIntegrator()
    conserved = MomentumConservation.of_system(context.getSystem(), bodies).holds(integrator)
    rows = []
    for done in range(every, steps + 1, every):
        integrator.step(every)
        try:
            rows.append(observe(context, bodies, conserved))
        except (RigidityError, NotFiniteError) as error:
            raise Unstable(f"after {done} steps {error}") from error
        if not rows[-1].sane:
            raise Unstable(f"{rows[-1]} after {done} steps")
        if progress is not None:
            progress(done)
    return Series(*np.array(rows).T)


class Sample(NamedTuple):
    """The values of `Series` at one step."""

    time: float
    potential: float
    kinetic: float
    translation: float
    rotation: float
    volume: float

    @property
    def sane(self) -> bool:
        # A temperature is NaN where there is no such motion.
        hot = self.translation > HIGHEST_TEMPERATURE or self.rotation > HIGHEST_TEMPERATURE
        return math.isfinite(self.potential) and math.isfinite(self.kinetic) and not hot

    def __str__(self) -> str:
        return f"temperatures of {self.translation:.0f} K and {self.rotation:.0f} K, V = {self.potential:.4g} kJ/mol"


def observe(context: openmm.Context, bodies: RigidBodies, conserved: bool) -> Sample:
    """Energies and temperatures of a Context at a whole step.

    Args:
        context: with positions and velocities.
        bodies: its rigid bodies.
        conserved: whether the total momentum is conserved, see `MomentumConservation`.
    """
    state = context.getState(energy=True)
    found = temperatures(bodies, body_state(context, bodies), conserved)
    return Sample(
        state.getTime().value_in_unit(unit.picosecond),
        state.getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole),
        state.getKineticEnergy().value_in_unit(unit.kilojoule_per_mole),
        found.translation,
        found.rotation,
        state.getPeriodicBoxVolume().value_in_unit(unit.nanometer**3),
    )


def body_state(context: openmm.Context, bodies: RigidBodies) -> BodyState:
    """The state of the bodies at a whole step, for any integrator; see `sample`."""
    integrator = context.getIntegrator()
    if isinstance(integrator, SIERIntegrator):
        return integrator.getBodyState()
    return stock.body_state(context, bodies)


def steepness(context: openmm.Context, bodies: RigidBodies, samples: int, every: int) -> tuple[float, float]:
    """Temperature times the mean squared frequency of translation and of rotation, K/ps^2.

    In equilibrium <F M^-1 F> = kT <tr M^-1 V''>, and likewise with torques and moments, so it follows from forces.

    Args:
        context: of a SIERIntegrator, with positions and velocities in equilibrium.
        bodies: its rigid bodies.
        samples: how many are taken.
        every: steps before each.
    """
    sums = np.zeros(2)
    for _ in range(samples):
        context.getIntegrator().step(every)
        forces = context.getState(forces=True).getForces(asNumpy=True)
        A = context.getIntegrator().getBodyState().A
        F, tau = bodies.forces_and_torques(forces.value_in_unit(unit.kilojoule_per_mole / unit.nanometer), A)
        sums += (F * F / bodies.masses).sum(), (body_frame(A, tau) ** 2 * bodies.inverse_moments).sum()
    # Forces do not know whether the total momentum is conserved.
    dof = np.array(degrees_of_freedom(bodies, conserved=False)[:2])
    translation, rotation = np.divide(sums / (samples * GAS_CONSTANT), dof, out=np.zeros(2), where=dof > 0)
    return float(translation), float(rotation)
