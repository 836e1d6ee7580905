"""Tuning of hybrid Monte Carlo: the step at which trials of a given length have a given acceptance."""

import math
from typing import NamedTuple

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.acceptance import acceptance_at, best_acceptance, spread_at
from openmm_sier.integrators.hmc import SIERHMCIntegrator
from openmm_sier.stability.step_check import StepCheck
from openmm_sier.system.arguments import group_mask, whole_number

#: Least number of trials at each step.
FEWEST = 10

#: Number of attempts, bounds of the change of the step in each, and the change below which the search ends. The spread
#: of 40 energy errors is known to 11 %, and so the step to 3 % for a fourth-order scheme and 6 % for a second-order
#: one.
ATTEMPTS, SHORTER, LONGER, SETTLED = 10, 0.6, 1.5, 0.06


class StepFound(NamedTuple):
    """Results of trials at one step.

    Attributes:
        step: ps.
        spread: standard deviation of the energy error, kT; infinite if most trajectories failed, or were refused.
        acceptance: mean of min(1, exp(-error)).
    """

    step: float
    spread: float
    acceptance: float

    def __str__(self) -> str:
        return f"{1e3 * self.step:10.4g}{self.spread:10.3g}{self.acceptance:12.3f}"


class Tuning(NamedTuple):
    """Results of `tune`; print them as a table.

    Attributes:
        schemeStepSize: step of the scheme, ps.
        stepsPerTrial: number of steps in a trial.
        acceptance: expected at this step, from the spread of energy errors at the nearest step that was tried.
        tried: the steps that were tried, in order, each with `step` in ps, `spread` in kT and `acceptance`.
    """

    schemeStepSize: float
    stepsPerTrial: int
    acceptance: float
    tried: tuple[StepFound, ...]

    def __str__(self) -> str:
        found = StepFound(self.schemeStepSize, spread_at(self.acceptance), self.acceptance)
        return "\n".join(
            [
                f"Steps of {1e3 * self.schemeStepSize:.4g} fs, {self.stepsPerTrial} in a trial:",
                "   step/fs     sd/kT  acceptance",
                *map(str, self.tried),
                f"{found}  expected",
            ]
        )


def tune(context: openmm.Context, acceptance: float | None = None, trials: int = 40) -> Tuning:
    """Find the step of hybrid Monte Carlo for a Context, and set it in the integrator.

    Trials keep their length in time. Equilibrate roughly before. Trials of the tuning are no samples, so leave them out
    of averages. Afterwards `trials` and `accepted` count from zero.

    >>> integrator = SIERHMCIntegrator(300*kelvin, 6*femtoseconds, stepsPerTrial=4)
    >>> simulation = Simulation(topology, system, integrator)
    >>> simulation.context.setPositions(positions)
    >>> tuning = tune(simulation.context, acceptance=0.8, trials=10)
    >>> length = tuning.stepsPerTrial

    The step changes until the energy errors of trials have the standard deviation of the wanted acceptance. Steps that
    resonate with fast forces are not tried. The same seed gives the same result if the platform's forces are
    deterministic.

    An interrupt or error restores the step and length that the integrator had.

    Args:
        context: the Context of a `SIERHMCIntegrator`, with positions. The search begins at the integrator's step.
        acceptance: the wanted fraction, between 0 and 1. None takes that at which step times acceptance is nearly
            largest: 0.77 for a scheme of second order and 0.90 for one of fourth order.
        trials: number of trials at each step, at least 10.

    Raises:
        TypeError: the Context has another integrator.
        ValueError: an argument is out of its range.
        openmm.OpenMMException: no step could be tried; the message gives the last reason.
    """
    integrator = context.getIntegrator()
    if not isinstance(integrator, SIERHMCIntegrator):
        raise TypeError(f"tune needs a Context with a SIERHMCIntegrator, got a {type(integrator).__name__}")
    if acceptance is not None and not 0 < acceptance < 1:
        raise ValueError(f"acceptance must be between 0 and 1, got {acceptance:g}")
    trials = whole_number("trials", trials, FEWEST)
    step = integrator.getSchemeStepSize().value_in_unit(unit.picosecond)
    steps = integrator.getStepsPerTrial()
    if not step:
        raise ValueError("the integrator's step must be above zero, got 0")
    wanted = best_acceptance(integrator.scheme.order) if acceptance is None else acceptance
    try:
        tuning = _find_step(context, step, step * steps, wanted, trials)
        set_trials(integrator, tuning.schemeStepSize, tuning.stepsPerTrial)
    except BaseException:
        integrator.setSchemeStepSize(step)
        integrator.setStepsPerTrial(steps)
        raise
    integrator.resetStatistics()
    return tuning


