"""The native engine where its program makes whole trials of hybrid Monte Carlo."""

import math
from collections.abc import Collection
from contextlib import nullcontext
from typing import Any

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.dynamics.integration_method import IntegrationMethod
from openmm_sier.dynamics.tally import Tally
from openmm_sier.engines.native import trial_variables
from openmm_sier.engines.native.engine import NativeEngine
from openmm_sier.engines.native.trial_variables import Numbers
from openmm_sier.engines.program import Program
from openmm_sier.engines.records import Clock, TrajectoryError, says_nan
from openmm_sier.engines.snapshot import is_on_host
from openmm_sier.engines.trials import Outcome, Trial, refuse_energy


class TrialEngine(NativeEngine):
    """An engine whose trials are native steps, so that no atom is read or written between two of them.

    The kinetic energy of the end of a trial is known until velocities are changed. Atoms are read before a trial only
    if somebody has changed the Context: then the energy of the start may not be finite, and the trial is undone.
    """

    makes_trials = True

    #: Whether the start of a rejected trial comes back with its forces.
    keeps_force = False

    def __init__(
        self, context: openmm.Context, method: IntegrationMethod, tally: Tally, bodies: BodySet | None, program: Program
    ) -> None:
        """
        Raises:
            openmm.OpenMMException: see `NativeEngine`; or OpenMM took another platform than the one for which the
                program was written, on which virtual sites stay behind.
        """
        self._kinetic: float | None = None
        #: Whether the energy where the Context is was found finite.
        self._is_sample = False
        super().__init__(context, method, tally, bodies, program)
        platform = context.getPlatform()
        if self._has_sites and is_on_host(platform):
            raise openmm.OpenMMException(
                f"OpenMM took the {platform.getName()} platform, and trials were written for another one. Virtual "
                "sites do not follow their atoms within a trial there: name the platform when the Context is made"
            )

    def synchronize(self) -> None:
        super().synchronize()
        self._is_sample = False

    def make_trial(self, trial: Trial) -> Outcome:
        if not trial.kinetic_energy:
            # Nothing moves.
            return super().make_trial(trial)
        with nullcontext() if self._is_sample else self.transaction():
            outcome = self._outcome(trial)
            refuse_energy(outcome.energy, self.clock)
        self._is_sample = True
        return outcome

    def _outcome(self, trial: Trial) -> Outcome:
        """Make a trial, and return its outcome, whose energy may not be finite."""
        before, clock = self.kinetic_energy(), self.clock
        self.tally.draws += 2
        try:
            numbers = self._executed(trial)
        except openmm.OpenMMException as error:
            self.tally.heat += trial.kinetic_energy - before
            if not isinstance(error, TrajectoryError):
                raise
            self.stop_centre()
            return Outcome(self.potential_energy(), math.inf, False)
        self._kinetic = numbers.kinetic
        self.tally.heat += trial.kinetic_energy - before - numbers.stopped
        if not math.isfinite(numbers.start):
            self.clock = clock
        # A comparison with NaN is false.
        first_error = numbers.first_error if abs(numbers.first_error) <= trial_variables.INFINITE else math.inf
        return Outcome(numbers.start, first_error, numbers.is_accepted)

    def propagate(self, steps: int, signals: Collection[Any] = (), wants_energy: bool = False) -> int:
        if not steps or self.method.step == 0:
            return super().propagate(steps, signals, wants_energy)
        start = self.clock
        numbers = self._executed(trial_variables.followed(steps))
        if not numbers.is_accepted:
            raise TrajectoryError(
                "The energy at the end of a trajectory is not finite, or constraints are broken there"
            )
        self.clock = Clock(start.time + steps * self.method.step, start.steps + steps)
        return steps

    def _executed(self, trial: Trial) -> Numbers:
        """Let OpenMM make a trial; an error leaves its start, with reversed momenta if it is a TrajectoryError."""
        scheme, has_force = self.method.scheme, self._has_force
        self.evaluations += int(scheme.reuses_force and not has_force)
        self._potential = None
        self._atoms.forget()
        self._velocities_changed()
        try:
            numbers = self._make(trial, has_force)
        except BaseException as error:
            has_nan = says_nan(error)
            self._restore_start(reverse=has_nan)
            if has_nan:
                raise TrajectoryError(str(error)) from error
            raise
        self._has_force = numbers.is_accepted or self.keeps_force
        self.evaluations += numbers.ends * trial.steps * scheme.force_evaluations
        if self._has_sites and not numbers.is_accepted:
            self._context.computeVirtualSites()
        return numbers

    def _make(self, trial: Trial, has_force: bool) -> Numbers:
        """Let the device make a trial.

        Args:
            trial: the trial.
            has_force: whether the device still has the forces of the last step.
        """
        return trial_variables.execute(self._integrator, trial)

    def _restore_start(self, reverse: bool) -> None:
        positions, velocities = trial_variables.start_of(self._context)
        is_massive = self._atoms.masses[:, None] > 0
        self._atoms.write_positions(np.where(is_massive, positions, self._atoms.positions))
        self._write_velocities(-velocities if reverse else velocities)
        self._context.computeVirtualSites()

    def kinetic_energy(self) -> float:
        return super().kinetic_energy() if self._kinetic is None else self._kinetic

    def _velocities_changed(self) -> None:
        super()._velocities_changed()
        self._kinetic = None

    def _set_bath(self) -> None:
        """Leave the variables of the program as they are: each trial has its own."""
