"""Errors of ensemble averages."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

GROUPS = 40


def jackknife(estimate: Callable[[np.ndarray], float], n: int) -> tuple[float, float]:
    """An estimate from all of n samples, and its standard error from leaving out groups of them.

    Args:
        estimate: from the indices of samples to a number.
        n: number of samples; each is a group of its own if there are fewer than `GROUPS`.
    """
    everything = np.arange(n)
    groups = np.array_split(everything, min(n, GROUPS))
    value = estimate(everything)
    if len(groups) < 2:
        return value, float("nan")
    left_out = np.array([estimate(np.setdiff1d(everything, group, assume_unique=True)) for group in groups])
    k = len(groups)
    return value, float(np.sqrt((k - 1) / k * ((left_out - left_out.mean()) ** 2).sum()))
