"""Trials of hybrid Monte Carlo by the steps of an engine, and the test that a trajectory can be reversed."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import openmm

from openmm_sier.dynamics.plan import Operation
from openmm_sier.engines.protocol import Engine
from openmm_sier.engines.records import Clock, TrajectoryError
from openmm_sier.engines.trials import (
    TRIAL,
    Decide,
    Draw,
    Follow,
    GoBack,
    Keep,
    Outcome,
    StopCentre,
    Trial,
    WhileItGoesOn,
)


def make_trial(engine: Engine, trial: Trial) -> Outcome:
    """Make a trial step by step; see `Engine.make_trial`."""
    with engine.transaction():
        trajectory = Trajectory(engine, trial)
        trajectory.execute(TRIAL)
        return Outcome(trajectory.potential, trajectory.errors[0], trajectory.is_accepted)


class Trajectory:
    """The trajectory of a trial, made by the steps of an engine.

    Attributes:
        potential: potential energy of the start, kJ/mol.
        errors: total energy at each end less that of the start, in kT; infinite where an end could not be reached.
        is_accepted: whether the last end was accepted.
    """

    def __init__(self, engine: Engine, trial: Trial) -> None:
        self._engine = engine
        self._trial = trial
        self.potential = math.nan
        self.errors: list[float] = []
        self.is_accepted = False
        self._goes_on = True

    def execute(self, operations: Sequence[Operation]) -> None:
        """Execute operations of a trial."""
        for operation in operations:
            BY_STEPS[type(operation)](self, operation)

    def _draw(self, operation: Draw) -> None:
        if self._trial.kinetic_energy:
            draw_start(self._engine, self._trial)
        self._engine.tally.draws += 1

    def _keep(self, operation: Keep) -> None:
        engine = self._engine
        self._start = engine.save()
        self.potential = engine.potential_energy()
        refuse_energy(self.potential, engine.clock)
        self._energy = self.potential + engine.kinetic_energy()

    def _while_it_goes_on(self, operation: WhileItGoesOn) -> None:
        while self._goes_on:
            self.execute(operation.operations)

    def _follow(self, operation: Follow) -> None:
        engine, trial = self._engine, self._trial
        try:
            engine.propagate(trial.steps, wants_energy=True)
            error = (engine.potential_energy() + engine.kinetic_energy() - self._energy) / trial.kT
        except TrajectoryError:
            error = math.inf
        self.errors.append(error if math.isfinite(error) else math.inf)

    def _decide(self, operation: Decide) -> None:
        # A trajectory cannot continue past forces that are not finite, in either direction.
        is_finite = math.isfinite(self.errors[-1])
        self.is_accepted = is_finite and self.errors[-1] <= self._trial.threshold
        self._goes_on = is_finite and not self.is_accepted and len(self.errors) <= self._trial.chances

    def _go_back(self, operation: GoBack) -> None:
        if not self.is_accepted:
            self._engine.restore(self._start, reverse=True)

    def _stop_centre(self, operation: StopCentre) -> None:
        self._engine.stop_centre()


#: Functions that execute an operation of a trial, by its class.
BY_STEPS: dict[type[Operation], Callable[[Trajectory, Any], None]] = {
    Draw: Trajectory._draw,
    Keep: Trajectory._keep,
    WhileItGoesOn: Trajectory._while_it_goes_on,
    Follow: Trajectory._follow,
    Decide: Trajectory._decide,
    GoBack: Trajectory._go_back,
    StopCentre: Trajectory._stop_centre,
}


def draw_start(engine: Engine, trial: Trial) -> None:
    """Draw momenta with the kinetic energy of a trial."""
    if trial.centre.any():
        engine.shift_velocities(trial.centre)
    engine.draw_momenta(trial.kT, trial.kept)
    engine.scale_velocities(math.sqrt(trial.kinetic_energy / engine.kinetic_energy()), np.zeros(3))


def refuse_energy(energy: float, clock: Clock) -> None:
    """Refuse the potential energy of the start of a trial, kJ/mol, if it is not finite.

    Raises:
        openmm.OpenMMException: it is not.
    """
    if not math.isfinite(energy):
        raise openmm.OpenMMException(
            f"The energy at the beginning of step {clock.steps + 1} is {energy}, so that no trajectory can begin. Do "
            "atoms overlap? Then minimize the energy first"
        )


def reversal_error(engine: Engine, steps: int) -> float:
    """Follow a trajectory there and back, and return the distance by which it misses its start; undo it.

    Returns:
        The largest distance of an atom from its place at the start, nm; infinite if it could not be followed.
    """
    start, before = engine.save(), engine.positions()
    try:
        for _ in range(2):
            engine.propagate(steps)
            if not np.isfinite(engine.positions()).all():
                return math.inf
            engine.restore(engine.save(), reverse=True)
        return float(np.linalg.norm(engine.positions() - before, axis=1).max(initial=0.0))
    except TrajectoryError:
        return math.inf
    finally:
        engine.restore(start)
