"""Timings that are robust against changes of a machine's speed."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, TypeVar

import numpy as np

from openmm_sier.analysis.statistics import Estimate
from openmm_sier.dynamics import threads

#: Platforms on which processor time is what a computation costs; on others the processor waits.
ON_PROCESSORS = ("CPU", "Reference")


Key = TypeVar("Key")


def counts_processor_time(platform: str | None) -> bool:
    """Whether speeds are those of processor time: on one thread, where other work has less effect on it."""
    return platform in ON_PROCESSORS and threads.count() == 1


def interleaved(
    actions: Mapping[str, Callable[[], object]], rounds: int, clock: Callable[[], float] = time.perf_counter
) -> dict[str, np.ndarray]:
    """Seconds that each action took in each round; a first round is not counted.

    Actions to be compared should take their turns within some tenths of a second: a machine's speed changes over
    seconds.

    Args:
        actions: by name.
        rounds: how many.
        clock: of wall time, or of processor time, on which other work on the machine has less effect.
    """

    def seconds(action: Callable[[], object]) -> float:
        start = clock()
        action()
        return clock() - start

    return turns({name: partial(seconds, action) for name, action in actions.items()}, rounds)


def turns(actions: Mapping[Key, Callable[[], Any]], rounds: int) -> dict[Key, np.ndarray]:
    """What each action gave in each round, (rounds, ...); a first round is not counted."""
    results: dict[Key, list[Any]] = {name: [] for name in actions}
    for number in range(rounds + 1):
        for name, action in actions.items():
            result = action()
            if number:
                results[name].append(result)
    return {name: np.array(each, dtype=float) for name, each in results.items()}


def median_and_error(values: np.ndarray) -> Estimate:
    """Median of independent values and its standard error, NaN for a single one.

    The standard error of the median of a normal distribution is sqrt(pi/2) sigma/sqrt(n), and sigma is taken from the
    distance of the quartiles, 1.349 sigma, so that outliers do not count.
    """
    low, median, high = np.percentile(values, [25, 50, 75])
    error = float(0.929 * (high - low) / math.sqrt(len(values))) if len(values) > 1 else math.nan
    return Estimate(float(median), error)
