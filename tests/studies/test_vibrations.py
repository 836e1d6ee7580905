"""Frequencies of the study of vibrations, of motions whose frequency is known."""

import math

import numpy as np
import pandas as pd
import pytest

from studies import vibrations


def sampled(number, columns=2):
    """A motion of one frequency in 1/cm, with other phases in each column, (samples, columns)."""
    times = vibrations.INTERVAL * np.arange(2 * vibrations.WINDOW)[:, None]
    phases = np.arange(columns)
    return np.cos(2 * math.pi * vibrations.LIGHT * number * times + phases)


@pytest.mark.parametrize("number", [1600.0, 1687.3, 1800.0])
def test_a_single_vibration_has_its_frequency(number):
    """The window spreads a line over some bins of 16/cm on both sides alike, so that their mean is the line.

    The power of velocities has a factor of the frequency squared, which moves the mean by the variance of the window's
    line, a third of a bin's square or some 100/cm², times 2/number: 0.1/cm.
    """
    assert vibrations.frequency(sampled(number), vibrations.BANDS["carbonyl"]) == pytest.approx(number, abs=0.5)


def test_what_is_outside_of_the_band_does_not_count():
    """A line far away leaks through the window by its sixth power, 10⁻⁹ of the power at 60 bins."""
    motion = sampled(1700.0) + sampled(700.0)
    alone = vibrations.frequency(sampled(1700.0), vibrations.BANDS["carbonyl"])
    assert vibrations.frequency(motion, vibrations.BANDS["carbonyl"]) == pytest.approx(alone, abs=0.1)


@pytest.mark.parametrize("step", [0.5, 2.0, 4.0])
def test_a_leapfrog_is_as_much_too_fast_as_it_is_said_to_be(step):
    """x(t + h) = (2 - ω²h²) x(t) - x(t - h), whose solution is a cosine of the frequency asked for, to rounding."""
    number = 1700.0
    omega = 2 * math.pi * vibrations.LIGHT * number
    shifted = 2 * math.pi * vibrations.LIGHT * (number + vibrations.leapfrog(number, step))
    x = np.cos(shifted * step * np.arange(3))
    assert x[2] == pytest.approx((2 - (omega * step) ** 2) * x[1] - x[0], abs=1e-12)


def test_frequencies_are_compared_within_a_start_with_what_the_first_method_would_have_without_error():
    runs = pd.DataFrame(
        [
            {"method": method, "step": step, "seed": seed, "carbonyl": 1700.0 + seed + off, "libration": 550.0}
            for method, step, off in (("OpenMM Verlet", 1.0, 0.0), ("SIER4G", 4.0, -1.0))
            for seed in (1, 2, 3)
        ]
    ).assign(percent=0.1, seconds=1.0, broken="")
    rows = vibrations.made(vibrations.VibrationSettings(), runs)[0]["rows"].set_index("method")
    own_error = vibrations.leapfrog(1702.0, 1.0)
    assert rows.loc["SIER4G", "carbonyl_off"] == pytest.approx(own_error - 1, abs=0.01)
    assert rows.loc["OpenMM Verlet", "carbonyl_off"] == pytest.approx(own_error, abs=0.01)
    assert rows.loc["OpenMM Verlet", "carbonyl_expected"] == pytest.approx(own_error, abs=0.01)
    assert rows.loc["SIER4G", "carbonyl_off_error"] < 0.01
