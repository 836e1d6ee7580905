"""Time series of a simulation, and their means with errors: what the comparisons of integrators share."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import openmm
from openmm import unit

from openmm_sier.context.integrator import SIERIntegrator
from openmm_sier.context.langevin import SIERLangevinIntegrator
from openmm_sier.dynamics.backend.formulas import body_frame
from openmm_sier.dynamics.bodies import GAS_CONSTANT, BodyState, NotFiniteError, RigidBodies, RigidityError
from openmm_sier.dynamics.schemes import CATALOGUE, SIER2

#: Tolerance of constraints for OpenMM's own integrators; SETTLE is not better than 1e-8.
CONSTRAINT_TOLERANCE = 1e-7


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
        bias: what a step of h does to the temperature of a degree of freedom of frequency w, -bias (h w)^2 of it to
            leading order; NaN where there is no such law. For Verlet there is none: SETTLE's free rotation, which is
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

    def middle(h):
        integrator = openmm.LangevinMiddleIntegrator(temperature, friction, h)
        integrator.setRandomNumberSeed(seed)
        return integrator

    def langevin(h, scheme):
        integrator = SIERLangevinIntegrator(temperature, friction, h, scheme=scheme)
        integrator.setRandomNumberSeed(seed)
        return integrator

    methods = {"langevinmiddle": Method("OpenMM LangevinMiddle", 1, middle)}
    for name, scheme in CATALOGUE.items():
        make = partial(langevin, scheme=scheme)
        bias = BIAS_NVT if scheme is SIER2 else math.nan
        methods[name] = Method(f"{scheme.name} Langevin", scheme.force_evaluations, make, bias)
    return methods


def sample(context, bodies: RigidBodies, steps: int, every: int, progress=None) -> Series:
    """Run a Context and record energies and temperatures at whole steps.

    OpenMM's leapfrog keeps velocities half a step back; its temperatures are taken on step, from the velocities that
    half a step of the forces turns them into, as OpenMM's own kinetic energy is.

    Args:
        context: with positions and velocities.
        bodies: its rigid bodies.
        steps: number of steps.
        every: steps between two samples.
        progress: called with the number of steps done.

    Raises:
        Unstable: an energy is not finite, the temperature has left 0 to 3000 K, or molecules are torn.
    """
    integrator = context.getIntegrator()
    removed = 3 if _removes_motion(context.getSystem()) else 0
    rows = []
    for done in range(every, steps + 1, every):
        integrator.step(every)
        state = context.getState(energy=True)
        try:
            motion = _body_state(context, bodies)
        except (RigidityError, NotFiniteError) as error:
            raise Unstable(f"after {done} steps {error}") from error
        rows.append(
            (
                state.getTime().value_in_unit(unit.picosecond),
                state.getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole),
                state.getKineticEnergy().value_in_unit(unit.kilojoule_per_mole),
                *bodies.temperatures(motion, removed),
                state.getPeriodicBoxVolume().value_in_unit(unit.nanometer**3),
            )
        )
        if not (np.isfinite(rows[-1]).all() and 0 <= rows[-1][3] < 3000 and rows[-1][4] < 3000):
            raise Unstable(f"temperatures of {rows[-1][3]:.0f} K and {rows[-1][4]:.0f} K after {done} steps")
        if progress is not None:
            progress(done)
    return Series(*np.array(rows).T)


def _removes_motion(system) -> bool:
    return any(isinstance(system.getForce(i), openmm.CMMotionRemover) for i in range(system.getNumForces()))


def _body_state(context, bodies: RigidBodies) -> BodyState:
    """The bodies at the whole step, whichever integrator the Context has."""
    integrator = context.getIntegrator()
    if isinstance(integrator, SIERIntegrator):
        return integrator.getBodyState()
    leapfrog = isinstance(integrator, openmm.VerletIntegrator)
    state = context.getState(positions=True, velocities=True, forces=leapfrog)
    q, A = bodies.fit(state.getPositions(asNumpy=True).value_in_unit(unit.nanometer))
    velocities = state.getVelocities(asNumpy=True).value_in_unit(unit.nanometer / unit.picosecond)
    p, L = bodies.momenta(velocities, A)
    if leapfrog:
        # Constraint forces have no net force and torque on a body, so that they need not be known.
        forces = state.getForces(asNumpy=True).value_in_unit(unit.kilojoule_per_mole / unit.nanometer)
        F, tau = bodies.forces_and_torques(forces, A)
        half = 0.5 * integrator.getStepSize().value_in_unit(unit.picosecond)
        p, L = p + half * F, L + half * tau
    return BodyState(q, p, A, L)


def steepness(context, bodies: RigidBodies, samples: int, every: int) -> tuple[float, float]:
    """Temperature times the mean squared frequency of translation and of rotation, K/ps^2.

    In equilibrium <F M^-1 F> = kT <tr M^-1 V''>, and the like with torques and moments, so that forces tell it.

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
    freedoms = np.array([3 * bodies.n, bodies.dof - 3 * bodies.n])
    translation, rotation = np.divide(sums / (samples * GAS_CONSTANT), freedoms, out=np.zeros(2), where=freedoms > 0)
    return float(translation), float(rotation)


def mean_and_error(values, blocks: int = 20) -> tuple[float, float]:
    """Mean of a correlated series and its standard error, from the scatter of the means of equal blocks.

    Args:
        values: the series; a remainder that fills no block is left out at its start.
        blocks: how many, each of which must be longer than the correlation time.
    """
    values = np.asarray(values, dtype=float)
    blocks = min(blocks, len(values))
    length = len(values) // blocks
    means = values[len(values) - blocks * length :].reshape(blocks, length).mean(axis=1)
    return float(means.mean()), float(means.std(ddof=1) / np.sqrt(blocks)) if blocks > 1 else float("nan")


def fluctuation(series: Series) -> float:
    """rms(H)/rms(V), the paper's measure of energy conservation."""
    return float(np.std(series.total) / np.std(series.potential))
