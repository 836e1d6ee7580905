"""Means, slopes and medians with their standard errors."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

#: Number of groups that the jackknife leaves out in turn.
GROUPS = 40


def rms(values: np.ndarray) -> float:
    """Root mean square deviation from the mean."""
    return float(np.std(values))


def block_means(values: np.ndarray, blocks: int) -> np.ndarray:
    """Means of equal blocks of a series; a remainder that fills no block is left out at its start."""
    values = np.asarray(values, dtype=float)
    length = len(values) // blocks
    return values[len(values) - blocks * length :].reshape(blocks, length).mean(axis=1)


def mean_and_error(values: np.ndarray, blocks: int = 20) -> tuple[float, float]:
    """Mean of a correlated series and its standard error, from the scatter of the means of equal blocks.

    Args:
        values: the series; a remainder that fills no block is left out at its start.
        blocks: how many, each of which must be longer than the correlation time. There are fewer where the series is so
            short that a block would have fewer than two values; the error is NaN where it has fewer than four.
    """
    blocks = max(1, min(blocks, len(values) // 2))
    means = block_means(values, blocks)
    return float(means.mean()), float(means.std(ddof=1) / math.sqrt(blocks)) if blocks > 1 else math.nan


def slope_and_error(x: np.ndarray, y: np.ndarray, blocks: int = 10) -> tuple[float, float]:
    """Slope of a straight line through a correlated series and its standard error, from the means of equal blocks.

    The error is that of independent block means, so blocks must be longer than the correlation time.

    Args:
        x, y: the series.
        blocks: how many. A series with fewer values has a slope but no error, one of two values or fewer has neither.
    """
    if len(x) < 3:
        return math.nan, math.nan
    if len(x) < blocks:
        return float(np.polyfit(x - np.mean(x), y, 1)[0]), math.nan
    means = block_means(x, blocks), block_means(y, blocks)
    (slope, _), covariance = np.polyfit(*means, 1, cov=True)
    return float(slope), math.sqrt(covariance[0, 0])


def median_and_error(values: np.ndarray) -> tuple[float, float]:
    """Median of independent values and its standard error, NaN for a single one.

    The standard error of the median of a normal distribution is sqrt(pi/2) sigma/sqrt(n), and sigma is taken from the
    distance of the quartiles, 1.349 sigma, so that outliers do not count.
    """
    low, median, high = np.percentile(values, [25, 50, 75])
    return float(median), float(0.929 * (high - low) / math.sqrt(len(values))) if len(values) > 1 else math.nan


def jackknife(estimate: Callable[[np.ndarray], float], n: int) -> tuple[float, float]:
    """An estimate from all of n samples, and its standard error from leaving out groups of them.

    Args:
        estimate: takes the indices of samples and returns a number.
        n: number of samples; each is a group of its own if there are fewer than `GROUPS`.
    """
    everything = np.arange(n)
    groups = np.array_split(everything, min(n, GROUPS))
    value = estimate(everything)
    if len(groups) < 2:
        return value, math.nan
    left_out = np.array([estimate(np.setdiff1d(everything, group, assume_unique=True)) for group in groups])
    k = len(groups)
    return value, float(np.sqrt((k - 1) / k * ((left_out - left_out.mean()) ** 2).sum()))
