"""Means, slopes and medians with their standard errors."""

from __future__ import annotations

import math

import numpy as np
import pytest

from openmm_sier.measure.statistics import jackknife, mean_and_error, median_and_error, rms, slope_and_error


def correlated(rng, n, c):
    """An autoregressive series of variance 1."""
    values = np.zeros(n)
    for i in range(1, n):
        values[i] = c * values[i - 1] + math.sqrt(1 - c * c) * rng.normal()
    return values


def test_mean_and_error_of_correlated_samples():
    """The mean of n samples with correlation c has the error sqrt((1 + c)/(1 - c)/n)."""
    n, c = 20000, 0.9
    mean, error = mean_and_error(correlated(np.random.default_rng(5), n, c))
    expected = math.sqrt((1 + c) / (1 - c) / n)
    # 20 blocks know their scatter to 16 %; three times that.
    assert error == pytest.approx(expected, rel=0.5)
    assert abs(mean) < 4 * expected


def test_short_series_have_fewer_blocks():
    # Two blocks with the means 2 and 6.
    assert mean_and_error([1.0, 3.0, 5.0, 7.0]) == pytest.approx((4.0, 2.0))
    mean, error = mean_and_error([1.0, 2.0, 3.0])
    assert mean == 2.0
    assert math.isnan(error)
    assert mean_and_error([5.0])[0] == 5.0


def test_a_remainder_is_left_out_at_the_start():
    assert mean_and_error([100.0, *np.ones(40)]) == (1.0, 0.0)


def test_slope_and_its_error(rng):
    time = np.arange(1, 2001) * 0.01
    noise = 0.3
    found = np.array([slope_and_error(time, 2 - time / 4 + rng.normal(0, noise, 2000)) for _ in range(200)])
    # Of a straight line with white noise; block means lose 1 % of the information.
    exact = noise / math.sqrt(2000 * np.var(time))
    assert found[:, 0].mean() == pytest.approx(-0.25, abs=4 * exact / math.sqrt(200))
    # The scatter of 200 values has a relative error of 5 %; the estimate from 8 degrees of freedom is low by 3 %.
    assert found[:, 0].std() == pytest.approx(exact, rel=0.2)
    assert found[:, 1].mean() == pytest.approx(exact, rel=0.2)


def test_slope_of_few_values():
    time = np.arange(9.0)
    slope, error = slope_and_error(time, 3 * time)
    assert slope == pytest.approx(3.0)
    assert math.isnan(error)
    assert math.isnan(slope_and_error(time[:2], time[:2])[0])


def test_median_comes_with_its_standard_error(rng):
    """Of 4000 medians of 50 normal numbers the scatter is known to 1 %; the stated errors' mean is 4 % below it."""
    found = np.array([median_and_error(values) for values in rng.normal(3.0, 0.1, (4000, 50))])
    assert math.isnan(median_and_error(np.array([1.0]))[1])
    assert found[:, 0].mean() == pytest.approx(3.0, abs=0.001)
    assert found[:, 1].mean() == pytest.approx(found[:, 0].std(), rel=0.1)


def test_jackknife_of_a_mean(rng):
    """For the mean it is the textbook's standard error, up to the grouping: 40 groups know it to 11 %."""
    sample = rng.normal(size=4000)
    value, error = jackknife(lambda kept: sample[kept].mean(), 4000)
    assert value == sample.mean()
    assert error == pytest.approx(1 / math.sqrt(4000), rel=0.45)
    assert math.isnan(jackknife(lambda kept: 1.0, 1)[1])


def test_rms_is_about_the_mean():
    assert rms([9.0, 11.0]) == 1.0
