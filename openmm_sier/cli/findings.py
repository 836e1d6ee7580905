"""Findings about runs, in sentences: whether they settled, drift, heat of the steps, temperatures that differ."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from openmm_sier.analysis.statistics import FEWEST, Estimate, mean_and_error, over_runs
from openmm_sier.cli import results
from openmm_sier.cli.logged_runs import Run, Runs, groups, have_same_noise
from openmm_sier.cli.settling import SETTLES
from openmm_sier.observe.conservation import CONSERVED, TEMPERATURES

#: Standard errors from which on a difference is significant.
SIGNIFICANT = 3.0

#: Motions in words, by the columns of their temperatures.
MOTIONS = dict(zip(TEMPERATURES, ("translation", "rotation", "flexible molecules"), strict=True))


def verdict(runs: Runs) -> str:
    """Return a sentence on whether the runs had settled, and on the part that means are taken from."""
    length, begin = (f"{value:.4g} {runs.unit}" for value in (runs.length - runs.skipped, runs.begin))
    left_out = f"Means leave out the first {begin}"
    if runs.drifting:
        state = f"Not settled in {length}: {listed(runs.drifting)}"
    elif runs.unclear:
        state = f"{length}: too short to tell a trend of {listed(runs.unclear)}"
    elif runs.moving:
        state = f"Settled after {begin}: {listed(runs.moving)}"
        left_out = "Means are of the rest"
    else:
        steady = "energy, temperatures or density" if runs.first.moves_volume else "energy or temperatures"
        state = f"{length} without a trend of {steady}"
    sentences = [state, left_out] if runs.begin else [state]
    if doubtful := sum(run.unsettled is not None for run in runs.runs):
        of_all = f": {doubtful} of {len(runs.runs)} runs" if len(runs.runs) > 1 else ""
        sentences.append(f"Not equilibrated at the start{of_all}")
    return ". ".join(sentences)


def findings(runs: Runs) -> list[str]:
    """Return sentences on the conserved energy and on temperatures; means are in the table of `summary`."""
    sentences = []
    is_counted = all(np.isfinite(run.log[CONSERVED]).all() for run in runs.runs)
    if runs.ensemble != "hmc" and is_counted:
        drift = _over(runs, lambda _, log: results.drift(log))
        sentences.append(_of_heat(drift) if runs.ensemble in ("nvt", "npt") else _of_drift(drift))
    return [*sentences, _of_temperatures(runs)]


def warnings_of(runs: Runs) -> list[str]:
    """Return warnings about runs that count once, have the same noise, or were not equilibrated."""
    copies = [
        f"warning: {listed(list(map(str, paths)))} are logs of one run, which counts once. Give each run a --seed of "
        "its own"
        for paths in runs.copies
    ]
    same_noise = [
        f"warning: {listed(list(map(str, paths)))} have the same seed, settings and inputs, and so the same noise: "
        "give each run a --seed of its own"
        for paths in groups(runs.runs, have_same_noise)
    ]
    doubtful = [run for run in runs.runs if run.unsettled]
    unsettled = [f"warning: {run.path}: not equilibrated, after {run.unsettled}" for run in doubtful]
    return [*copies, *same_noise, *unsettled]


def listed(names: Sequence[str]) -> str:
    """Return names as in a sentence."""
    *first, last = names
    return f"{', '.join(first)} and {last}" if first else last


# --- sentences ---


def _of_drift(drift: Estimate) -> str:
    if not math.isfinite(drift.error):
        return "The runs are too short to tell a drift of the conserved energy"
    if _is_significant(drift):
        return f"The conserved energy drifts by {drift} kJ/mol/ps"
    return f"No drift of the conserved energy shows: {drift} kJ/mol/ps"


def _of_heat(heat: Estimate) -> str:
    if not math.isfinite(heat.error):
        return "The runs are too short to tell the heat of the steps"
    if not _is_significant(heat):
        return f"No heat of the steps shows: {heat} kJ/mol/ps"
    verb = "heat" if heat.value > 0 else "cool"
    return f"The steps {verb} by {heat.times(math.copysign(1, heat.value))} kJ/mol/ps, which the bath balances"


def _of_temperatures(runs: Runs) -> str:
    """Return a sentence on the temperature that differs most, in units of its error, from bath or translation."""
    columns = [column for column in MOTIONS if np.isfinite(runs.first.log[column]).all()]
    if any(SETTLES[column] in runs.drifting for column in columns):
        return "Temperatures have not settled"
    plan = runs.first.plan
    if plan and plan.ensemble != "nve":
        bath = plan.temperature
        off = {column: _over(runs, _difference_from(column, lambda _: bath)) for column in columns}
        reference = f"the bath of {bath:g} K"
    else:
        first, *others = columns
        off = {column: _over(runs, _difference_from(column, lambda log: log[first])) for column in others}
        reference = MOTIONS[first]
    if not off:
        return f"The temperature is {_over(runs, lambda _, log: mean_and_error(log[columns[0]]))} K"
    if not all(math.isfinite(difference.error) for difference in off.values()):
        return "The runs are too short to tell temperatures apart"
    worst = max(off, key=lambda column: abs(off[column].value) - _least_difference(off[column]))
    if not _is_significant(off[worst]):
        motions = listed([MOTIONS[column] for column in off])
        within = max(map(_least_difference, off.values()))
        return f"{_capital(motions)}: no difference from {reference} shows within {within:.2g} K"
    warmer = "warmer" if off[worst].value > 0 else "colder"
    by = off[worst].times(math.copysign(1, off[worst].value))
    verb = "is" if worst != TEMPERATURES[2] else "are"
    return f"{_capital(MOTIONS[worst])} {verb} {by} K {warmer} than {reference}"


def _capital(text: str) -> str:
    return text[0].upper() + text[1:]


# --- estimates ---


def _over(runs: Runs, estimate: Callable[[Run, dict[str, np.ndarray]], Estimate]) -> Estimate:
    """Return an estimate over all runs, from the parts of their logs that had settled."""
    value = over_runs([estimate(run, run.after(runs.begin)) for run in runs.runs])
    assert isinstance(value, Estimate)
    return value


def _difference_from(
    column: str, reference: Callable[[dict[str, np.ndarray]], np.ndarray | float]
) -> Callable[[Run, dict[str, np.ndarray]], Estimate]:
    """Return a function that gives the mean of a column less a reference."""

    def difference(_: Run, log: dict[str, np.ndarray]) -> Estimate:
        return mean_and_error(log[column] - reference(log))

    return difference


def _least_difference(estimate: Estimate) -> float:
    """Return the least difference that is significant for a value with this error."""
    # An error from few samples is too small by up to a factor of two.
    return SIGNIFICANT * estimate.error * (2 if estimate.samples < FEWEST else 1)


def _is_significant(estimate: Estimate) -> bool:
    """Return whether a value differs from 0 by more than its error explains."""
    return abs(estimate.value) > _least_difference(estimate)
