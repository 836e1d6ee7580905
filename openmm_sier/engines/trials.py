"""Trials of hybrid Monte Carlo: what is chosen, the list of operations, and how the steps of an engine execute it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import openmm

from openmm_sier.dynamics.plan import Operation
from openmm_sier.engines.records import Clock, TrajectoryError
from openmm_sier.engines.variables import PREFIX

if TYPE_CHECKING:
    from openmm_sier.engines.protocol import Engine

#: Global variables in which an ensemble counts trials, with the error of the first end of the last one in kT.
TRIALS, ACCEPTED, ERROR = (PREFIX + name for name in ("trials", "accepted", "error"))


class Trial(NamedTuple):
    """Choices of one trial.

    Attributes:
        steps: number of steps of the scheme to each end of the trajectory.
        chances: how many times the trajectory may go on where its end is rejected.
        kept: fraction of the old momenta that is kept where they are refreshed in part.
        kT: thermal energy, kJ/mol.
        kinetic_energy: at the start, after momenta were drawn, kJ/mol. It is 0 where nothing moves.
        threshold: the largest energy error in kT at which an end is accepted.
        centre: velocity that is given to the centre of mass before momenta are drawn, (3,), nm/ps.
    """

    steps: int
    chances: int
    kept: float
    kT: float
    kinetic_energy: float
    threshold: float
    centre: np.ndarray


class Outcome(NamedTuple):
    """Result of one trial.

    Attributes:
        energy: potential energy of the start, kJ/mol.
        error: total energy at the first end less that at the start, in kT; infinite where it could not be reached.
        is_accepted: whether an end was accepted.
    """

    energy: float
    error: float
    is_accepted: bool


class Draw(Operation):
    """Momenta are drawn, in part or all of them, and scaled to the kinetic energy of the start."""


class Keep(Operation):
    """The start is kept, with its total energy."""


class Follow(Operation):
    """The trajectory is followed to its next end, whose energy comes with its last forces."""


class Decide(Operation):
    """The end is accepted or not. The trajectory goes on if it is not, and chances are left."""


@dataclass(frozen=True)
class WhileItGoesOn(Operation):
    """Operations that are repeated while the trajectory goes on, at least once."""

    operations: tuple[Operation, ...]


class GoBack(Operation):
    """The start comes back with reversed momenta, unless an end was accepted."""


class StopCentre(Operation):
    """The centre of mass is stopped, where a CMMotionRemover does so."""


#: A trial.
TRIAL = (Draw(), Keep(), WhileItGoesOn((Follow(), Decide())), GoBack(), StopCentre())


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
