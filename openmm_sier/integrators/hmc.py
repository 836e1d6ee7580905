"""Hybrid Monte Carlo of rigid bodies and constrained molecules, for OpenMM users."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import openmm

from openmm_sier.dynamics import metropolis, operators
from openmm_sier.dynamics.bodies import BodyState
from openmm_sier.dynamics.metropolis import HybridMonteCarlo, NoEnergyError, SampledState, Trial
from openmm_sier.dynamics.operators import Operator, Stepper
from openmm_sier.dynamics.rotation import exact
from openmm_sier.dynamics.schemes import BATH, SIER4G, Scheme
from openmm_sier.engines import stored_state
from openmm_sier.engines.exact.engine import BlownUp, Engine
from openmm_sier.engines.native.trials import NativeTrials
from openmm_sier.engines.snapshot import Snapshot
from openmm_sier.engines.stored_state import HEAT
from openmm_sier.engines.trial_record import (
    ACCEPTED,
    CHECKED_STEP,
    END,
    ENERGY,
    ERROR,
    GLOBALS,
    LEFT,
    REVERSAL,
    START_HEAT,
    START_VARIABLES,
    STEP,
    THERMAL,
    TRIALS,
)
from openmm_sier.integrators import stored_settings
from openmm_sier.integrators.constant_temperature import ConstantTemperatureIntegrator, checked_friction
from openmm_sier.system import checks
from openmm_sier.system.arguments import Bodies, whole_number
from openmm_sier.system.notices import tell

#: A trajectory that comes back to its start within this distance, in nm, counts as reversible. An irreversible one,
#: such as that of a scheme that is not a palindrome, misses by a multiple of this at usual steps. Rounding and forces
#: in single precision cause a miss of 1e-12 to 1e-6, see docs/hmc.md.
REVERSIBLE = 1e-4


class SIERHMCIntegrator(ConstantTemperatureIntegrator):
    """Hybrid Monte Carlo: samples of the canonical ensemble without time-step error.

    A trial is a trajectory of `stepsPerTrial` steps of the scheme, from momenta that are drawn anew, fully or in part.
    Its end is accepted or rejected by its true energy; after a rejection the Context is back at the start of the trial,
    with reversed velocities. A step that is too long lowers the acceptance, but causes no bias.

    Samples exist only at step numbers that are multiples of `stepsPerTrial`: report at such intervals. In between, the
    Context is on a trajectory that may be rejected. A trial that begins at another step number, for example after
    positions were set in mid-trial, ends at the next multiple.

    Setting positions or velocities in mid-trial ends the trial: the next step begins another one from there. Changing
    the step size, a parameter of the Context, the box or a Force abandons the trial: the next step begins another one
    from the start of the abandoned one. A temperature set in mid-trial applies from the next trial on. A trajectory
    that cannot be followed to its end, because a force is not finite or constraints cannot be satisfied, is rejected.

    Before the first trajectory counts, it is reversed and followed back to its start, once for each step size and again
    when trials become longer. The integrator refuses to go on if it does not come back; `reversalError` tells how close
    it came.

    Random numbers are as with `SIERLangevinIntegrator`, and a restart is bit-identical in mid-trial too. The total
    energy less the heat changes only by the energy errors of accepted trials.

    With a CMMotionRemover in the System the total momentum is held at zero, in draws and in kicks. Barostats and
    AndersenThermostats in the System are refused.

    The native engine follows trajectories on the device from end to end. It supports neither `pressure` nor a
    CMMotionRemover: with either, `engine="auto"` takes the exact engine on every platform.

    Sources: Duane, Kennedy, Pendleton and Roweth, Phys. Lett. B 195, 216 (1987); Horowitz, Phys. Lett. B 268, 247
    (1991).
    """

    _RECORD = (*ConstantTemperatureIntegrator._RECORD, LEFT, END, TRIALS, ACCEPTED, CHECKED_STEP)

    def __init__(
        self,
        temperature: Any,
        stepSize: Any,
        scheme: Scheme = SIER4G,
        stepsPerTrial: int = 10,
        frictionCoeff: Any = None,
        pressure: Any = None,
        barostatInterval: int = 1,
        bodies: Bodies = None,
        rotation: operators.Rotation = exact,
        engine: str = "auto",
        substeps: int | None = None,
        fastForceGroups: Iterable[int] | int | None = None,
    ):
        """
        Args:
            temperature: a quantity or a number in K, above zero.
            stepSize: step, a time quantity or a number in ps.
            scheme: splitting scheme without a bath; it must be a palindrome.
            stepsPerTrial: steps of each trial.
            frictionCoeff: a quantity or a number in 1/ps. Momenta keep a factor exp(-friction t) in a trial of length
                t, and the rest is drawn anew; None draws all of them anew.
            pressure: for constant pressure, a quantity or a number in bar; see `SIERLangevinIntegrator`.
            barostatInterval: number of trials between attempts to change the volume.
            bodies, rotation, engine, substeps, fastForceGroups: see `SIERIntegrator`.

        Raises:
            ValueError: a value is not finite or has the wrong sign, or the scheme has a bath or is not a palindrome.
            TypeError: a quantity has the wrong dimension.
        """
        if isinstance(scheme, Scheme):
            _check_scheme(scheme)
        super().__init__(stepSize, scheme, bodies, rotation, engine, substeps, fastForceGroups)
        for name in START_VARIABLES:
            self.addPerDofVariable(name, 0)
        for name in GLOBALS:
            self.addGlobalVariable(name, 0)
        friction = _friction(frictionCoeff)
        self._surround(self._checked_temperature(temperature), (friction, friction), pressure, barostatInterval)
        self._store_surroundings()
        self.setStepsPerTrial(stepsPerTrial)

    def _only_exact(self) -> str | None:
        if self._piston is not None:
            return "has no `pressure` with hybrid Monte Carlo: leave it out"
        if self._holds_still:
            return "cannot hold the total momentum at zero: create the System with removeCMMotion=False"
        return super()._only_exact()

    def _needs_package(self) -> bool:
        # OpenMM alone would accept every trial.
        return not (isinstance(self._engine, NativeTrials) and self._engine.is_running)

    #: Whether a CMMotionRemover in the System wants the total momentum to be zero.
    _holds_still = False

    def _take_settings(self, rotation: operators.Rotation | None = None) -> None:
        super()._take_settings(rotation)
        self._steps_per_trial = int(stored_settings.required(self, "trial")[1][0])

    @staticmethod
    def _checked_temperature(value: Any) -> float:
        if (found := ConstantTemperatureIntegrator._checked_temperature(value)) == 0:
            raise ValueError("temperature must be above zero for hybrid Monte Carlo, got 0 K")
        return found

    #: A placeholder until the settings are in place.
    _steps_per_trial = 0

    # --- what users ask ---

    def getStepsPerTrial(self) -> int:
        """Steps of each trial."""
        return self._steps_per_trial

    def setStepsPerTrial(self, steps: int) -> None:
        """Set the steps of trials that begin from now on."""
        if (steps := whole_number("stepsPerTrial", steps)) == 0:
            raise ValueError("stepsPerTrial must be at least 1, got 0")
        if steps > self._steps_per_trial:
            self.setGlobalVariableByName(CHECKED_STEP, 0)
        self._steps_per_trial = steps
        stored_settings.store(self, "trial", [steps])

    def setFriction(self, coeff: Any) -> None:
        """Set the friction, a quantity or a number in 1/ps; None, an infinite friction, draws all momenta anew."""
        self._bath.friction = self._bath.rotational_friction = _friction(coeff)
        self._store_surroundings()

    @property
    def trials(self) -> int:
        """Number of completed trials."""
        return int(self.getGlobalVariableByName(TRIALS))

    @property
    def accepted(self) -> int:
        """Number of accepted trials."""
        return int(self.getGlobalVariableByName(ACCEPTED))

    @property
    def acceptanceRate(self) -> float:
        """The fraction of trials that were accepted; NaN before the first one."""
        return self.accepted / self.trials if self.trials else math.nan

    @property
    def lastEnergyError(self) -> float:
        """Energy at the end of the last trial minus that at its start, in kT; infinite if its trajectory failed.

        NaN before the first trial and after `resetStatistics`.
        """
        return self.getGlobalVariableByName(ERROR) if self.trials else math.nan

    @property
    def reversalError(self) -> float:
        """Largest distance in nm by which an atom missed its start when the first trajectory was followed back.

        NaN before the first trial, and after the trials were made longer.
        """
        return self.getGlobalVariableByName(REVERSAL) if self.getGlobalVariableByName(CHECKED_STEP) else math.nan

    def reported(self) -> dict[str, float]:
        """Additional columns for `ConservationReporter`: the fraction of trials accepted, and the last energy error."""
        return {"Acceptance": self.acceptanceRate, "Energy Error (kT)": self.lastEnergyError}

    def resetStatistics(self) -> None:
        """Count trials from zero again."""
        for name in (TRIALS, ACCEPTED):
            self.setGlobalVariableByName(name, 0)

    def finishTrial(self) -> None:
        """Advance to the next sample, at a multiple of `stepsPerTrial`; a Context already at a sample stays there."""
        while steps := self._steps_to_sample():
            self.step(steps)

    def _steps_to_sample(self) -> int:
        if isinstance(engine := self._bound(), NativeTrials):
            return engine.steps_to_sample()
        engine = self._adopted()
        trial = SampledState.of(engine.state).trial
        return trial.left if trial is not None else -engine.steps % self._steps_per_trial

    def _sampled_energy(self) -> float:
        """Present potential energy of the bodies, kJ/mol; at a sample it is known from the trial and costs nothing."""
        if isinstance(engine := self._bound(), NativeTrials):
            return engine.potential_energy()
        engine = self._adopted()
        return engine.potential_energy(engine.state)

    def _adopted(self) -> Engine:
        """The engine, brought up to date with the Context."""
        engine = self._bound()
        assert isinstance(engine, Engine)
        engine.adopt()
        return engine

    # --- for the engine ---

    def _prepare_for(self, system: openmm.System) -> None:
        super()._prepare_for(system)
        for name in START_VARIABLES:
            if len(self.getPerDofVariableByName(name)) > 1:
                self.setPerDofVariableByName(name, np.zeros((system.getNumParticles(), 3)))

    def _bind(self, context: openmm.Context) -> None:
        forces = context.getSystem().getForces()
        for force in forces:
            if isinstance(force, (*checks.BAROSTATS, openmm.AndersenThermostat)):
                remedy = "leave it out" if isinstance(force, openmm.AndersenThermostat) else "give `pressure` instead"
                raise openmm.OpenMMException(
                    f"A {type(force).__name__} acts within trajectories, which hybrid Monte Carlo does not allow: "
                    f"{remedy}"
                )
        self._holds_still = any(isinstance(force, openmm.CMMotionRemover) for force in forces)
        super()._bind(context)

    def _prefers_exact(self, platform: str) -> bool:
        return super()._prefers_exact(platform) or self._piston is not None or self._holds_still

    def _native_engine(self, context: openmm.Context) -> NativeTrials:
        return NativeTrials(self, context)

    def _moves_volume(self, state: BodyState, steps: int) -> bool:
        # Only between trials.
        if self._piston is None or SampledState.of(state).trial is not None:
            return False
        return (steps // self._steps_per_trial + 1) % self._piston.interval == 0

    def _stepper(self, engine: Engine, scheme: Scheme, operations: Mapping[str, Operator], h: float) -> Stepper:
        bodies = engine.bodies
        if self._holds_still:
            operations = metropolis.at_rest(bodies, operations)
        advance = operators.stepper(scheme, operations, h)
        drawn = metropolis.refreshment(operations[BATH], bodies, self._holds_still)

        def refresh(state: BodyState, time: float) -> BodyState:
            start = drawn(state, time)
            self._check_reversal(engine, advance, start, h)
            return start

        def length() -> int:
            return self._steps_per_trial - engine.steps % self._steps_per_trial

        sampler = HybridMonteCarlo(self._bath, refresh, length, (*metropolis.FAILURES, BlownUp))
        step = sampler.stepper(bodies, advance, engine.potential_energy, h)

        def checked(state: BodyState) -> BodyState:
            try:
                return step(state)
            except NoEnergyError as error:
                raise openmm.OpenMMException(f"In step {engine.steps + 1} {error}. Do atoms overlap?") from error

        return checked

    def _check_reversal(self, engine: Engine, advance: Stepper, start: BodyState, h: float) -> None:
        if h == self.getGlobalVariableByName(CHECKED_STEP):
            return
        self._refuse_irreversible(metropolis.reversal_error(engine.bodies, advance, start, self._steps_per_trial))

    def _refuse_irreversible(self, error: float) -> None:
        """Record a reversal error, in nm.

        Raises:
            openmm.OpenMMException: it is too large.
        """
        if not error <= REVERSIBLE:
            raise openmm.OpenMMException(
                f"A trajectory of {self._steps_per_trial} steps that was followed back missed its start by {error:.1e} "
                f"nm, more than {REVERSIBLE:.0e} nm, so that samples would not be exact: take shorter trajectories or "
                "steps"
            )
        self._set(**{REVERSAL: error, CHECKED_STEP: self.getStepSize()._value})

    # --- what travels in checkpoints ---

    def _potential_changed(self) -> None:
        if self.getGlobalVariableByName(LEFT) or self.getGlobalVariableByName(END):
            self.setGlobalVariableByName(STEP, math.nan)

    def _leave_other_engine(self, context: openmm.Context) -> None:
        """Abandon a trial that the other engine has begun, and put the Context back at its start."""
        super()._leave_other_engine(context)
        is_native = isinstance(self._engine, NativeTrials)
        begun = LEFT if is_native else END
        if self._engine is None or not self.getGlobalVariableByName(begun):
            return
        start = np.stack([np.array(self.getPerDofVariableByName(name)) for name in START_VARIABLES])
        x, v = start[:2]
        if is_native:
            state, now = stored_state.unpack(self.bodies, start), Snapshot(context)
            x, v = self.bodies.place(state.q, state.A, now.positions), self.bodies.move(state, now.velocities)
        context.setPositions(x)
        context.setVelocities(v)
        context.computeVirtualSites()
        self._set(**{begun: 0, HEAT: self.getGlobalVariableByName(START_HEAT)})

    def _write_record(self, state: BodyState) -> None:
        super()._write_record(state)
        found = SampledState.of(state)
        self._set(**{TRIALS: found.trials, ACCEPTED: found.accepted, ERROR: found.error})
        if (trial := found.trial) is None:
            return self._set(**{LEFT: 0})
        numbers = {ENERGY: trial.energy, THERMAL: trial.thermal, STEP: trial.h, START_HEAT: trial.start.heat}
        self._set(**{LEFT: trial.left}, **numbers)
        packed = stored_state.pack(self.bodies, trial.start)
        for name, values in zip(START_VARIABLES, packed, strict=True):
            self.setPerDofVariableByName(name, values)
        return None

    def _set(self, **values: float) -> None:
        for name, value in values.items():
            self.setGlobalVariableByName(name, value)

    def _read_record(self, state: BodyState, known: BodyState | None, disturbed: bool) -> BodyState:
        if disturbed:
            self._set(**{LEFT: 0})
        found = SampledState.of(super()._read_record(state, known, disturbed))
        before = known.trial if isinstance(known, SampledState) else None
        return found.moved_to(
            found,
            trials=self.trials,
            accepted=self.accepted,
            error=self.lastEnergyError,
            trial=self._read_trial(before) if self.getGlobalVariableByName(LEFT) else None,
        )

    def _read_trial(self, known: Trial | None) -> Trial:
        """The trial in progress; its start is read only if the trial was not known before."""
        left, energy, thermal, h, heat = map(self.getGlobalVariableByName, (LEFT, ENERGY, THERMAL, STEP, START_HEAT))
        if known is not None and (known.energy, known.thermal, known.left) == (energy, thermal, left):
            return Trial(known.start, energy, thermal, h, int(left))
        values = np.stack([np.array(self.getPerDofVariableByName(name)) for name in START_VARIABLES])
        start = stored_state.unpack(self.bodies, values)
        return Trial(replace(start, heat=heat), energy, thermal, h, int(left))


def tell_of_samples(integrator: openmm.Integrator, interval: int, what: str) -> None:
    """Warn if reports at an interval would show states that are not samples of hybrid Monte Carlo.

    Args:
        integrator: of any kind.
        interval: steps from one report to the next.
        what: name of the reporting object.
    """
    if isinstance(integrator, SIERHMCIntegrator) and interval % (steps := integrator.getStepsPerTrial()):
        tell(
            f"{what} reports every {interval} steps, and trials of hybrid Monte Carlo have {steps}: reports at other "
            f"steps than multiples of {steps} are on trajectories that may be rejected, and no samples"
        )


def _friction(value: Any) -> float:
    """Friction in 1/ps; infinite where momenta are drawn anew."""
    if value is None:
        return math.inf
    if (friction := checked_friction("frictionCoeff", value)) == 0:
        raise ValueError("frictionCoeff must be above zero, got 0: momenta would never be drawn")
    return friction


def _check_scheme(scheme: Scheme) -> None:
    if BATH in scheme.operators:
        raise ValueError(f"scheme {scheme.name} has a bath; hybrid Monte Carlo draws momenta between trials alone")
    if not scheme.is_palindrome:
        raise ValueError(f"scheme {scheme.name} is no palindrome, so that its trajectories cannot be reversed")
