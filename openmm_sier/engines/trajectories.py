"""Trials of hybrid Monte Carlo by the steps of an engine, and the test that a trajectory can be reversed."""

import math

import numpy as np
import openmm

from openmm_sier.engines.protocol import Clock, Engine, TrajectoryError
from openmm_sier.engines.trials import Outcome, Trial


def make_trial(engine: Engine, trial: Trial) -> Outcome:
    """Make a trial step by step; see `Engine.make_trial`."""
    with engine.transaction():
        if trial.kinetic:
            draw_start(engine, trial)
        engine.tally.draws += 1
        start = engine.save()
        potential = engine.potential_energy()
        refuse_energy(potential, engine.clock)
        energy = potential + engine.kinetic_energy()
        errors, is_accepted = [], False
        for _ in range(1 + trial.chances):
            errors.append(_error_of_end(engine, trial, energy))
            is_accepted = math.isfinite(errors[-1]) and errors[-1] <= trial.threshold
            # From where forces are not finite no trajectory goes on, from the other side neither.
            if is_accepted or not math.isfinite(errors[-1]):
                break
        if not is_accepted:
            engine.restore(start, reverse=True)
        if engine.removes_momentum:
            engine.shift_velocities(-engine.centre_velocity())
        return Outcome(potential, errors[0], is_accepted)


def draw_start(engine: Engine, trial: Trial) -> None:
    """Draw momenta with the kinetic energy of a trial."""
    if trial.centre.any():
        engine.shift_velocities(trial.centre)
    engine.draw_momenta(trial.thermal, trial.share)
    engine.scale_velocities(math.sqrt(trial.kinetic / engine.kinetic_energy()), np.zeros(3))


def _error_of_end(engine: Engine, trial: Trial, energy: float) -> float:
    """Follow a trajectory to its next end; return the energy there less that of the start, in kT.

    It is infinite where the trajectory cannot be followed.
    """
    try:
        engine.propagate(trial.steps, wants_energy=True)
        error = (engine.potential_energy() + engine.kinetic_energy() - energy) / trial.thermal
    except TrajectoryError:
        return math.inf
    return error if math.isfinite(error) else math.inf


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
