"""Hybrid Monte Carlo whose trajectories OpenMM follows: the counterpart of `dynamics.metropolis`."""

from __future__ import annotations

import math
import zlib
from typing import Protocol, cast

import numpy as np
import openmm

from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.noise import generator
from openmm_sier.dynamics.thermostat import OrnsteinUhlenbeck
from openmm_sier.engines.host import Host
from openmm_sier.engines.interrupts import whatever_interrupts
from openmm_sier.engines.native.engine import NativeEngine
from openmm_sier.engines.snapshot import Snapshot
from openmm_sier.engines.stored_state import DRAWS, HEAT, SEED
from openmm_sier.engines.trial_record import (
    ACCEPTED,
    CHECKED_STEP,
    END,
    ENERGY,
    ENVIRONMENT,
    ERROR,
    PLACE,
    START_HEAT,
    START_VARIABLES,
    STEP,
    THERMAL,
    TRIALS,
)
from openmm_sier.system import tables


class SamplingHost(Host, Protocol):
    """An integrator with trials, as this engine sees it."""

    _bath: OrnsteinUhlenbeck

    def getStepsPerTrial(self) -> int: ...

    def _refuse_irreversible(self, error: float) -> None:
        """Raise an error if a reversal error, in nm, is too large; otherwise record it."""

    def _set(self, **values: float) -> None:
        """Set global variables."""


