"""OpenMM's own integrators with the interface of this package: observed at whole steps, and restarted bit for bit.

OpenMM's Verlet is a leapfrog: velocities in its Context are half a step earlier than positions. Here velocities are
advanced by half a step of the forces to whole steps, as for OpenMM's own kinetic energy.

States contain neither the random numbers of OpenMM's thermostats and barostats nor the size of its volume moves. A run
continued after a checkpoint must nevertheless equal one restarted from it. So both reseed the noise at the checkpoint,
with a seed derived from the run's seed and the step.
"""

import math
import weakref
from typing import Any

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.bodies import BodySet, BodyState, NotFiniteError, RigidityError
from openmm_sier.engines.records import TrajectoryError
from openmm_sier.engines.snapshot import Snapshot
from openmm_sier.system import tables
from openmm_sier.system.second_context import cloned
from openmm_sier.system.solver_test import SolverTest
from openmm_sier.system.temperature import MomentumConservation, Temperatures, temperatures

#: Constraint tolerance; SETTLE is not more accurate than 1e-8.
CONSTRAINT_TOLERANCE = 1e-7

#: Steps between two volume moves, OpenMM's default. The count restarts at each checkpoint.
BAROSTAT_INTERVAL = 25


class OpenMMIntegrator(openmm.Integrator):
    """OpenMM integrator with the interface of a SIER integrator. Call `bind` first.

    Attributes:
        bodies: the rigid bodies of the Context.
        forceEvaluations: number of steps completed, with one force evaluation each.
    """

    bodies: BodySet

    #: Whether a thermostat or barostat of OpenMM adds heat that is not counted.
    _bathed = False

    def bind(self, context: openmm.Context, bodies: BodySet) -> None:
        """Set the Context of the integrator and the bodies in it."""
        self.bodies = bodies
        # The Context holds the integrator.
        self._context = weakref.proxy(context)
        self._momentum = MomentumConservation(context.getSystem(), bodies)

    @property
    def forceEvaluations(self) -> int:
        return self._context.getStepCount()

    @property
    def conservesMomentum(self) -> bool:
        """Whether the total momentum is conserved, see `MomentumConservation`."""
        return self._momentum.holds(self.getIntegrationForceGroups(), self._has_friction())

    def _has_friction(self) -> bool:
        """Return whether the integrator itself is a heat bath."""
        return False

    def getBodyState(self) -> BodyState:
        """Return the phase point of the bodies at the whole step.

        Raises:
            TrajectoryError: positions or velocities are not finite, or molecules are torn.
        """
        try:
            return body_state(self._context, self.bodies)
        except (NotFiniteError, RigidityError) as error:
            raise TrajectoryError(str(error)) from error

    @property
    def countedHeat(self) -> float:
        """See `SIERIntegrator.countedHeat`; NaN if a thermostat or barostat of OpenMM adds heat."""
        return math.nan if self._bathed else 0.0

    def computeTemperatures(self) -> Temperatures:
        """Return temperatures; see `SIERIntegrator.computeTemperatures`."""
        return temperatures(self.bodies, self.getBodyState(), self.conservesMomentum).as_quantities()

    def reported(self) -> dict[str, float]:
        """Return additional columns of the log: none."""
        return {}


class OpenMMVerletIntegrator(OpenMMIntegrator, openmm.VerletIntegrator):
    """OpenMM's VerletIntegrator."""


class OpenMMLangevinMiddleIntegrator(OpenMMIntegrator, openmm.LangevinMiddleIntegrator):
    """OpenMM's LangevinMiddleIntegrator."""

    def _has_friction(self) -> bool:
        return self.getFriction() > 0 / unit.picosecond


