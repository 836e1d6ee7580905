"""Tuning of hybrid Monte Carlo: the scheme, its step and the length of trials, by what an independent sample costs."""

import copy
import math
from collections.abc import Sequence
from typing import NamedTuple

import openmm
from openmm import unit

from openmm_sier.dynamics.acceptance import acceptance_at, best_acceptance
from openmm_sier.dynamics.schemes import SIER2P3, SIER2V2, SIER4G, Scheme
from openmm_sier.integrators.hmc import SIERHMCIntegrator
from openmm_sier.integrators.tuning_measurements import FEWEST, best_length, find_step, set_trials, try_length
from openmm_sier.integrators.tuning_results import LengthFound, SchemeFound, Tuning
from openmm_sier.system.arguments import checked_scheme, whole_number
from openmm_sier.system.second_context import follow_parameters, platform_of

#: The schemes that are compared, beside that of the integrator.
SCHEMES = (SIER2V2, SIER2P3, SIER4G)

#: Numbers of RATTLE steps in a drift that are compared with the usual one. More of them make energy errors smaller.
SUBSTEPS = (2, 3)

#: Trajectory lengths to compare, as multiples of the one that the integrator had.
LENGTHS = (0.5, 1.0, 2.0, 4.0)


def tune(
    context: openmm.Context,
    acceptance: float | None = None,
    trials: int = 40,
    samples: int = 200,
    lengths: Sequence[int] | None = None,
    schemes: Sequence[Scheme | str] | None = None,
    substeps: Sequence[int] | None = None,
) -> Tuning:
    """Find scheme, step and trial length of hybrid Monte Carlo for a Context; set step and length in its integrator.

    Equilibrate roughly before. Trials of the tuning are no samples, so leave them out of averages. Afterwards `trials`
    and `accepted` count from zero.

    >>> integrator = SIERHMCIntegrator(300*kelvin, 6*femtoseconds, stepsPerTrial=4)
    >>> simulation = Simulation(topology, system, integrator)
    >>> simulation.context.setPositions(positions)
    >>> tuning = tune(simulation.context, acceptance=0.8, trials=10, samples=10, schemes=["SIER2V2"])
    >>> length = tuning.stepsPerTrial

    First it changes the step of each scheme, at the same length in time, until the energy errors of trials have the
    standard deviation of the best acceptance. It never tries a step that resonates with fast forces. The best scheme is
    the one whose accepted trajectories take the least processor time, or on GPUs the least time. In the same way it
    finds how many steps of RATTLE a drift takes, where the native engine moves molecules without fast forces.

    Then it compares trial lengths with this scheme, each with the same number of steps in all, and takes the one at
    which an independent potential energy takes the least time, with the error of that time added. If times differ by
    less than their errors, take more samples.

    It tries other schemes and substeps than the integrator's in Contexts of their own. An integrator keeps its own: if
    others are the best, it gets the best step for its own, and the result says that they need a new integrator.

    An interrupt or error restores the step and length that the integrator had. The same seed makes the same trials if
    the platform's forces are deterministic, but the choice also depends on the time that they take.

    Args:
        context: the Context of a `SIERHMCIntegrator`, with positions. The search begins at the integrator's step and
            number of steps.
        acceptance: the wanted fraction, between 0 and 1. None takes that at which step times acceptance is nearly
            largest: 0.77 for a scheme of second order and 0.90 for one of fourth order.
        trials: number of trials at each step size, at least 10.
        samples: number of trials of the integrator's length in time, at least 10; longer trials are fewer in
            proportion. The relative error of a cost is about 3 over the square root of the number of independent
            samples.
        lengths: numbers of steps in a trial to compare. None compares half the integrator's length in time, that
            length, twice and four times that.
        schemes: schemes to compare, or their names. None compares the integrator's with SIER2V2, SIER2P3 and SIER4G.
        substeps: numbers of RATTLE steps in a drift to compare with the integrator's, for the best scheme. None
            compares 2 and 3 with the usual one, and nothing with a number that the integrator was given.

    Returns:
        A `Tuning`; print it as tables.

    Raises:
        TypeError: the Context has another integrator.
        ValueError: an argument is out of its range.
        openmm.OpenMMException: no scheme, step or length could be tried; the message gives the last reason.
    """
    integrator = _integrator_of(context)
    if acceptance is not None and not 0 < acceptance < 1:
        raise ValueError(f"acceptance must be between 0 and 1, got {acceptance:g}")
    trials, samples = whole_number("trials", trials, FEWEST), whole_number("samples", samples, FEWEST)
    counts = None if lengths is None else [whole_number("lengths", steps, 1) for steps in lengths]
    if lengths is not None and not counts:
        raise ValueError("lengths must have at least one number of steps, got none")
    compared = _schemes(integrator.scheme, schemes)
    divisions = _divisions(context, substeps)
    start = _Start.of(integrator)
    if not start.time:
        raise ValueError("the integrator's step must be above zero, got 0")
    try:
        candidates = [
            _try_scheme(context, _Choice.of(scheme, integrator, start), start.time, acceptance, trials)
            for scheme in compared
        ]
        best = _cheapest(candidates)
        others = [_Choice(best.scheme, number, best.step) for number in divisions]
        candidates += [_try_scheme(context, other, start.time, acceptance, trials) for other in others]
        best = _cheapest(candidates)
        of_lengths = _compare_lengths(context, best, start, samples, counts)
        steps = best_length(of_lengths).steps
        own = next((each for each in candidates if each.is_of(integrator.scheme, integrator.substeps)), None)
        if own is not None:
            set_trials(integrator, own.step, steps if own is best else max(1, round(best.step * steps / own.step)))
    except BaseException:
        integrator.setSchemeStepSize(start.step)
        integrator.setStepsPerTrial(start.steps)
        raise
    integrator.resetStatistics()
    return Tuning(best.scheme, best.step, steps, tuple(candidates), of_lengths, best is own, best.substeps)


