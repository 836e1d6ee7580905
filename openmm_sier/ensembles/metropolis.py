"""Hybrid Monte Carlo: a step is a trial, a trajectory that is accepted or rejected on its true energy."""

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import openmm

from openmm_sier.dynamics.acceptance import is_accepted, over_relaxed, usual_chances
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.flow import Flow
from openmm_sier.dynamics.schemes import BATH, Scheme
from openmm_sier.dynamics.thermostat import OrnsteinUhlenbeck
from openmm_sier.engines.protocol import Clock, Engine, TrajectoryError
from openmm_sier.engines.variables import PREFIX
from openmm_sier.ensembles.ensemble import ConstantTemperature, make_number
from openmm_sier.ensembles.thermal_motion import ThermalMotion
from openmm_sier.system.forces import kind_of

#: Global variables of all trials: their number, how many were accepted, the energy error at the first end of the last
#: one in kT; and the step in ps at which reversibility was checked, with the error found, nm.
TRIALS, ACCEPTED, ERROR, CHECKED_STEP, REVERSAL = (
    PREFIX + name for name in ("trials", "accepted", "error", "checked_step", "reversal")
)

#: A trajectory that comes back to its start within this distance, in nm, counts as reversible. An irreversible one,
#: such as that of a scheme that is not a palindrome, misses by a multiple of this at usual steps. Rounding and forces
#: in single precision cause a miss of 1e-12 to 1e-6, see docs/guide/hmc.md.
REVERSIBLE = 1e-4