def set_trials(integrator: SIERHMCIntegrator, step: float, steps: int) -> None:
    """Set step and length, and make a trial, which also checks that trajectories reverse."""
    integrator.setSchemeStepSize(step)
    integrator.setStepsPerTrial(steps)
    integrator.step(1)


def make_trial(integrator: SIERHMCIntegrator) -> float:
    """Make a trial and return the energy error of its first end, kT."""
    integrator.step(1)
    return integrator.lastEnergyError


def _find_step(context: openmm.Context, first: float, time: float, wanted: float, trials: int) -> Tuning:
    """Return the step with the wanted acceptance in trials of a length in ps, or the longest that is allowed."""
    integrator = context.getIntegrator()
    order, most = integrator.scheme.order, _longest_step(context)
    tried: list[StepFound] = []
    longest, refusal, step = math.inf, None, min(first, most)
    for _ in range(ATTEMPTS):
        try:
            attempt = _try_step(integrator, step, _steps(time, step), trials)
        except openmm.OpenMMException as error:
            # For example, the step is too long for a bond.
            attempt, refusal, longest = StepFound(step, math.inf, 0.0), error, step
        tried.append(attempt)
        # Of errors that are all zero, a longer step is tried.
        factor = (spread_at(wanted) / attempt.spread) ** (1 / order) if attempt.spread else LONGER
        following = min(step * min(LONGER, max(SHORTER, factor)), 0.9 * longest, most)
        if abs(following / step - 1) < SETTLED:
            found = following if refusal is None else step
            break
        step = following
    else:
        found = None
    usable = [each for each in tried if math.isfinite(each.spread)]
    if not usable:
        message = (
            f"The energy error is not finite at any step that was tried, down to {step:.3g} ps. Do atoms overlap? Then "
            "minimize the energy first"
        )
        raise refusal or openmm.OpenMMException(message)
    if found is None:
        found = min(usable, key=lambda each: abs(each.acceptance - wanted)).step
    nearest = min(usable, key=lambda each: abs(each.step - found))
    expected = acceptance_at(nearest.spread * (found / nearest.step) ** order)
    return Tuning(found, _steps(time, found), expected, tuple(tried))


def _steps(time: float, step: float) -> int:
    """Return the number of steps in a trial of about a length in time."""
    return max(1, round(time / step))


def _try_step(integrator: SIERHMCIntegrator, step: float, steps: int, trials: int) -> StepFound:
    """Return the spread of energy errors, and the acceptance, of trials at a step."""
    set_trials(integrator, step, steps)
    errors = [make_trial(integrator) for _ in range(trials)]
    followed = [error for error in errors if math.isfinite(error)]
    spread = float(np.std(followed, ddof=1)) if len(followed) > trials / 2 else math.inf
    return StepFound(step, spread, float(np.exp(-np.maximum(errors, 0)).mean()))


def _longest_step(context: openmm.Context) -> float:
    """Return the longest step whose kicks do not resonate with fast forces, ps; infinite without them."""
    integrator = context.getIntegrator()
    fast = group_mask("fastForceGroups", integrator.fastForceGroups)
    return StepCheck(context.getSystem(), integrator.bodies).longest_step(integrator.scheme, 0, fast, context=context)