def make_integrator(
    system: openmm.System,
    positions: np.ndarray,
    name: str,
    step: float,
    temperature: float | None = None,
    friction: float = 1.0,
    pressure: float | None = None,
) -> tuple[openmm.System, OpenMMIntegrator]:
    """Create an integrator of OpenMM, and a copy of a System with a thermostat and barostat.

    Args:
        system: System to be simulated.
        positions: positions of its particles, (N, 3), nm.
        name: "verlet" or "langevinmiddle".
        step: step, ps.
        temperature: K; None for constant energy, with "verlet" only.
        friction: friction, 1/ps; with Verlet, collision rate of the AndersenThermostat.
        pressure: pressure of a MonteCarloBarostat, bar; None for constant volume.

    Raises:
        openmm.OpenMMException: OpenMM cannot satisfy the System's constraints.
    """
    SolverTest(system).refuse(lambda: positions)
    system = cloned(system)
    integrator: Any = (
        OpenMMVerletIntegrator(step)
        if name == "verlet"
        else OpenMMLangevinMiddleIntegrator(temperature, friction, step)
    )
    if name == "verlet" and temperature is not None:
        system.addForce(openmm.AndersenThermostat(temperature, friction))
    if pressure is not None:
        system.addForce(openmm.MonteCarloBarostat(pressure * unit.bar, temperature, BAROSTAT_INTERVAL))
    integrator.setConstraintTolerance(CONSTRAINT_TOLERANCE)
    integrator._bathed = temperature is not None or pressure is not None
    return system, integrator


def seed_noise(system: openmm.System, integrator: openmm.Integrator, seed: int, step: int) -> None:
    """Set the seeds of an integrator and Forces for the next Context or `reinitialize`, at a given step of a run."""
    noisy = [source for source in (integrator, *system.getForces()) if hasattr(source, "setRandomNumberSeed")]
    # OpenMM uses 31 bits, and chooses a random seed for 0.
    words = np.random.SeedSequence([seed, step]).generate_state(len(noisy))
    for source, word in zip(noisy, words.tolist(), strict=True):
        source.setRandomNumberSeed(word % (2**31 - 1) + 1)


def continue_as_restart(context: openmm.Context, seed: int) -> None:
    """Make a Context of an `OpenMMIntegrator` continue after a checkpoint exactly like a restart from it."""
    state = context.getState(positions=True, velocities=True, parameters=True)
    seed_noise(context.getSystem(), context.getIntegrator(), seed, context.getStepCount())
    # reinitialize(preserveState=True) would keep the old noise.
    context.reinitialize()
    context.setState(state)


def body_state(context: openmm.Context, bodies: BodySet) -> BodyState:
    """Return the state of the bodies at a whole step of an OpenMM integrator.

    Raises:
        NotFiniteError, RigidityError: the positions do not form the bodies.
    """
    integrator, snapshot = context.getIntegrator(), Snapshot.of(context)
    q, A = bodies.fit(snapshot.positions)
    p, L = bodies.momenta(snapshot.velocities, A)
    if isinstance(integrator, openmm.VerletIntegrator):
        # Constraint forces are not needed: within a body they exert no net force or torque, and between bodies the
        # projection replaces them.
        F, tau = bodies.forces_and_torques(_forces(context), A)
        half = 0.5 * integrator.getStepSize().value_in_unit(unit.picosecond)
        p, L = p + half * F, L + half * tau
    p = bodies.constraints.project(q, p)
    return BodyState(q, p, A, L)


def shift_velocities(context: openmm.Context, time: float) -> None:
    """Advance the velocities of a Context by its forces over a time in ps, which may be negative.

    Half a step backwards turns velocities at whole steps into the initial velocities of OpenMM's Verlet; half a step
    forwards reverts this.
    """
    masses, velocities = tables.masses(context.getSystem()), Snapshot.of(context).velocities
    massive = masses > 0
    velocities[massive] += time * _forces(context)[massive] / masses[massive, None]
    context.setVelocities(velocities)
    context.applyVelocityConstraints(CONSTRAINT_TOLERANCE)


def _forces(context: openmm.Context) -> np.ndarray:
    forces = context.getState(forces=True).getForces(asNumpy=True)
    return forces.value_in_unit(unit.kilojoule_per_mole / unit.nanometer)
