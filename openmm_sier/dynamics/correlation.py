"""Correlation of series, and their statistical inefficiency."""

import math

import numpy as np

#: Independent values below which a series does not show how long it remembers.
FEWEST_INDEPENDENT = 5


def is_constant(values: np.ndarray) -> bool:
    """Return whether values differ only by rounding, like the density of a box of constant volume."""
    return bool(np.ptp(values) <= 1e-13 * np.abs(values).max())


def mean_products(values: np.ndarray, longest: int) -> np.ndarray:
    """Return products of values (n, ...) with those some samples later, summed over components, as means over origins.

    Args:
        values: by time.
        longest: number of samples in between, less than n; the result is (longest + 1,).

    Source: Kneller et al., Comput. Phys. Commun. 91, 191 (1995), by fast Fourier transforms.
    """
    n = len(values)
    transform = np.fft.rfft(values.reshape(n, -1), 2 * n, axis=0)
    sums = np.fft.irfft((np.abs(transform) ** 2).sum(axis=1), 2 * n)[: longest + 1]
    return sums / (n - np.arange(longest + 1))


def inefficiency(values: np.ndarray) -> float:
    """Return the statistical inefficiency of a series (n,): the number of values per independent value; 1 if constant.

    The correlation is summed until it is negative for the first time, as in
    `pymbar.timeseries.statistical_inefficiency`.

    Source: Chodera et al., J. Chem. Theory Comput. 3, 26 (2007).
    """
    if len(values) < 3 or is_constant(values):
        return 1.0
    return _sum_of_correlation(values)[0]


def inefficiency_and_error(values: np.ndarray) -> tuple[float, float]:
    """Return the `inefficiency` of a series (n,) with its standard error, where a series without change is one value.

    Returns:
        (n, NaN) for a constant series, as of moves that are all rejected, and for one with fewer than
        `FEWEST_INDEPENDENT` independent values.

    Source of the error: N. Madras and A. Sokal, J. Stat. Phys. 50, 109 (1988), Eq. 4.19.
    """
    n = len(values)
    if n < 3 or is_constant(values):
        return float(n), math.nan
    value, lags = _sum_of_correlation(values)
    if value * FEWEST_INDEPENDENT > n:
        return float(n), math.nan
    return value, value * math.sqrt(2 * (2 * lags + 1) / n)


def _sum_of_correlation(values: np.ndarray) -> tuple[float, int]:
    """Return 1 plus twice the sum of the correlation of a series that changes, at least 1, and the number of lags."""
    n = len(values)
    products = mean_products(values - np.mean(values), n - 2)
    lags = np.arange(1, n - 1)
    correlation = products[1:] / products[0]
    # Three lags always count: the correlation of oscillating quantities is negative early.
    ends = np.flatnonzero((correlation <= 0) & (lags > 3))
    last = int(ends[0]) if ends.size else len(lags)
    return max(1.0, float(1 + 2 * (correlation * (1 - lags / n))[:last].sum())), last
