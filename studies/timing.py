"""Speeds of contestants that take turns, robust against changes of a machine's speed."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from time import perf_counter, process_time
from typing import Any

import numpy as np
import openmm

from openmm_sier.analysis.statistics import Estimate
from studies.frame import CALL, advance

#: Platforms on which processor time is what a computation costs; on others the processor waits.
ON_PROCESSORS = ("CPU", "Reference")


def turns(actions: Mapping[Any, Callable[[], Any]], rounds: int) -> dict[Any, np.ndarray]:
    """Return the results of each action in each round, (rounds, ...); a first round is not counted.

    Actions to be compared should take their turns within some tenths of a second: a machine's speed changes over
    seconds.
    """
    results: dict[Any, list[Any]] = {name: [] for name in actions}
    for number in range(rounds + 1):
        for name, action in actions.items():
            result = action()
            if number:
                results[name].append(result)
    return {name: np.array(each, dtype=float) for name, each in results.items()}


def median_and_error(values: np.ndarray) -> Estimate:
    """Return the median of independent values and its standard error, NaN for a single one.

    The standard error of the median of a normal distribution is sqrt(pi/2) sigma/sqrt(n), and sigma is taken from the
    distance of the quartiles, 1.349 sigma, so that outliers do not count.
    """
    low, median, high = np.percentile(values, [25, 50, 75])
    error = float(0.929 * (high - low) / math.sqrt(len(values))) if len(values) > 1 else math.nan
    return Estimate(float(median), error)


def speeds(
    contexts: Mapping[Any, openmm.Context],
    durations: Mapping[Any, float],
    references: Mapping[str, Any],
    rounds: int,
    turn: float,
) -> list[dict[str, Any]]:
    """Time Contexts by turns, and return a row for each.

    Args:
        contexts: at their starts, by the names of contestants.
        durations: simulated fs of one step, by the same names.
        references: for each column of ratios the name of the contestant over which they are.
        rounds: in which all take their turns.
        turn: seconds of a turn.

    Returns:
        Rows with the `name`, its `engine` and `platform`, `microseconds` of a step, simulated time in `ns_per_day` with
        its error, in that of processor time too, and ratios with errors. Steps and ratios are by processor time on the
        platforms of processors, and by that of the wall on others.
    """
    steps = {name: _steps_of_turn(context, turn) for name, context in contexts.items()}
    times = turns({name: partial(_turn, contexts[name], steps[name]) for name in contexts}, rounds)
    platform = next(iter(contexts.values())).getPlatform().getName()
    engines = {name: getattr(context.getIntegrator(), "engine", "") for name, context in contexts.items()}
    return [{"engine": engines[row["name"]]} | row for row in compared(times, durations, references, platform)]


def compared(
    times: Mapping[Any, np.ndarray], durations: Mapping[Any, float], references: Mapping[str, Any], platform: str
) -> list[dict[str, Any]]:
    """Return the rows of `speeds`, from seconds of wall and of processor time of a step, (rounds, 2)."""
    clock = 1 if platform in ON_PROCESSORS else 0
    # 86400 s a day, 1e6 fs a ns.
    rates = {name: 0.0864 * durations[name] / np.maximum(each, 1e-12) for name, each in times.items()}
    rows = []
    for name, each in times.items():
        row = {"name": name, "platform": platform, "microseconds": 1e6 * float(np.median(each[:, clock]))}
        for key, of_clock in (("ns_per_day", 0), ("ns_per_day_processor", 1)):
            row[key], row[f"{key}_error"], _ = median_and_error(rates[name][:, of_clock])
        for key, reference in references.items():
            row[key], error, _ = median_and_error(rates[name][:, clock] / rates[reference][:, clock])
            row[f"{key}_error"] = 0.0 if name == reference else error
        rows.append(row)
    return rows


def _turn(context: openmm.Context, steps: int) -> tuple[float, float]:
    """Return seconds of wall and of processor time of a step; reading the positions waits for a GPU."""
    wall, processor = perf_counter(), process_time()
    advance(context.getIntegrator(), steps)
    context.getState(positions=True)
    return (perf_counter() - wall) / steps, (process_time() - processor) / steps


def _steps_of_turn(context: openmm.Context, seconds: float) -> int:
    """Return the number of steps, a multiple of `CALL`, that take at least so many seconds."""
    _turn(context, CALL)
    return CALL * max(1, math.ceil(seconds / max(CALL * _turn(context, CALL)[0], 1e-9)))
