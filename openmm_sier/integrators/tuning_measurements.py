"""Measurements of tuning: trials at a step and length, the step of an acceptance, the cost of a sample."""

import math
import time
from collections.abc import Sequence

import numpy as np
import openmm

from openmm_sier.dynamics.acceptance import spread_at
from openmm_sier.dynamics.correlation import inefficiency_and_error
from openmm_sier.engines.snapshot import is_on_host
from openmm_sier.integrators.hmc import SIERHMCIntegrator
from openmm_sier.integrators.tuning_results import LengthFound, StepFound
from openmm_sier.stability.step_check import StepCheck
from openmm_sier.system.arguments import group_mask

#: Least number of trials for a spread or an autocorrelation.
FEWEST = 10

#: Number of attempts to find the step, bounds of its change in each, and the change below which the search ends. The
#: spread of 40 energy errors is known to 11 %, and so the step to 3 % for a fourth-order scheme and 6 % for a
#: second-order one.
ATTEMPTS, SHORTER, LONGER, SETTLED = 10, 0.6, 1.5, 0.06


def _seconds(context: openmm.Context) -> float:
    """Return the time of the processor or, where a GPU works, of the clock."""
    return time.process_time() if is_on_host(context.getPlatform()) else time.perf_counter()


def set_trials(integrator: SIERHMCIntegrator, step: float, steps: int) -> None:
    """Set step and length, and make a trial, which also checks that trajectories reverse."""
    integrator.setSchemeStepSize(step)
    integrator.setStepsPerTrial(steps)
    integrator.step(1)


def make_trial(integrator: SIERHMCIntegrator) -> float:
    integrator.step(1)
    return integrator.lastEnergyError


def _chances(errors: Sequence[float]) -> float:
    """Return mean probability of acceptance for energy errors in kT, which may be infinite."""
    return float(np.exp(-np.maximum(errors, 0)).mean())


def find_step(
    context: openmm.Context, first: float, time: float, wanted: float, trials: int
) -> tuple[list[StepFound], float]:
    """Return the steps that were tried, and the one with the wanted acceptance, or the longest allowed one."""
    order, most = context.getIntegrator().scheme.order, _longest_step(context)
    tried: list[StepFound] = []
    longest, refusal, step = math.inf, None, min(first, most)
    for _ in range(ATTEMPTS):
        try:
            attempt = _try_step(context, step, max(1, round(time / step)), trials)
        except openmm.OpenMMException as error:
            # For example, the step is too long for a bond.
            attempt, refusal, longest = StepFound(step, math.inf, 0.0), error, step
        tried.append(attempt)
        # Of errors that are all zero, a longer step is tried.
        factor = (spread_at(wanted) / attempt.spread) ** (1 / order) if attempt.spread else LONGER
        following = min(step * min(LONGER, max(SHORTER, factor)), 0.9 * longest, most)
        if abs(following / step - 1) < SETTLED:
            return tried, following if refusal is None else step
        step = following
    usable = [each for each in tried if math.isfinite(each.spread)]
    if not usable:
        message = (
            f"The energy error is not finite at any step that was tried, down to {step:.3g} ps. Do atoms overlap? Then "
            "minimize the energy first"
        )
        raise refusal or openmm.OpenMMException(message)
    return tried, min(usable, key=lambda each: abs(each.acceptance - wanted)).step


def _try_step(context: openmm.Context, step: float, steps: int, trials: int) -> StepFound:
    integrator = context.getIntegrator()
    set_trials(integrator, step, steps)
    before, begun = integrator.forceEvaluations, _seconds(context)
    errors = [make_trial(integrator) for _ in range(trials)]
    # Trajectories that go on after a first end that is not accepted are no part of what is compared.
    share = trials * steps * integrator.scheme.force_evaluations / (integrator.forceEvaluations - before)
    seconds = min(share, 1.0) * (_seconds(context) - begun) / (trials * steps * step)
    followed = [error for error in errors if math.isfinite(error)]
    spread = float(np.std(followed, ddof=1)) if len(followed) > trials / 2 else math.inf
    return StepFound(step, spread, _chances(errors), seconds)


def try_length(context: openmm.Context, step: float, steps: int, samples: int) -> LengthFound:
    integrator = context.getIntegrator()
    set_trials(integrator, step, steps)
    before, begun, errors, energies = integrator.forceEvaluations, _seconds(context), [], []
    for _ in range(samples):
        errors.append(make_trial(integrator))
        energies.append(integrator.impl.engine.potential_energy())
    seconds = (_seconds(context) - begun) / samples
    forces = (integrator.forceEvaluations - before) / samples
    return LengthFound(steps, _chances(errors), forces, inefficiency_and_error(np.array(energies)), seconds)


def best_length(lengths: Sequence[LengthFound]) -> LengthFound:
    """Return the cheapest; of those without an error, or refused, only if no other is."""
    best = min(lengths, key=lambda each: (each.refused != "", math.isnan(each.duration[1]), np.nansum(each.duration)))
    if best.refused:
        raise openmm.OpenMMException(best.refused)
    return best


def _longest_step(context: openmm.Context) -> float:
    """Return the longest step whose kicks do not resonate with fast forces, ps; infinite without them."""
    integrator = context.getIntegrator()
    fast = group_mask("fastForceGroups", integrator.fastForceGroups)
    return StepCheck(context.getSystem(), integrator.bodies).longest_step(integrator.scheme, 0, fast, context=context)
