"""Tuning of step and trajectory length in hybrid Monte Carlo by the cost of an independent sample."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.acceptance import spread_at
from openmm_sier.dynamics.correlation import inefficiency_and_error
from openmm_sier.integrators.hmc import SIERHMCIntegrator
from openmm_sier.stability.vibrations import Vibrations
from openmm_sier.system.arguments import group_mask, whole_number

#: Trajectory lengths to compare, as multiples of the one that the integrator had.
LENGTHS = (0.5, 1.0, 2.0, 4.0)

#: Number of attempts to find the step, bounds of its change in each, and the change below which the search ends. The
#: spread of 40 energy errors is known to 11 %, and so the step to 3 % for a fourth-order scheme and 6 % for a
#: second-order one.
ATTEMPTS, SHORTER, LONGER, SETTLED = 10, 0.6, 1.5, 0.06

#: Least number of trials for a spread or an autocorrelation.
FEWEST = 10


class StepFound(NamedTuple):
    """Results of trials at one step size.

    Attributes:
        step: ps.
        spread: standard deviation of the energy error, kT; infinite if most trajectories failed, or were refused.
        acceptance: mean of min(1, exp(-error)).
    """

    step: float
    spread: float
    acceptance: float


class LengthFound(NamedTuple):
    """Results of trials of one length.

    Attributes:
        steps: number of steps in a trial.
        acceptance: mean of min(1, exp(-error)).
        forces: number of force evaluations in a trial.
        inefficiency: number of trials per independent sample of the potential energy, with its standard error.
        refused: the reason, if there were no trials.
    """

    steps: int
    acceptance: float = math.nan
    forces: float = math.nan
    inefficiency: tuple[float, float] = (math.inf, math.nan)
    refused: str = ""

    @property
    def cost(self) -> tuple[float, float]:
        """Return force evaluations per independent sample of the potential energy, with the standard error."""
        value, error = self.inefficiency
        return value * self.forces, error * self.forces

    def __str__(self) -> str:
        """Show trials, and force evaluations, for an independent potential energy; ? marks an unknown error."""
        (trials, error), (forces, uncertain) = self.inefficiency, self.cost
        if self.refused:
            return f"{self.steps:10}  {self.refused}"
        errors = (f"{error:.1f}", f"{uncertain:.0f}") if math.isfinite(error) else ("?", "?")
        return f"{self.steps:10}{self.acceptance:12.3f}  {trials:.1f} ± {errors[0]}, {forces:.0f} ± {errors[1]}"


class Tuning(NamedTuple):
    """Hold what `tune` found; print it as tables.

    Attributes:
        stepSize: ps.
        stepsPerTrial: number of steps in a trial.
        wanted: the acceptance that was asked for.
        steps: the steps that were tried, in order; each has `step` in ps, `spread` and `acceptance`.
        lengths: the lengths that were compared; each has `steps`, `acceptance`, `forces`, `inefficiency` and `refused`.
        forceEvaluations: number of force evaluations in the whole tuning.
    """

    stepSize: float
    stepsPerTrial: int
    wanted: float
    steps: tuple[StepFound, ...]
    lengths: tuple[LengthFound, ...]
    forceEvaluations: int

    def __str__(self) -> str:
        lines = [
            f"Hybrid Monte Carlo tuned for an acceptance of {self.wanted:g}, by {self.forceEvaluations} forces:",
            f"steps of {1e3 * self.stepSize:.4g} fs, {self.stepsPerTrial} in a trial",
            "",
            "   step/fs     sd/kT  acceptance",
        ]
        lines += [f"{1e3 * each.step:10.4g}{each.spread:10.3g}{each.acceptance:12.3f}" for each in self.steps]
        lines += ["", "     steps  acceptance  trials, and forces, for an independent potential energy"]
        return "\n".join([*lines, *map(str, self.lengths)])


def tune(
    context: openmm.Context,
    acceptance: float = 0.9,
    trials: int = 40,
    samples: int = 200,
    lengths: Sequence[int] | None = None,
) -> Tuning:
    """Find the step and trial length for a Context's hybrid Monte Carlo, and set them in its integrator.

    Equilibrate roughly before. Trials of the tuning are no samples, so leave them out of averages. Afterwards `trials`
    and `accepted` count from zero.

    >>> integrator = SIERHMCIntegrator(300*kelvin, 6*femtoseconds, stepsPerTrial=4)
    >>> simulation = Simulation(topology, system, integrator)
    >>> simulation.context.setPositions(positions)
    >>> tuning = tune(simulation.context, acceptance=0.8, trials=10, samples=10)
    >>> length = tuning.stepsPerTrial

    First it changes the step, at the same length in time, until the energy errors of trials have the standard deviation
    of the wanted acceptance. It never tries a step that resonates with fast forces.

    Then it compares trial lengths at this step, each with the same number of steps in all, and takes the one at which
    an independent potential energy costs the fewest forces, with the error of that cost added. If costs differ by less
    than their errors, take more samples.

    An interrupt or error restores the step and length that the integrator had.

    The same seed gives the same result if the platform's forces are deterministic.

    Args:
        context: the Context of a `SIERHMCIntegrator`, with positions. The search begins at the integrator's step and
            number of steps.
        acceptance: the wanted fraction, between 0 and 1; the largest useful steps have 0.6 to 0.95.
        trials: number of trials at each step size, at least 10.
        samples: number of trials of the integrator's length in time, at least 10; longer trials are fewer in
            proportion. The relative error of a cost is about 3 over the square root of the number of independent
            samples.
        lengths: numbers of steps in a trial to compare. None compares half the integrator's length in time, that
            length, twice and four times that.

    Returns:
        A `Tuning`; print it as tables.

    Raises:
        TypeError: the Context has another integrator.
        ValueError: an argument is out of its range.
        openmm.OpenMMException: no step or length could be tried; the message gives the last reason.
    """
    if not isinstance(context, openmm.Context):
        raise TypeError(f"tune needs a Context, such as simulation.context, got a {type(context).__name__}")
    integrator = context.getIntegrator()
    if not isinstance(integrator, SIERHMCIntegrator):
        raise TypeError(f"tune needs a Context with a SIERHMCIntegrator, got a {type(integrator).__name__}")
    if not 0 < acceptance < 1:
        raise ValueError(f"acceptance must be between 0 and 1, got {acceptance:g}")
    trials, samples = whole_number("trials", trials, FEWEST), whole_number("samples", samples, FEWEST)
    counts = None if lengths is None else [whole_number("lengths", steps, 1) for steps in lengths]
    if lengths is not None and not counts:
        raise ValueError("lengths must have at least one number of steps, got none")
    before, forces = (integrator.getSchemeStepSize(), integrator.getStepsPerTrial()), integrator.forceEvaluations
    if not (length := before[0].value_in_unit(unit.picosecond) * before[1]):
        raise ValueError("the integrator's step must be above zero, got 0")
    try:
        tried, step = _find_step(integrator, acceptance, trials, _longest_step(context))
        compared, steps = _find_length(integrator, step, samples, counts, length)
        _set(integrator, step, steps)
    except BaseException:
        integrator.setSchemeStepSize(before[0])
        integrator.setStepsPerTrial(before[1])
        raise
    integrator.resetStatistics()
    return Tuning(step, steps, acceptance, tuple(tried), tuple(compared), integrator.forceEvaluations - forces)


def _set(integrator: SIERHMCIntegrator, step: float, steps: int) -> None:
    """Set step and length, and make a trial, which also checks that trajectories reverse."""
    integrator.setSchemeStepSize(step)
    integrator.setStepsPerTrial(steps)
    integrator.step(1)


def _trial(integrator: SIERHMCIntegrator) -> float:
    integrator.step(1)
    return integrator.lastEnergyError


def _chances(errors: Sequence[float]) -> float:
    """Return the mean probability of acceptance for energy errors in kT, which may be infinite."""
    return float(np.exp(-np.maximum(errors, 0)).mean())


def _longest_step(context: openmm.Context) -> float:
    """Return the longest step whose kicks do not resonate with fast forces, ps; infinite without them."""
    integrator = context.getIntegrator()
    vibrations = Vibrations(context.getSystem(), integrator.bodies)
    vibrations.measure(context)
    return vibrations.longest_step(integrator.scheme, 0, group_mask("fastForceGroups", integrator.fastForceGroups))


def _find_step(integrator: SIERHMCIntegrator, wanted: float, trials: int, most: float) -> tuple[list[StepFound], float]:
    """Return the steps that were tried, and the one with the wanted acceptance, or `most` if that is less."""
    step = integrator.getSchemeStepSize().value_in_unit(unit.picosecond)
    time, order = step * integrator.getStepsPerTrial(), integrator.scheme.order
    tried: list[StepFound] = []
    longest, refusal, step = math.inf, None, min(step, most)
    for _ in range(ATTEMPTS):
        try:
            found = _try_step(integrator, step, max(1, round(time / step)), trials)
        except openmm.OpenMMException as error:
            # For example, the step is too long for a bond.
            found, refusal, longest = StepFound(step, math.inf, 0.0), error, step
        tried.append(found)
        # Of errors that are all zero, a longer step is tried.
        factor = (spread_at(wanted) / found.spread) ** (1 / order) if found.spread else LONGER
        following = min(step * min(LONGER, max(SHORTER, factor)), 0.9 * longest, most)
        if abs(following / step - 1) < SETTLED:
            return tried, following if refusal is None else step
        step = following
    usable = [each for each in tried if math.isfinite(each.spread)]
    if not usable:
        raise refusal or openmm.OpenMMException(f"Energy errors are not finite at steps down to {step:.3g} ps")
    return tried, min(usable, key=lambda each: abs(each.acceptance - wanted)).step


def _try_step(integrator: SIERHMCIntegrator, step: float, steps: int, trials: int) -> StepFound:
    _set(integrator, step, steps)
    errors = [_trial(integrator) for _ in range(trials)]
    followed = [error for error in errors if math.isfinite(error)]
    spread = float(np.std(followed, ddof=1)) if len(followed) > trials / 2 else math.inf
    return StepFound(step, spread, _chances(errors))


def _find_length(
    integrator: SIERHMCIntegrator, step: float, samples: int, counts: list[int] | None, time: float
) -> tuple[list[LengthFound], int]:
    """Compare lengths and find the cheapest; one without an error, or refused, only if there is no other."""
    if counts is None:
        counts = [max(1, round(factor * time / step)) for factor in LENGTHS]
    found = []
    for steps in sorted(set(counts)):
        try:
            found.append(_try_length(integrator, step, steps, max(FEWEST, round(samples * time / (step * steps)))))
        except openmm.OpenMMException as error:
            found.append(LengthFound(steps, refused=" ".join(str(error).split())))
    best = min(found, key=lambda each: (each.refused != "", math.isnan(each.cost[1]), np.nansum(each.cost)))
    if best.refused:
        raise openmm.OpenMMException(best.refused)
    return found, best.steps


def _try_length(integrator: SIERHMCIntegrator, step: float, steps: int, samples: int) -> LengthFound:
    _set(integrator, step, steps)
    before, errors, energies = integrator.forceEvaluations, [], []
    for _ in range(samples):
        errors.append(_trial(integrator))
        energies.append(integrator.binding.engine.potential_energy())
    forces = (integrator.forceEvaluations - before) / samples
    return LengthFound(steps, _chances(errors), forces, inefficiency_and_error(np.array(energies)))
