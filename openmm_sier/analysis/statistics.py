"""Estimates with standard errors: means of series, means over runs, slopes, and the jackknife."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from openmm_sier.dynamics.correlation import inefficiency, is_constant

#: Fewest independent samples of a reliable error. A shorter series hides its correlation time.
FEWEST = 20

#: Number of groups omitted one by one in the jackknife.
GROUPS = 40

#: Number of runs from which their scatter gives the error of the mean.
ENOUGH_RUNS = 5

#: Number of initial segments of a series that are tested for equilibration.
BEGINNINGS = 50

#: Length of the longest initial segment, as a fraction of the series. A shorter rest would hide its correlation time.
LONGEST_BEGINNING = 0.5

#: Difference in standard errors between the means of an initial segment and of the rest above which the segment is not
#: equilibrated; and number of independent values in the rest at which the threshold is doubled, because short series
#: underestimate their correlation time and scatter. Of series without a trend one in a hundred then seems to have one,
#: and of series with a slow component that a run hardly shows, one in twenty.
UNSETTLED, FEW_SETTLED = 4.0, 10

#: Trend in standard errors above which initial segments of a series too short to decide are discarded.
DOUBTFUL = 2.0


class Estimate(NamedTuple):
    """Value with a standard error. Print it for a summary.

    Attributes:
        value: the value; NaN if there is none.
        error: standard error; NaN if unknown, 0 for constant quantities.
        samples: number of independent samples behind the error; infinite if they were not counted. An error from fewer
            than `FEWEST` is too small on average: 0.8 of the true error from 5 samples, half of it from 2.
    """

    value: float
    error: float
    samples: float = math.inf

    def __str__(self) -> str:
        """Return text with two digits of the error, marked by ≥ if it is from few samples, or ? if it is unknown."""
        if math.isnan(self.value):
            return "-"
        if not math.isfinite(self.error):
            return f"{format_number(self.value)} ± ?"
        if not self.error:
            return format_number(self.value)
        exponent = math.floor(math.log10(max(abs(self.value), self.error)))
        if not -4 <= exponent < 7:
            return f"({self.times(10.0**-exponent)})e{exponent}"
        digits = max(0, 1 - math.floor(math.log10(self.error)))
        return f"{self.value:.{digits}f} ± {'≥' if self.samples < FEWEST else ''}{self.error:.{digits}f}"

    def times(self, factor: float) -> Estimate:
        """Return the estimate times a factor, for another unit."""
        return self._replace(value=self.value * factor, error=self.error * abs(factor))


def format_number(value: float, digits: int = 4) -> str:
    """Return a number with `digits` significant digits, and without an exponent from 1e-4 to 1e7.

    >>> format_number(-12345.6), format_number(0.0123456, digits=2)
    ('-12346', '0.012')
    """
    text = f"{value:.{digits}g}"
    return f"{value:.0f}" if 10**digits <= abs(float(text)) < 1e7 else text


def rms(values: np.ndarray) -> float:
    """Return the root mean square deviation from the mean."""
    return float(np.std(values))


# --- means ---


def mean_and_error(series: np.ndarray) -> Estimate:
    """Return the mean of a correlated series (n,); the error is unknown for fewer than `FEWEST` values.

    >>> print(mean_and_error(np.random.default_rng(1).normal(297, 5, size=10000)))
    296.945 ± 0.050

    The variance of a mean of n values is that of the values over n/g, their number of independent samples. The variance
    about the mean of the series is too small by the factor 1 - g/n.
    """
    values = np.asarray(series, dtype=float)
    value, n = float(values.mean()), len(values)
    if is_constant(values) and n > 1:
        return Estimate(value, 0.0)
    samples = n / inefficiency(values)
    error = rms(values) / math.sqrt(samples - 1) if n >= FEWEST and samples > 1 else math.nan
    return Estimate(value, error, samples)


def of_independent(values: np.ndarray) -> Estimate:
    """Return the mean of independent values (n,), n > 1; the error is from their scatter.

    >>> print(of_independent(np.array([1.0, 2.0, 3.0])))
    2.00 ± ≥0.58
    """
    return Estimate(float(np.mean(values)), float(np.std(values, ddof=1) / math.sqrt(len(values))), len(values))


def pooled(estimates: Sequence[Estimate]) -> Estimate:
    """Return the mean over independent runs, each with the same weight.

    >>> print(pooled([Estimate(1.0, 0.3), Estimate(2.0, 0.4)]))
    1.50 ± 0.25

    The error is from the scatter of at least `ENOUGH_RUNS` runs, or else from the errors of the runs.
    """
    values, errors, samples = np.array(estimates, dtype=float).T
    if is_constant(values) and not errors.any():
        return Estimate(float(values.mean()), 0.0)
    if len(values) >= ENOUGH_RUNS:
        return of_independent(values)
    return Estimate(float(values.mean()), float(np.linalg.norm(errors) / len(values)), float(samples.sum()))


def over_runs(values: Sequence[Estimate | float]) -> Estimate | float:
    """Return the mean over runs, with an error from their scatter or, for few runs, from their errors.

    If few runs have no errors, their scatter is used nevertheless, and the error is marked as from few samples.
    """
    if len(values) == 1:
        return values[0]
    estimates = [value if isinstance(value, Estimate) else Estimate(value, math.nan) for value in values]
    mean = pooled(estimates)
    if math.isfinite(mean.error):
        return mean
    return of_independent(np.array([estimate.value for estimate in estimates]))


def jackknife(estimate: Callable[[np.ndarray], float], n: int, groups: int = GROUPS) -> Estimate:
    """Return an estimate from all of n samples, and its standard error from leaving out groups of them.

    >>> values = np.random.default_rng(1).normal(size=1000)
    >>> variance = jackknife(lambda kept: values[kept].var(), len(values))

    Args:
        estimate: function of the indices of samples that returns a number.
        n: number of samples; each is a group by itself if there are fewer than `groups`.
        groups: number of groups of neighbouring samples. In a series each must be longer than the correlation time.
    """
    value, k = estimate(np.arange(n)), min(n, groups)
    if k < 2:
        return Estimate(value, math.nan)
    edges = np.linspace(0, n, k + 1).astype(int)
    left_out = [estimate(np.r_[0:begin, end:n]) for begin, end in pairwise(edges)]
    return Estimate(value, math.sqrt(k - 1) * float(np.std(left_out)))


# --- equilibration ---


class Settling(NamedTuple):
    """Equilibrated part of a series, which fluctuates about one mean.

    Attributes:
        begin: index of its first value; the length of the series if a trend continues to the end.
        samples: number of independent values in it. Fewer than `FEWEST` do not show a trend.
    """

    begin: int
    samples: float


def settled_from(series: np.ndarray) -> int:
    """Return the index from which a series (n,) fluctuates about one mean; 0 if it does so from the start.

    The index maximizes the number of independent values in the rest, if the means before and after it differ
    significantly. If the rest still has a trend, the series has not settled, and its length is returned.

    Source: Chodera, J. Chem. Theory Comput. 12, 1799 (2016), as in `pymbar.timeseries.detect_equilibration`.

    >>> series = np.random.default_rng(1).normal(size=1000)
    >>> series[:100] += 20
    >>> bool(settled_from(series) >= 100)
    True
    """
    return settling(series).begin


def settling(series: np.ndarray) -> Settling:
    """Return the equilibrated part of a series (n,), see `settled_from`, and its number of independent values.

    If the whole series has enough independent values, an initial segment is discarded only if its mean differs from
    that of the rest by `UNSETTLED` standard errors. If no rest has enough, segments are discarded until no doubtful
    trend is left, up to half of the series.
    """
    values = np.asarray(series, dtype=float)
    n = len(values)
    if is_constant(values) and n > 1:
        return Settling(0, math.inf)
    if n < FEWEST:
        return Settling(0, n)
    begins = np.unique(np.linspace(0, LONGEST_BEGINNING * n, BEGINNINGS).astype(int))
    samples = (n - begins) / np.array([inefficiency(values[begin:]) for begin in begins])
    best = int(np.argmax(samples))
    if samples[0] >= FEWEST and best and not _begins_elsewhere(values, int(begins[best])):
        best = 0
    begin = int(begins[best])
    if _is_significant(*_trend(values[begin:])):
        return Settling(n, float(samples[best]))
    if samples[best] < FEWEST:
        trends = (_trend(values[begin:]) for begin in begins)
        steady = (i for i, (rise, error, _) in enumerate(trends) if rise <= DOUBTFUL * error)
        best = next(steady, len(begins) - 1)
    return Settling(int(begins[best]), float(samples[best]))


def _begins_elsewhere(values: np.ndarray, begin: int) -> bool:
    """Return whether the means before and after an index differ significantly."""
    first, rest = values[:begin], values[begin:]
    memory = inefficiency(rest)
    samples = max(1.0, len(rest) / memory)
    error = rms(rest) * math.sqrt(min(1.0, memory / begin) + 1 / samples)
    return _is_significant(abs(first.mean() - rest.mean()), error, samples)


def _trend(values: np.ndarray) -> tuple[float, float, float]:
    """Return the rise or fall of a straight line through a series, its error, and the number of independent values.

    The trend of too few values is zero.
    """
    if len(values) < FEWEST:
        return 0.0, 0.0, float(len(values))
    places = np.linspace(-0.5, 0.5, len(values))
    line = np.polyval(np.polyfit(places, values, 1), places)
    samples = len(values) / inefficiency(values - line)
    # The error is that of the difference between the ends of a line through `samples` independent values.
    return abs(line[-1] - line[0]), rms(values - line) * math.sqrt(12 / samples), samples


def _is_significant(difference: float, error: float, samples: float) -> bool:
    return difference > UNSETTLED * error * (1 + FEW_SETTLED / samples)


# --- slopes ---


def block_means(values: np.ndarray, blocks: int) -> np.ndarray:
    """Return the means of equal blocks of a series; a remainder at the start is left out."""
    values = np.asarray(values, dtype=float)
    length = len(values) // blocks
    return values[len(values) - blocks * length :].reshape(blocks, length).mean(axis=1)


def slope_and_error(x: np.ndarray, y: np.ndarray, blocks: int = 10) -> Estimate:
    """Return the slope of a straight line through a correlated series, and its error from the means of equal blocks.

    >>> x = np.arange(100.0)
    >>> slope = slope_and_error(x, 3 * x + np.random.default_rng(1).normal(size=100))

    The error is that of independent block means, so blocks must be longer than the correlation time.

    Args:
        x: the first series, (n,).
        y: the second series, (n,).
        blocks: number of blocks. With fewer values there is a slope but no error, with fewer than three neither.
    """
    if len(x) < 3:
        return Estimate(math.nan, math.nan)
    if len(x) < blocks:
        return Estimate(float(np.polyfit(x - np.mean(x), y, 1)[0]), math.nan)
    means = block_means(x, blocks), block_means(y, blocks)
    (slope, _), covariance = np.polyfit(*means, 1, cov=True)
    return Estimate(float(slope), math.sqrt(covariance[0, 0]))
