"""How many values of a series are worth an independent one: one rule for means and for the tuning."""

import math

import numpy as np
import pytest

from openmm_sier.dynamics.correlation import inefficiency, inefficiency_and_error
from tests.support.series import correlated


@pytest.mark.parametrize("kept", [0.0, 0.5, 0.95])
def test_inefficiency_is_that_of_pymbar(rng, kept):
    theirs = pytest.importorskip("pymbar.timeseries").statistical_inefficiency
    for n in (3, 4, 20, 101, 1000):
        series = 300 + correlated(rng, n, kept)
        # Rounding of the transforms.
        assert inefficiency(series) == pytest.approx(theirs(series), rel=1e-9)
    assert inefficiency(np.full(100, 2.5)) == 1


@pytest.mark.parametrize("kept", [0.0, 0.5, 0.9])
def test_the_error_is_the_scatter_between_series_of_known_memory(rng, kept):
    """x' = a x + noise has (1 + a)/(1 - a) values in an independent one."""
    results = [inefficiency_and_error(correlated(rng, 2000, kept)) for _ in range(30)]
    values, errors = np.transpose(results)
    # The sum ends where noise makes the correlation negative, and values below 1 count as 1: 6 % above the truth
    # without memory, 5 % with the longest. The mean of 30 is known to 5 % with that one.
    assert values.mean() == pytest.approx((1 + kept) / (1 - kept), rel=0.15)
    # The scatter of 30 values is known to 13 %; the formula was 8 % above that of 300 series with the longest memory.
    if kept:
        assert values.std(ddof=1) == pytest.approx(errors.mean(), rel=0.5)


def test_what_does_not_change_is_one_value_with_an_unknown_error():
    for constant in (np.ones(12), np.full(12, -1234.567), np.ones(2)):
        value, error = inefficiency_and_error(constant)
        assert (value, math.isnan(error)) == (len(constant), True)


def test_a_trend_has_no_correlation_time():
    value, error = inefficiency_and_error(np.arange(40.0))
    assert (value, math.isnan(error)) == (40, True)
