"""Estimates: values with standard errors. Of means of series, of slopes, by the jackknife, over runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from openmm_sier.dynamics.correlation import inefficiency, is_constant

#: Independent samples below which an error means little. A series so short does not show how long it remembers.
FEWEST = 20

#: Number of groups that the jackknife leaves out in turn.
GROUPS = 40

#: Runs from which on their scatter tells the error of their mean.
ENOUGH_RUNS = 5

#: Number of beginnings of a series that are tried when it is asked where it settled.
BEGINNINGS = 50

#: The longest of them, as a share of the series. A shorter rest does not show how long it remembers.
LONGEST_BEGINNING = 0.5

#: Standard errors by which the mean of a beginning differs from that of the rest before it counts as not settled; and
#: independent values of the rest at which twice as many are asked for, since few of them seem to have a shorter memory
#: and less scatter than they have. Of series without a trend one in a hundred then seems to have one, and of those that
#: also have a slow part which a run hardly shows, one in twenty.
UNSETTLED, FEW_SETTLED = 4.0, 10

#: Standard errors of a trend that is left out of a series too short to tell.
DOUBTFUL = 2.0


class Estimate(NamedTuple):
    """Hold a value and its standard error; print it.

    Attributes:
        value: NaN if there is none.
        error: NaN if it is unknown, 0 for what does not fluctuate.
        samples: number of independent samples that the error was found from; infinite if they were not counted. An
            error from fewer than `FEWEST` is too small on average: from 5 samples it is 0.8 of what it should be, from
            2 samples half.
    """

    value: float
    error: float
    samples: float = math.inf

    def __str__(self) -> str:
        """Show two digits of the error, marked by ≥ where it is from few samples, and by ? where it is unknown."""
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
        """Return value and error times a factor, for another unit."""
        return self._replace(value=self.value * factor, error=self.error * abs(factor))


def format_number(value: float, digits: int = 4) -> str:
    """Return a number with so many significant digits, and without an exponent from 1e-4 to 1e7.

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
    2.00 ± 0.58
    """
    return Estimate(float(np.mean(values)), float(np.std(values, ddof=1) / math.sqrt(len(values))))


def pooled(estimates: Sequence[Estimate]) -> Estimate:
    """Return the mean over independent runs, each with the same weight.

    >>> print(pooled([Estimate(1.0, 0.3), Estimate(2.0, 0.4)]))
    1.50 ± 0.25

    The error is from their scatter if there are `ENOUGH_RUNS`, else from their errors.
    """
    values, errors, samples = np.array(estimates, dtype=float).T
    if is_constant(values) and not errors.any():
        return Estimate(float(values.mean()), 0.0)
    if len(values) >= ENOUGH_RUNS:
        return of_independent(values)
    return Estimate(float(values.mean()), float(np.linalg.norm(errors) / len(values)), float(samples.sum()))


def over_runs(values: Sequence[Estimate | float]) -> Estimate | float:
    """Return the mean over runs, with an error from their scatter or, for few runs, from their errors.

    Where few runs have no errors, their scatter is taken all the same, and marked as of few samples.
    """
    if len(values) == 1:
        return values[0]
    estimates = [value if isinstance(value, Estimate) else Estimate(value, math.nan) for value in values]
    found = pooled(estimates)
    if math.isfinite(found.error):
        return found
    return of_independent(np.array([each.value for each in estimates]))._replace(samples=len(values))


def jackknife(estimate: Callable[[np.ndarray], float], n: int, groups: int = GROUPS) -> Estimate:
    """Return an estimate from all of n samples, and its standard error from leaving out groups of them.

    >>> values = np.random.default_rng(1).normal(size=1000)
    >>> variance = jackknife(lambda kept: values[kept].var(), len(values))

    Args:
        estimate: takes the indices of samples and returns a number.
        n: number of samples; each is a group of its own if there are fewer than `groups`.
        groups: how many, of neighbouring samples. In a series each must be longer than the correlation time.
    """
    value, k = estimate(np.arange(n)), min(n, groups)
    if k < 2:
        return Estimate(value, math.nan)
    edges = np.linspace(0, n, k + 1).astype(int)
    left_out = [estimate(np.r_[0:begin, end:n]) for begin, end in pairwise(edges)]
    return Estimate(value, math.sqrt(k - 1) * float(np.std(left_out)))


# --- what has not settled ---


class Settling(NamedTuple):
    """The beginning of the part of a series that fluctuates about one mean.

    Attributes:
        begin: index of its first value; the length of the series if that has a trend to its end.
        samples: number of independent values in it. Fewer than `FEWEST` do not show a trend.
    """

    begin: int
    samples: float


def settled_from(series: np.ndarray) -> int:
    """Return the index from which a series (n,) fluctuates about one mean; 0 if it does so from the start.

    It is where the rest has the most independent values, if the mean of what comes before differs from that of the rest
    by more than chance gives it. A series whose rest still has a trend has not settled: its length is returned.

    Source: Chodera, J. Chem. Theory Comput. 12, 1799 (2016), as `pymbar.timeseries.detect_equilibration` has it.

    >>> series = np.random.default_rng(1).normal(size=1000)
    >>> series[:100] += 20
    >>> bool(settled_from(series) >= 100)
    True
    """
    return settling(series).begin


def settling(series: np.ndarray) -> Settling:
    """Return the part of a series (n,) that fluctuates about one mean, as `settled_from`, and its independent values.

    Where the whole series has enough independent values, a beginning is left out only if its mean differs from that of
    the rest by `UNSETTLED` standard errors. Where no rest has enough, it is left out until no doubtful trend is left,
    but at most half of the series.
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
    """Return whether the mean before an index differs from that of the rest by more than chance gives it."""
    first, rest = values[:begin], values[begin:]
    memory = inefficiency(rest)
    samples = max(1.0, len(rest) / memory)
    error = rms(rest) * math.sqrt(min(1.0, memory / begin) + 1 / samples)
    return _is_significant(abs(first.mean() - rest.mean()), error, samples)


def _trend(values: np.ndarray) -> tuple[float, float, float]:
    """Return how far a straight line through a series rises or falls, its error, and the number of independent values.

    Too few values have no trend.
    """
    if len(values) < FEWEST:
        return 0.0, 0.0, float(len(values))
    places = np.linspace(-0.5, 0.5, len(values))
    line = np.polyval(np.polyfit(places, values, 1), places)
    samples = len(values) / inefficiency(values - line)
    # Of the difference between the ends of a line through so many independent values.
    return abs(line[-1] - line[0]), rms(values - line) * math.sqrt(12 / samples), samples


def _is_significant(difference: float, error: float, samples: float) -> bool:
    return difference > UNSETTLED * error * (1 + FEW_SETTLED / samples)


# --- slopes ---


def block_means(values: np.ndarray, blocks: int) -> np.ndarray:
    """Return the means of equal blocks of a series; a remainder that fills no block is left out at its start."""
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
        blocks: how many. A series with fewer values has a slope but no error, one of two values or fewer has neither.
    """
    if len(x) < 3:
        return Estimate(math.nan, math.nan)
    if len(x) < blocks:
        return Estimate(float(np.polyfit(x - np.mean(x), y, 1)[0]), math.nan)
    means = block_means(x, blocks), block_means(y, blocks)
    (slope, _), covariance = np.polyfit(*means, 1, cov=True)
    return Estimate(float(slope), math.sqrt(covariance[0, 0]))
