"""OpenMM's own integrators, used like this package's: observed at whole steps, and restarted bit for bit.

OpenMM's Verlet is a leapfrog: the velocities in its Context are those half a step before the positions. Everything here
refers to whole steps: there velocities are advanced by half a step of the forces, as for OpenMM's own kinetic energy.

The random numbers of OpenMM's baths and barostats, and the size of its volume moves, are in no State. A run that goes
on after a checkpoint must nevertheless equal one that is restarted from it. So both begin the noise anew there, with a
seed derived from the run's seed and the step.
"""

import math
import weakref
from typing import Any

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.bodies import BodySet, BodyState, NotFiniteError, RigidityError
from openmm_sier.engines.protocol import TrajectoryError
from openmm_sier.engines.snapshot import Snapshot
from openmm_sier.system import tables
from openmm_sier.system.solver_trial import SolverTrial
from openmm_sier.system.temperature import MomentumConservation, Temperatures, temperatures

#: Tolerance of constraints; SETTLE is not better than 1e-8.
CONSTRAINT_TOLERANCE = 1e-7

#: Steps between two attempts to change the volume, OpenMM's default. The count restarts at each checkpoint.
BAROSTAT_INTERVAL = 25


class OpenMMIntegrator(openmm.Integrator):
    """Give OpenMM's integrators the interface of this package's integrators. Call `bind` before anything else.

    Attributes:
        bodies: the rigid bodies of the Context.
        forceEvaluations: number of steps done, since each needs one.
    """

    bodies: BodySet

    #: Whether a bath or barostat of OpenMM gives heat that is not counted.
    _bathed = False

    def bind(self, context: openmm.Context, bodies: BodySet) -> None:
        """Tell the integrator about its Context and the bodies in it."""
        self.bodies = bodies
        # The Context holds the integrator.
        self._context = weakref.proxy(context)
        self._momentum = MomentumConservation(context.getSystem(), bodies)

    @property
    def forceEvaluations(self) -> int:
        return self._context.getStepCount()

    @property
    def conservesMomentum(self) -> bool:
        """Return whether the total momentum is conserved, see `MomentumConservation`."""
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
        """See `SIERIntegrator.countedHeat`: NaN if a bath or barostat of OpenMM gives any."""
        return math.nan if self._bathed else 0.0

    def computeTemperatures(self) -> Temperatures:
        """Return temperatures, as `SIERIntegrator.computeTemperatures` gives them."""
        return temperatures(self.bodies, self.getBodyState(), self.conservesMomentum).as_quantities()

    def reported(self) -> dict[str, float]:
        """Return no further columns of the log."""
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
    """Make an integrator of OpenMM, and a copy of a System; add the thermostat and barostat to the copy.

    Args:
        system: to be simulated.
        positions: of its particles, (N, 3), nm.
        name: "verlet" or "langevinmiddle".
        step: ps.
        temperature: K; None at constant energy, which "langevinmiddle" does not have.
        friction: 1/ps; with Verlet, the collision rate of its AndersenThermostat.
        pressure: bar, of a MonteCarloBarostat; None at constant volume.

    Raises:
        openmm.OpenMMException: OpenMM cannot satisfy the System's constraints.
    """
    SolverTrial(system).refuse(lambda: positions)
    system = openmm.XmlSerializer.clone(system)
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
    """Set the seeds with which the next Context, or the next `reinitialize`, starts at a given step of a run."""
    noisy = [one for one in (integrator, *system.getForces()) if hasattr(one, "setRandomNumberSeed")]
    # OpenMM takes 31 bits, and draws a seed itself where it is given 0.
    words = np.random.SeedSequence([seed, step]).generate_state(len(noisy))
    for one, word in zip(noisy, words.tolist(), strict=True):
        one.setRandomNumberSeed(word % (2**31 - 1) + 1)


def continue_as_restart(context: openmm.Context, seed: int) -> None:
    """Make a Context of a `OpenMMIntegrator` continue from a checkpoint exactly as a restart from it would."""
    state = context.getState(positions=True, velocities=True, parameters=True)
    seed_noise(context.getSystem(), context.getIntegrator(), seed, context.getStepCount())
    # Keeping the state here would keep the old noise.
    context.reinitialize()
    context.setState(state)


def body_state(context: openmm.Context, bodies: BodySet) -> BodyState:
    """Return the state of the bodies at a whole step, from atoms that one of OpenMM's integrators moves.

    Raises:
        NotFiniteError, RigidityError: the positions do not form the bodies.
    """
    integrator, now = context.getIntegrator(), Snapshot.of(context)
    q, A = bodies.fit(now.positions)
    p, L = bodies.momenta(now.velocities, A)
    if isinstance(integrator, openmm.VerletIntegrator):
        # Constraint forces need not be known: within a body they exert no net force or torque, and between bodies the
        # projection replaces them.
        F, tau = bodies.forces_and_torques(_forces(context), A)
        half = 0.5 * integrator.getStepSize().value_in_unit(unit.picosecond)
        p, L = p + half * F, L + half * tau
    p = bodies.constraints.project(q, p)
    return BodyState(q, p, A, L)


def shift_velocities(context: openmm.Context, time: float) -> None:
    """Advance the velocities of a Context by its forces over a time in ps, which may be negative.

    Half a step back turns velocities at whole steps into those that OpenMM's Verlet starts from; half a step forward
    undoes this.
    """
    masses, velocities = tables.masses(context.getSystem()), Snapshot.of(context).velocities
    massive = masses > 0
    velocities[massive] += time * _forces(context)[massive] / masses[massive, None]
    context.setVelocities(velocities)
    context.applyVelocityConstraints(CONSTRAINT_TOLERANCE)


def _forces(context: openmm.Context) -> np.ndarray:
    forces = context.getState(forces=True).getForces(asNumpy=True)
    return forces.value_in_unit(unit.kilojoule_per_mole / unit.nanometer)