class NativeTrials(NativeEngine):
    """Binding of a `SIERHMCIntegrator` to a Context in which OpenMM executes its program.

    All that a trial needs is in variables of the integrator, which travel in checkpoints. Nothing passes from Python to
    the device within a trajectory.

    Attributes:
        is_running: whether OpenMM is executing the program. The program must refuse to run at other times, since OpenMM
            alone would accept every trial.
    """

    def __init__(self, integrator: SamplingHost, context: openmm.Context) -> None:
        self.is_running = False
        # Checksums of positions and environment, and the potential energy there.
        self._known: tuple[tuple[int, int], float] | None = None
        super().__init__(integrator, context)
        system = context.getSystem()
        self._masses = tables.masses(system)

    @property
    def _sampler(self) -> SamplingHost:
        return cast(SamplingHost, self._integrator)

    def run(self, count: int) -> None:
        """Advance by `count` steps; an interrupt leaves the Context at the last completed one."""
        self._check_step()
        self.adopt_trial()
        try:
            while count:
                if not self._global(END):
                    self._begin()
                done = min(count, self.left())
                self._follow(done)
                count -= done
                if not self.left():
                    self._decide()
        finally:
            whatever_interrupts(self._mark)

    def left(self) -> int:
        """Steps left in the trial in progress."""
        end = self._global(END)
        return int(end) - self.context.getStepCount() if end else 0

    def steps_to_sample(self) -> int:
        """Steps to the next sample, 0 if the Context is at one."""
        self.adopt_trial()
        return self.left() or -self.context.getStepCount() % self._sampler.getStepsPerTrial()

    def potential_energy(self) -> float:
        """Potential energy of the forces that move the atoms, kJ/mol; at a sample it is known from the trial."""
        return self._energies(Snapshot(self.context))[0]

    def _start_anew(self) -> None:
        self._known = None
        super()._start_anew()

    def renew_forces(self) -> None:
        self._known = None
        self._sampler._potential_changed()
        super().renew_forces()

    # --- changes from outside ---

    def adopt_trial(self) -> None:
        """End the trial in progress if atoms were moved from outside; abandon it if step or potential was changed."""
        integrator = self._sampler
        # A loaded checkpoint brings the seed of its run.
        integrator._active_scheme()
        if self._global(SEED) == 0:
            # Somebody wrote the variables of another integrator over ours; noise must not be used twice.
            integrator._set(**{SEED: integrator._bath.seed, END: 0})
        if not self._global(END):
            return
        now = Snapshot(self.context)
        if _checksum(now.positions, now.velocities) != self._global(PLACE):
            integrator._set(**{END: 0})
        elif self._global(STEP) != integrator.getStepSize()._value or self._environment() != self._global(ENVIRONMENT):
            self._go_back(1.0)
            integrator._set(**{END: 0, HEAT: self._global(START_HEAT)})
        elif not self.left():
            # An interrupt came before the decision.
            self._decide()

    def _mark(self) -> None:
        """Record what this package left in the Context, so that later changes can be detected."""
        if self._global(END):
            now = Snapshot(self.context)
            self._sampler._set(**{PLACE: _checksum(now.positions, now.velocities), ENVIRONMENT: self._environment()})

    def _environment(self) -> int:
        state = self.context.getState(parameters=True)
        found = state.getPeriodicBoxVectors()._value, sorted(dict(state.getParameters()).items())
        return zlib.crc32(repr((found, self._integrator.getIntegrationForceGroups())).encode())

    # --- trials ---

    def _begin(self) -> None:
        """Draw momenta, and record the start of the trial; an error or interrupt restores the velocities."""
        if self._is_fresh:
            self._start_anew()
        sample = Snapshot(self.context)
        try:
            self._begin_from(sample)
        except BaseException:
            whatever_interrupts(lambda: self._put(sample))
            raise

    def _begin_from(self, sample: Snapshot) -> None:
        integrator, context = self._sampler, self.context
        bath, draws, h = integrator._bath, int(self._global(DRAWS)), integrator.getStepSize()._value
        length = integrator.getStepsPerTrial() - context.getStepCount() % integrator.getStepsPerTrial()
        self._draw(bath, draws, sample.velocities, math.exp(-bath.friction * length * h) if h else 1.0)
        self._check_reversal(h)
        now = Snapshot(context)
        potential, kinetic = self._energies(now)
        if not math.isfinite(potential + kinetic):
            raise openmm.OpenMMException(
                f"In step {context.getStepCount() + 1} no trajectory can begin where the energy is "
                f"{potential + kinetic}. Do atoms overlap?"
            )
        heat = self._global(HEAT) + kinetic - self._kinetic_energy(sample.velocities)
        for name, vectors in zip(START_VARIABLES, (now.positions, now.velocities), strict=False):
            integrator.setPerDofVariableByName(name, vectors)
        integrator._set(
            **{DRAWS: draws + 1, HEAT: heat, START_HEAT: heat, ENERGY: potential + kinetic},
            **{THERMAL: GAS_CONSTANT * bath.temperature, STEP: h, END: context.getStepCount() + length},
        )

    def _draw(self, bath: OrnsteinUhlenbeck, draws: int, old: np.ndarray, kept: float) -> None:
        """Draw velocities anew, keeping a part of the old ones; constraints leave the new ones canonical."""
        context = self.context
        # OpenMM replaces a zero by a seed of its own choice.
        seed = int(generator(bath.seed, draws).integers(1, 2**31 - 1))
        context.setVelocitiesToTemperature(bath.temperature, seed)
        if kept:
            new = Snapshot(context).velocities
            context.setVelocities(kept * old + math.sqrt(1 - kept**2) * new)
        # The forces at these positions are still valid.
        self._is_fresh = False

    def _follow(self, count: int) -> None:
        """Continue the trajectory; one that has failed stays at its start."""
        context, h = self.context, self._integrator.getStepSize()._value
        goal, time = context.getStepCount() + count, context.getTime()._value
        if not math.isnan(self._global(ENERGY)):
            try:
                self._run_program(count)
            except openmm.OpenMMException as error:
                if "nan" not in str(error).lower():
                    raise
                self._fail()
            else:
                # At the end of the trial its energy shows a failure.
                if not self.left() or np.isfinite(Snapshot(context).positions).all():
                    return
                self._fail()
        for _ in range(count):
            time += h
        context.setTime(time)
        context.setStepCount(goal)

    def _fail(self) -> None:
        self._go_back(1.0)
        self._sampler._set(**{ENERGY: math.nan})

    def _run_program(self, count: int) -> None:
        self.is_running = True
        try:
            super().run(count)
        finally:
            self.is_running = False
            self._integrator._tell_program()

    def _decide(self) -> None:
        """Accept the end of the trajectory, or go back to its start with reversed velocities."""
        integrator, before = self._sampler, self._global(ENERGY)
        error = math.inf
        if not math.isnan(before):
            error = (sum(self._energies(Snapshot(self.context))) - before) / self._global(THERMAL)
        if math.isnan(error):
            error = math.inf
        draws = int(self._global(DRAWS))
        is_accepted = error <= -math.log(1 - generator(integrator._bath.seed, draws, stream=2).random())
        counts = {
            TRIALS: self._global(TRIALS) + 1,
            ACCEPTED: self._global(ACCEPTED) + is_accepted,
            ERROR: error,
            DRAWS: draws + 1,
            END: 0,
        }

        def conclude() -> None:
            if not is_accepted:
                self._go_back(-1.0)
            integrator._set(**counts)

        whatever_interrupts(conclude)

    def _check_reversal(self, h: float) -> None:
        """Follow a trajectory there and back, once for each step size; the Context is restored afterwards."""
        integrator, context = self._sampler, self.context
        if h == self._global(CHECKED_STEP):
            return
        start, steps, error = Snapshot(context), integrator.getStepsPerTrial(), math.inf
        try:
            self._run_program(steps)
            end = Snapshot(context)
            if np.isfinite(end.positions).all() and np.isfinite(end.velocities).all():
                context.setVelocities(-end.velocities)
                self._run_program(steps)
                missed = Snapshot(context).positions - start.positions
                error = float(np.linalg.norm(missed, axis=1).max(initial=0.0))
        finally:
            whatever_interrupts(lambda: self._put(start))
        integrator._refuse_irreversible(error)

    # --- the Context ---

    def _put(self, snapshot: Snapshot) -> None:
        context = self.context
        context.setPositions(snapshot.positions)
        context.setVelocities(snapshot.velocities)
        context.setTime(snapshot.time)
        context.setStepCount(snapshot.steps)

    def _go_back(self, direction: float) -> None:
        """Go back to the start of the trial, with its velocities times `direction`."""
        x, v = (np.array(self._integrator.getPerDofVariableByName(name)) for name in START_VARIABLES[:2])
        self.context.setPositions(x)
        self.context.setVelocities(direction * v)

    def _energies(self, now: Snapshot) -> tuple[float, float]:
        """Potential energy of the forces that move the atoms, and kinetic energy, kJ/mol."""
        key = _checksum(now.positions), self._environment()
        if self._known is None or self._known[0] != key:
            state = self.context.getState(energy=True, groups=self._integrator.getIntegrationForceGroups())
            self._known = key, state.getPotentialEnergy()._value
        return self._known[1], self._kinetic_energy(now.velocities)

    def _kinetic_energy(self, velocities: np.ndarray) -> float:
        return 0.5 * float(self._masses @ (velocities**2).sum(axis=1))

    def _global(self, name: str) -> float:
        return self._integrator.getGlobalVariableByName(name)


def _checksum(*arrays: np.ndarray) -> int:
    """A whole number that a float64 holds."""
    total = 0
    for array in arrays:
        total = zlib.crc32(np.ascontiguousarray(array).tobytes(), total)
    return total