class _Start(NamedTuple):
    """Settings that the integrator had before.

    Attributes:
        step: ps.
        steps: of a trial.
        per_force: simulated time for each force evaluation, ps.
    """

    step: float
    steps: int
    per_force: float

    @classmethod
    def of(cls, integrator: SIERHMCIntegrator) -> "_Start":
        step = integrator.getSchemeStepSize().value_in_unit(unit.picosecond)
        return cls(step, integrator.getStepsPerTrial(), step / integrator.scheme.force_evaluations)

    @property
    def time(self) -> float:
        """Return the length of a trial, ps."""
        return self.step * self.steps


class _Choice(NamedTuple):
    """Settings of trials.

    Attributes:
        scheme: the scheme.
        substeps: see `SIERIntegrator`.
        step: with which the search for the best one begins, ps.
    """

    scheme: Scheme
    substeps: int | None
    step: float

    @classmethod
    def of(cls, scheme: Scheme, integrator: SIERHMCIntegrator, start: _Start) -> "_Choice":
        """Return another scheme with the substeps and the simulated time per force of an integrator."""
        return cls(scheme, integrator.substeps, start.per_force * scheme.force_evaluations)


def _integrator_of(context: openmm.Context) -> SIERHMCIntegrator:
    integrator = context.getIntegrator()
    if not isinstance(integrator, SIERHMCIntegrator):
        raise TypeError(f"tune needs a Context with a SIERHMCIntegrator, got a {type(integrator).__name__}")
    return integrator


def _schemes(own: Scheme, asked: Sequence[Scheme | str] | None) -> list[Scheme]:
    """Return the schemes to compare, each once."""
    compared = list(map(checked_scheme, [own, *SCHEMES] if asked is None else asked))
    if not compared:
        raise ValueError("schemes must have at least one scheme, got none")
    return [scheme for i, scheme in enumerate(compared) if scheme not in compared[:i]]


def _divisions(context: openmm.Context, asked: Sequence[int] | None) -> list[int]:
    """Return the numbers of RATTLE steps in a drift to compare with that of the integrator."""
    integrator = context.getIntegrator()
    if asked is not None:
        numbers = [whole_number("substeps", number, 1) for number in asked]
    else:
        numbers = [*SUBSTEPS] if integrator.substeps is None else []
    has_rattle = integrator.engine == "native" and context.getSystem().getNumConstraints() > 0
    if not has_rattle or integrator.fastForceGroups:
        return []
    return sorted(set(numbers) - {integrator.substeps})


def _context_for(context: openmm.Context, scheme: Scheme, substeps: int | None) -> openmm.Context:
    """Return the Context itself for its own scheme and substeps, or another one at the same state."""
    integrator = context.getIntegrator()
    if (scheme, substeps) == (integrator.scheme, integrator.substeps):
        return context
    other = copy.copy(integrator)
    other.impl.change(scheme=scheme, substeps=substeps)
    made = openmm.Context(context.getSystem(), other, *platform_of(context))
    state = context.getState(positions=True, velocities=True)
    made.setPeriodicBoxVectors(*state.getPeriodicBoxVectors())
    follow_parameters(context, made)
    made.setPositions(state.getPositions(asNumpy=True))
    made.setVelocities(state.getVelocities(asNumpy=True))
    return made


# --- schemes and their steps ---


def _try_scheme(
    context: openmm.Context, choice: _Choice, time: float, acceptance: float | None, trials: int
) -> SchemeFound:
    """Return the best step of a choice for trials of a length in ps, and what its accepted trajectories cost."""
    scheme, substeps, first = choice
    wanted = best_acceptance(scheme.order) if acceptance is None else acceptance
    try:
        tried_in = _context_for(context, scheme, substeps)
        tried, step = find_step(tried_in, first, time, wanted, trials)
    except openmm.OpenMMException as error:
        return SchemeFound(scheme, math.nan, 0.0, math.inf, (), " ".join(str(error).split()), substeps)
    nearest = min((each for each in tried if math.isfinite(each.spread)), key=lambda each: abs(each.step - step))
    expected = acceptance_at(nearest.spread * (step / nearest.step) ** scheme.order)
    # A step takes as long, whatever its size.
    seconds = nearest.seconds * nearest.step / step
    return SchemeFound(scheme, step, expected, seconds / expected, tuple(tried), substeps=substeps)


def _cheapest(candidates: Sequence[SchemeFound]) -> SchemeFound:
    best = min(candidates, key=lambda each: each.seconds)
    if best.refused:
        raise openmm.OpenMMException(best.refused)
    return best


# --- lengths of trials ---


def _compare_lengths(
    context: openmm.Context, best: SchemeFound, start: _Start, samples: int, counts: list[int] | None
) -> tuple[LengthFound, ...]:
    """Return what trials of several numbers of steps cost, of the best scheme at its step."""
    if counts is None:
        counts = [max(1, round(factor * start.time / best.step)) for factor in LENGTHS]
    tried_in = _context_for(context, best.scheme, best.substeps)
    lengths = []
    for steps in sorted(set(counts)):
        several = max(FEWEST, round(samples * start.time / (best.step * steps)))
        try:
            lengths.append(try_length(tried_in, best.step, steps, several))
        except openmm.OpenMMException as error:
            lengths.append(LengthFound(steps, refused=" ".join(str(error).split())))
    return tuple(lengths)
