"""The kernels engine where it makes whole trials of hybrid Monte Carlo, of which only numbers cross to the host."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from openmm_sier.dynamics.plan import Operation
from openmm_sier.engines.compiled.engine import KernelsEngine, Motion
from openmm_sier.engines.compiled.kernel_text import END_SUMS, START_SUMS, VALUES
from openmm_sier.engines.compiled.trial_blocks import (
    BETWEEN,
    CHANGED,
    DRAWN,
    ENDED,
    ENERGY,
    GONE_BACK,
    GONE_ON,
    STARTED,
)
from openmm_sier.engines.native.trial_engine import TrialEngine
from openmm_sier.engines.native.trial_variables import INFINITE, Numbers
from openmm_sier.engines.records import RollbackState
from openmm_sier.engines.trials import (
    TRIAL,
    Decide,
    Draw,
    Follow,
    GoBack,
    Keep,
    StopCentre,
    Trial,
    WhileItGoesOn,
)


class KernelTrialEngine(KernelsEngine, TrialEngine):
    """An engine whose trials are blocks of commands: the host decides, and no atom is read or written.

    The start comes back with its forces.
    """

    makes_trials = True
    keeps_force = True

    #: Potential energy of the sample; None where it is not known.
    _sample_energy: float | None = None
    #: Whether the start of the present trial was kept, to which an error goes back.
    has_start = False

    def synchronize(self) -> None:
        self._sample_energy = None
        super().synchronize()

    def restore(self, saved: RollbackState, reverse: bool = False) -> None:
        self._sample_energy = None
        super().restore(saved, reverse)

    def _check_start(self) -> None:
        self._sample_energy = None
        super()._check_start()

    def _make(self, trial: Trial, has_force: bool) -> Numbers:
        known, self._sample_energy = self._sample_energy, None
        self.has_start = False
        trajectory = DeviceTrajectory(self, trial, has_force, known)
        trajectory.execute(TRIAL)
        self._sample_energy = trajectory.potential
        return trajectory.numbers()

    def _restore_start(self, reverse: bool) -> None:
        if not self.has_start:
            # Nothing has moved.
            return
        self.run(GONE_BACK, are_forces_known=False)
        if not reverse:
            self.change_velocities(-1.0, np.zeros(3))
        self._velocities_changed()

    @property
    def has_last_energy(self) -> bool:
        """Return whether the end of a trajectory comes with its energy."""
        return self._step.has_last_energy

    # --- blocks ---

    def change_velocities(self, factor: float, shift: np.ndarray) -> None:
        """Multiply velocities by a factor, and add a velocity, (3,), nm/ps."""
        self._write(factor, 0.0, shift, 0.0)
        self.run(CHANGED)

    def begin_trial(self, trial: Trial) -> None:
        """Write the numbers of a trial, and set its sums to zero."""
        kept = trial.kept if trial.kinetic_energy else 1.0
        self._write(kept, math.sqrt((1 - kept**2) * trial.kT), trial.centre, trial.kinetic_energy)
        self._library.clear_totals(self._address, START_SUMS)
        self._library.clear_totals(self._address, END_SUMS)

    def _write(self, factor: float, width: float, shift: np.ndarray, kinetic_energy: float) -> None:
        """Write the values of kernels, see `trials.cc`."""
        self._library.write_numbers(self._address, VALUES, [factor, width, factor, width, *shift, kinetic_energy])

    def go_on(self) -> None:
        """Begin another part of a trajectory where it is."""
        self._library.clear_totals(self._address, END_SUMS)
        self.run(GONE_ON)

    def end(self) -> Motion:
        """Return the motion at the end of the trajectory."""
        return self._motion(END_SUMS)

    def drawn(self) -> Motion:
        """Return the motion that was drawn for a trial, before it was scaled to the kinetic energy of the start."""
        return self._motion(START_SUMS)


class DeviceTrajectory:
    """The trajectory of a trial, made by blocks of commands; see `trials.Trajectory`.

    Attributes:
        potential: potential energy of the sample that the trial leaves, kJ/mol.
    """

    def __init__(self, engine: KernelTrialEngine, trial: Trial, has_force: bool, potential: float | None) -> None:
        """
        Args:
            engine: which makes it.
            trial: the trial.
            has_force: whether the forces of the start are at hand.
            potential: energy of the start, kJ/mol; None if it is not known.
        """
        self._engine = engine
        self._trial = trial
        self._has_force = has_force
        self.potential = potential
        self._start_potential = self._start_kinetic = math.nan
        self._end = Motion(0.0, np.zeros(3))
        self._end_potential = math.nan
        self._errors: list[float] = []
        self._is_accepted = False
        self._goes_on = True
        self._stopped = 0.0

    def execute(self, operations: Sequence[Operation]) -> None:
        """Execute operations of a trial."""
        for operation in operations:
            BY_BLOCKS[type(operation)](self, operation)

    def numbers(self) -> Numbers:
        """Return what the trial leaves."""
        kinetic = (self._end.kinetic if self._is_accepted else self._start_kinetic) - self._stopped
        first_error = self._errors[0]
        return Numbers(self._start_potential, first_error, self._is_accepted, len(self._errors), kinetic, self._stopped)

    def _draw(self, operation: Draw) -> None:
        """Draw momenta; without an energy that they are to have, sum the one that there is."""
        engine, trial = self._engine, self._trial
        engine.begin_trial(trial)
        engine.run(DRAWN, are_forces_known=self._has_force)
        self._start_kinetic = trial.kinetic_energy or engine.drawn().kinetic

    def _keep(self, operation: Keep) -> None:
        """See that the energy of the start is known; the first launch of the trajectory keeps it."""
        engine = self._engine
        if self.potential is None:
            self.potential = engine.run(ENERGY, are_forces_known=False)
        self._start_potential = self.potential

    def _while_it_goes_on(self, operation: WhileItGoesOn) -> None:
        while self._goes_on:
            self.execute(operation.operations)

    def _follow(self, operation: Follow) -> None:
        engine, trial = self._engine, self._trial
        if self._errors:
            engine.go_on()
        else:
            engine.has_start = True
            engine.run(STARTED)
        engine.run(BETWEEN, trial.steps - 1)
        self._end_potential = engine.run(ENDED)
        if not engine.has_last_energy:
            self._end_potential = engine.run(ENERGY)
        self._end = engine.end()
        gained = self._end_potential + self._end.kinetic - self._start_potential - self._start_kinetic
        self._errors.append(gained / trial.kT)

    def _decide(self, operation: Decide) -> None:
        error, trial = self._errors[-1], self._trial
        # A comparison with NaN is false.
        is_finite = abs(error) < INFINITE
        self._is_accepted = is_finite and error <= trial.threshold
        self._goes_on = is_finite and not self._is_accepted and len(self._errors) <= trial.chances

    def _go_back(self, operation: GoBack) -> None:
        if self._is_accepted:
            self.potential = self._end_potential
        else:
            self._engine.run(GONE_BACK)

    def _stop_centre(self, operation: StopCentre) -> None:
        engine = self._engine
        if not (engine.removes_momentum and self._trial.kinetic_energy):
            return
        momentum = self._end.momentum if self._is_accepted else self._momentum_back()
        mass = engine.moving.moving_mass
        velocity = momentum / mass
        engine.change_velocities(1.0, -velocity)
        self._stopped = 0.5 * float(mass @ velocity**2)

    def _momentum_back(self) -> np.ndarray:
        """Return the momentum of the start that came back with reversed velocities."""
        drawn = self._engine.drawn()
        return -math.sqrt(self._start_kinetic / drawn.kinetic) * drawn.momentum


#: Functions that execute an operation of a trial, by its class.
BY_BLOCKS: dict[type[Operation], Callable[[DeviceTrajectory, Any], None]] = {
    Draw: DeviceTrajectory._draw,
    Keep: DeviceTrajectory._keep,
    WhileItGoesOn: DeviceTrajectory._while_it_goes_on,
    Follow: DeviceTrajectory._follow,
    Decide: DeviceTrajectory._decide,
    GoBack: DeviceTrajectory._go_back,
    StopCentre: DeviceTrajectory._stop_centre,
}
