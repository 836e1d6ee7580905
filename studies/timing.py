"""Timings that are robust against changes of a machine's speed."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np

from openmm_sier.analysis.statistics import Estimate

#: Platforms on which processor time is what a computation costs; on others the processor waits.
ON_PROCESSORS = ("CPU", "Reference")


Key = TypeVar("Key")


def turns(actions: Mapping[Key, Callable[[], Any]], rounds: int) -> dict[Key, np.ndarray]:
    """Return the results of each action in each round, (rounds, ...); a first round is not counted.

    Actions to be compared should take their turns within some tenths of a second: a machine's speed changes over
    seconds.
    """
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