@dataclass(frozen=True)
class Metropolis(ConstantTemperature):
    """Sample the canonical ensemble without an error of the step, as `SIERHMCIntegrator` does.

    The ends of trials are samples. A step that cannot be completed is undone, so that the Context is always at a
    sample.

    Attributes:
        temperature: in K.
        friction: momenta keep a factor exp(-friction t) in a trial of length t, 1/ps; None draws all of them anew. In
            either case their kinetic energy is over-relaxed, see `dynamics.acceptance`.
        steps_per_trial: number of steps of the scheme in a trial.
        extra_chances: how many times a trajectory whose end is not accepted goes on by as many steps, and has its new
            end accepted or not; None takes `usual_chances`.
    """

    friction: float | None
    steps_per_trial: int
    extra_chances: int | None = None

    counts: ClassVar[tuple[str, ...]] = (
        *ConstantTemperature.counts,
        TRIALS,
        ACCEPTED,
        ERROR,
        CHECKED_STEP,
        REVERSAL,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.temperature:
            raise ValueError("temperature must be above zero for hybrid Monte Carlo, got 0 K")
        if self.friction is not None:
            make_number(self, "friction", "frictionCoeff", "1/ps", least=0)
            if not self.friction:
                raise ValueError("frictionCoeff must be above zero, got 0: momenta would never be drawn")
        make_number(self, "steps_per_trial", "stepsPerTrial", least=1)
        if self.extra_chances is not None:
            make_number(self, "extra_chances", "extraChances", least=0)

    @property
    def steps(self) -> int:
        return self.steps_per_trial

    @property
    def needs_package(self) -> bool:
        """Return True, since OpenMM alone would accept every trial."""
        return True

    @property
    def has_friction(self) -> bool:
        """Return True, since momenta are drawn anew, in part or all of them."""
        return True

    def scheme_for(self, scheme: Scheme) -> Scheme:
        if BATH in scheme.operators:
            raise ValueError(
                f"scheme {scheme.name} has a bath, but hybrid Monte Carlo draws momenta only between trials: take a "
                "scheme without a bath"
            )
        if not scheme.is_palindrome:
            raise ValueError(
                f"scheme {scheme.name} is not a palindrome, so that its trajectories cannot be reversed: take a scheme "
                "that is one"
            )
        return scheme

    def flow(self, flow: Flow) -> Flow:
        return replace(flow, updates_context=False)

    def check(self, system: openmm.System, engine: Engine) -> None:
        for force in system.getForces():
            if kind_of(force).sets:
                raise openmm.OpenMMException(
                    f"Remove the {type(force).__name__}: it acts within trajectories, which hybrid Monte Carlo does "
                    "not allow. The integrator keeps the temperature, and the pressure if you give it pressure=1*bar"
                )
        super().check(system, engine)

    def advance(self, engine: Engine, steps: int) -> None:
        for _ in range(steps):
            with engine.transaction():
                self._trial(engine)

    def _trial(self, engine: Engine) -> None:
        ledger, length = engine.ledger, self.steps_per_trial * engine.flow.step
        time, steps = engine.clock
        self._draw_momenta(engine, length)
        decision = ledger.draws
        ledger.draws += 1
        start, energy = engine.remember(), _energy(engine)
        if not math.isfinite(energy):
            raise openmm.OpenMMException(
                f"The energy at the beginning of step {steps + 1} is {energy}, so that no trajectory can begin. Do "
                "atoms overlap? Then minimize the energy first"
            )
        self._check_reversal(engine)
        errors, accepted = [], False
        for _ in range(1 + self._chances(engine)):
            errors.append(self._error_of_end(engine, energy))
            accepted = is_accepted(errors[-1], ledger.seed, decision)
            # From where forces are not finite no trajectory goes on, from the other side neither.
            if accepted or not math.isfinite(errors[-1]):
                break
        if not accepted:
            engine.go_back(start, reverse=True)
        if engine.removes_momentum:
            engine.shift_velocities(-engine.centre_velocity())
        trials, before = ledger.counts[TRIALS] + 1, ledger.counts[ACCEPTED]
        engine.clock = Clock(time + length, steps + 1)
        # At once, so that an error does not find a trial that is counted in part.
        ledger.counts |= {TRIALS: trials, ACCEPTED: before + accepted, ERROR: errors[0]}

    def _error_of_end(self, engine: Engine, energy: float) -> float:
        """Follow a trajectory to its next end; return the energy there less that of the start, in kT.

        It is infinite where the trajectory cannot be followed.
        """
        try:
            engine.follow(self.steps_per_trial, wants_energy=True)
            error = (_energy(engine) - energy) / (GAS_CONSTANT * self.temperature)
        except TrajectoryError:
            return math.inf
        return math.inf if math.isnan(error) else error

    def _chances(self, engine: Engine) -> int:
        """Return how many times a trajectory may go on."""
        if self.extra_chances is None:
            return usual_chances(self.steps_per_trial * engine.flow.step)
        return self.extra_chances

    def _draw_momenta(self, engine: Engine, time: float) -> None:
        """Draw momenta anew, in part or all of them, with a kinetic energy that is over-relaxed."""
        # Infinite friction has no meaning for steps of zero length, in which nothing moves.
        if not time or not engine.moving.mass:
            return
        before = ThermalMotion.of(engine, engine.removes_momentum).energy
        if engine.removes_momentum and self.friction is not None:
            # The centre of mass was stopped after the last trial. Its momentum is drawn anew, the rest in part.
            spread = math.sqrt(GAS_CONSTANT * self.temperature / engine.moving.mass)
            engine.shift_velocities(spread * engine.ledger.noise(stream=3).standard_normal(3))
        friction = math.inf if self.friction is None else self.friction
        engine.draw_momenta(OrnsteinUhlenbeck(self.temperature, friction, friction), time)
        motion = ThermalMotion.of(engine, engine.removes_momentum)
        if motion.freedoms > 0:
            unit = 0.5 * GAS_CONSTANT * self.temperature
            motion.scale_to(unit * over_relaxed(before / unit, motion.freedoms, engine.ledger.noise(stream=5)))

    def _check_reversal(self, engine: Engine) -> None:
        """Follow a trajectory there and back, once for each step size.

        Raises:
            openmm.OpenMMException: it does not come back.
        """
        counts, step = engine.ledger.counts, engine.flow.step
        if counts[CHECKED_STEP] == step:
            return
        # Later ends need not exist, for example where atoms leave a potential that ends.
        for steps in (self.steps_per_trial * (1 + self._chances(engine)), self.steps_per_trial):
            error = reversal_error(engine, steps)
            if math.isfinite(error):
                break
        if not error <= REVERSIBLE:
            raise openmm.OpenMMException(
                f"A trajectory of {steps} steps, followed backwards, missed its start by {error:.1e} nm; up to "
                f"{REVERSIBLE:.0e} nm is allowed. Samples would not be exact: take fewer or shorter steps in a "
                "trajectory, or fewer extraChances"
            )
        counts[REVERSAL] = error
        counts[CHECKED_STEP] = step


def reversal_error(engine: Engine, steps: int) -> float:
    """Follow a trajectory there and back, and return the distance by which it misses its start; undo it.

    Returns:
        The largest distance of an atom from its place at the start, nm; infinite if it could not be followed.
    """
    start, before = engine.remember(), engine.positions()
    try:
        for _ in range(2):
            engine.follow(steps)
            if not np.isfinite(engine.positions()).all():
                return math.inf
            engine.go_back(engine.remember(), reverse=True)
        return float(np.linalg.norm(engine.positions() - before, axis=1).max(initial=0.0))
    except TrajectoryError:
        return math.inf
    finally:
        engine.go_back(start)


def _energy(engine: Engine) -> float:
    return engine.potential_energy() + engine.kinetic_energy()
