"""Means and slopes with their standard errors."""

import math

import numpy as np
import pytest

from openmm_sier.analysis.statistics import (
    FEWEST,
    Estimate,
    jackknife,
    mean_and_error,
    of_independent,
    pooled,
    settled_from,
    slope_and_error,
)
from tests.support.series import correlated

# --- estimates as text ---


def test_estimates_are_written_to_two_digits_of_their_error_and_what_is_not_known_is_not():
    assert str(Estimate(0.123456, 0.00123)) == "0.1235 ± 0.0012"
    assert str(Estimate(1234.5, 17.0)) == "1234 ± 17"
    # Neither thirteen zeros nor thirteen digits.
    assert str(Estimate(-1.234e-9, 2e-11)) == "(-1.234 ± 0.020)e-9"
    assert str(Estimate(2.5, math.nan)) == "2.5 ± ?"
    assert str(Estimate(math.nan, math.nan)) == "-"
    assert str(Estimate(0.998, 0.0)) == "0.998"
    assert str(Estimate(280.17, 0.5, samples=7)) == "280.17 ± ≥0.50"
    assert str(Estimate(280.17, 0.5, samples=FEWEST)) == "280.17 ± 0.50"


# --- means ---


@pytest.mark.parametrize(("n", "kept", "covered"), [(400, 0.8, 0.68), (400, 0.0, 0.68), (40, 0.6, 0.61)])
def test_errors_of_means_cover_the_truth(rng, n, kept, covered):
    """Of 400 series, 68 % of the means lie within one error; 44, 400 and 10 samples are independent.

    The scatter of such a fraction is 2.4 %, and four times that is allowed. A series of 10 independent samples does not
    show its correlation well: 61 % is what 4000 of them gave.
    """
    estimates = [mean_and_error(5 + series) for series in correlated(rng, n, kept, 400).T]
    within = np.mean([abs(estimate.value - 5) < estimate.error for estimate in estimates])
    assert within == pytest.approx(covered, abs=0.1)
    # (1 + kept)/(1 - kept) samples are worth one.
    expected = n * (1 - kept) / (1 + kept)
    assert np.median([estimate.samples for estimate in estimates]) == pytest.approx(expected, rel=0.45)
    # Where few samples are independent, most errors are marked.
    marked = np.mean(["≥" in str(estimate) for estimate in estimates])
    assert marked > 0.6 if expected < FEWEST else marked < 0.1


def test_few_values_have_no_error(rng):
    values = rng.normal(size=FEWEST)
    assert math.isnan(mean_and_error(values[1:]).error)
    assert mean_and_error(values).error == pytest.approx(1 / math.sqrt(FEWEST), rel=0.7)
    assert mean_and_error([5.0])[0] == 5.0
    assert math.isnan(mean_and_error([5.0]).error)
    # A drift throughout the series is no correlation that it could tell.
    assert mean_and_error(np.arange(100.0)).samples < 5


def test_few_runs_are_pooled_by_their_errors():
    assert pooled([Estimate(1, 0.3, 10), Estimate(3, 0.4, 20)]) == (2, 0.25, 30)
    values = [1.0, 2.0, 3.0, 4.0, 5.0]
    many = pooled([Estimate(value, 100) for value in values])
    assert many == (3, pytest.approx(math.sqrt(2.5 / 5)), 5)
    assert str(many) == "3.00 ± ≥0.71"
    assert many == of_independent(values)
    # The density of a volume that is kept has no error, not that of its rounding.
    kept = [mean_and_error(np.full(100, 0.998 * (1 + rounding))) for rounding in (0, 1e-16, 3e-16, -1e-16, 2e-16)]
    assert str(pooled(kept)) == "0.998"


# --- slopes, jackknife ---


def test_slope_and_its_error(rng):
    time = np.arange(1, 2001) * 0.01
    noise = 0.3
    results = np.array([slope_and_error(time, 2 - time / 4 + rng.normal(0, noise, 2000)) for _ in range(200)])
    # Of a straight line with white noise; block means lose 1 % of the information.
    exact = noise / math.sqrt(2000 * np.var(time))
    assert results[:, 0].mean() == pytest.approx(-0.25, abs=4 * exact / math.sqrt(200))
    # The scatter of 200 values has a relative error of 5 %; the estimate from 8 degrees of freedom is low by 3 %.
    assert results[:, 0].std() == pytest.approx(exact, rel=0.2)
    assert results[:, 1].mean() == pytest.approx(exact, rel=0.2)


def test_slope_of_few_values():
    time = np.arange(9.0)
    slope, error, _ = slope_and_error(time, 3 * time)
    assert slope == pytest.approx(3.0)
    assert math.isnan(error)
    assert math.isnan(slope_and_error(time[:2], time[:2])[0])


def test_jackknife_of_a_mean(rng):
    """For the mean it is the textbook's standard error, up to the grouping: 40 groups know it to 11 %."""
    sample = rng.normal(size=4000)
    value, error, _ = jackknife(lambda kept: sample[kept].mean(), 4000)
    assert value == sample.mean()
    assert error == pytest.approx(1 / math.sqrt(4000), rel=0.45)
    assert math.isnan(jackknife(lambda kept: 1.0, 1)[1])
    # Each of a few samples is a group.
    assert jackknife(lambda kept: sample[kept].mean(), 10).error == pytest.approx(of_independent(sample[:10]).error)


def test_jackknife_of_a_correlated_series_covers_the_truth(rng):
    """Variances from 8 groups of 50, correlated over 9: 63 to 68 % of 300 lie within an error, to 2.7 % by chance."""
    estimates = [jackknife(lambda kept, x=x: float(np.var(x[kept])), 400, 8) for x in correlated(rng, 400, 0.8, 300).T]
    assert np.mean([abs(estimate.value - 1) < estimate.error for estimate in estimates]) == pytest.approx(
        0.65, abs=0.11
    )


# --- what has not settled ---


def test_where_a_series_settles_agrees_with_pymbar(rng):
    """Beginnings that are tried are 5 values apart with 490 of them."""
    timeseries = pytest.importorskip("pymbar.timeseries")
    for series in (correlated(rng, 490, 0.7, 10) + 8 * np.exp(-np.arange(490) / 20)[:, None]).T:
        expected, *_ = timeseries.detect_equilibration(series, fast=False, nskip=5)
        assert settled_from(series) == expected
        assert 20 < expected < 245


def test_a_series_without_a_trend_has_settled_from_its_start(rng):
    """One in a hundred may seem not to; of 100 more than 6 do so with a probability of 7e-5."""
    begins = [settled_from(series) for series in correlated(rng, 300, 0.6, 100).T]
    assert np.count_nonzero(begins) <= 6
    assert settled_from(np.full(100, 0.997)) == 0
    assert settled_from(rng.normal(size=FEWEST - 1)) == 0


def test_a_drift_to_the_end_settles_late_if_at_all(rng):
    for series in (correlated(rng, 400, 0.5, 100) + np.linspace(0, 10, 400)[:, None]).T:
        assert settled_from(series) == 400
