"""The kernels engine where it makes whole trials of hybrid Monte Carlo, of which only numbers cross to the host."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from openmm_sier.dynamics.plan import Operation
from openmm_sier.engines.compiled.engine import KernelsEngine
from openmm_sier.engines.compiled.kernel_text import (
    CHANGE,
    DRAW,
    GO_BACK,
    KEEP,
    N_SUMS,
    SUM_MOTION,
    SUMS,
    TRIAL_KERNELS,
    VALUES,
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

#: Blocks of a program: a step, the last step of a trajectory, and the energy; kernels of trials follow.
STEP, LAST_STEP, ENERGY, *_ = range(3)
BLOCKS = {name: number for number, name in enumerate(TRIAL_KERNELS, 3)}


class Motion(NamedTuple):
    """Kinetic energy, kJ/mol, and momentum, (3,), of all atoms."""

    kinetic: float
    momentum: np.ndarray


class KernelTrialEngine(KernelsEngine, TrialEngine):
    """An engine whose trials are blocks of commands: the host decides, and no atom is read or written."""

    makes_trials = True

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
        self.run(BLOCKS[GO_BACK], are_forces_known=False)
        if not reverse:
            self.write(-1.0)
            self.run(BLOCKS[CHANGE])
        self._velocities_changed()

    @property
    def has_last_energy(self) -> bool:
        """Return whether the last step gives the energy of its end."""
        return self._step.has_last_energy

    # --- blocks ---

    def run(self, block: int, times: int = 1, are_forces_known: bool = True) -> float:
        """Execute a block of commands, and return the energy that it asks for, see `Library.run`."""
        return float(self._library.run(self._address, block, times, are_forces_known))

    def write(self, factor: float, width: float = 0.0, shift: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0)) -> None:
        """Set the values of the kernels that change velocities."""
        self._library.write_numbers(self._address, VALUES, [factor, width, *shift])

    def motion(self) -> Motion:
        """Return kinetic energy and momentum."""
        self.run(BLOCKS[SUM_MOTION])
        sums = self._library.read_numbers(self._address, SUMS, N_SUMS)
        return Motion(float(sums[0]), sums[1:])


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
        self._start_potential = math.nan
        self._start = Motion(0.0, np.zeros(3))
        self._end = self._start
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
        motion = self._end if self._is_accepted else self._start
        kinetic = motion.kinetic - self._stopped
        first_error = self._errors[0]
        return Numbers(self._start_potential, first_error, self._is_accepted, len(self._errors), kinetic, self._stopped)

    def _draw(self, operation: Draw) -> None:
        engine, trial = self._engine, self._trial
        if trial.kinetic_energy:
            engine.write(trial.kept, math.sqrt((1 - trial.kept**2) * trial.kT), trial.centre)
            engine.run(BLOCKS[DRAW], are_forces_known=self._has_force)
            drawn = engine.motion()
            factor = math.sqrt(trial.kinetic_energy / drawn.kinetic)
            engine.write(factor)
            engine.run(BLOCKS[CHANGE])
            self._start = Motion(trial.kinetic_energy, factor * drawn.momentum)
        else:
            self._start = engine.motion()

    def _keep(self, operation: Keep) -> None:
        engine = self._engine
        if self.potential is None:
            self.potential = engine.run(ENERGY, are_forces_known=False)
        self._start_potential = self.potential
        engine.run(BLOCKS[KEEP], are_forces_known=self._has_force)
        engine.has_start = True

    def _while_it_goes_on(self, operation: WhileItGoesOn) -> None:
        while self._goes_on:
            self.execute(operation.operations)

    def _follow(self, operation: Follow) -> None:
        engine, trial = self._engine, self._trial
        engine.run(STEP, trial.steps - 1)
        self._end_potential = engine.run(LAST_STEP)
        if not engine.has_last_energy:
            self._end_potential = engine.run(ENERGY)
        self._end = engine.motion()
        gained = self._end_potential + self._end.kinetic - self._start_potential - self._start.kinetic
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
            self._engine.run(BLOCKS[GO_BACK])

    def _stop_centre(self, operation: StopCentre) -> None:
        engine = self._engine
        if not (engine.removes_momentum and self._trial.kinetic_energy):
            return
        momentum = self._end.momentum if self._is_accepted else -self._start.momentum
        mass = engine.moving.moving_mass
        velocity = momentum / mass
        engine.write(1.0, 0.0, -velocity)
        engine.run(BLOCKS[CHANGE])
        self._stopped = 0.5 * float(mass @ velocity**2)


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
