"""Errors of the energy of a run."""

import math

import numpy as np
import pytest

from openmm_sier.analysis.observables import energy_error, energy_error_within_1_ps, energy_walk

TIME = np.arange(0.01, 10.005, 0.01)
POTENTIAL = np.sin(7.0 * TIME)
WAVE = 0.01 * np.cos(40 * np.pi * TIME)
SLOW = np.cos(2 * np.pi * TIME / 10)


def test_what_accumulates_counts():
    """A wave, and what it walks along: squares of independent parts add up, to the rounding of 1000 values' sums."""
    of_both = math.hypot(np.std(WAVE), np.std(SLOW)) / np.std(POTENTIAL)
    assert energy_error(5.0 + SLOW + WAVE, POTENTIAL) == pytest.approx(of_both, rel=1e-6)


@pytest.mark.parametrize("slope", [0.0, -3.0])
def test_within_1_ps_it_does_not(slope):
    """A line through 100 points takes 1 % of the fluctuation of a wave of twenty periods. The slow cosine's curvature
    leaves an rms of (pi/5)^2/(12 sqrt(5))/sqrt(2) = 0.0104 of it."""
    expected = math.hypot(np.std(WAVE), 0.0104) / np.std(POTENTIAL)
    assert energy_error_within_1_ps(TIME, slope * TIME + SLOW + WAVE, POTENTIAL) == pytest.approx(expected, rel=0.02)


def test_walk_is_that_of_means_over_1_ps():
    """The wave has twenty periods in a block; a cosine of ten blocks keeps sin(pi/10)/(pi/10) = 0.984."""
    walk = energy_walk(TIME, SLOW + WAVE, POTENTIAL)
    assert walk == pytest.approx(0.984 * np.std(SLOW) / np.std(POTENTIAL), rel=1e-3)


def test_blocks_are_longer_where_samples_are_few():
    """One sample a ps: eight of them in a block, where a line leaves white noise sqrt(1 - 2/8) of its rms."""
    time = np.arange(8000.0)
    noise = np.random.default_rng(3).normal(size=8000)
    # 8000 values know their rms to 1 %.
    assert energy_error_within_1_ps(time, noise - 0.1 * time, noise) == pytest.approx(math.sqrt(0.75), rel=0.04)


def test_too_few_rows():
    assert math.isnan(energy_error(WAVE[:2], POTENTIAL[:2]))
    assert math.isnan(energy_error(WAVE, 0 * POTENTIAL))
    assert math.isnan(energy_walk(TIME[:200], WAVE[:200], POTENTIAL[:200]))
    assert math.isnan(energy_error_within_1_ps(TIME[:2], WAVE[:2], POTENTIAL[:2]))
