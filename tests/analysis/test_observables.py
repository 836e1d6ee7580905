"""Errors of the energy of a run."""

import math

import numpy as np
import pytest

from openmm_sier.analysis.observables import energy_error, energy_walk

TIME = np.arange(0.01, 10.005, 0.01)
POTENTIAL = np.sin(7.0 * TIME)
WAVE = 0.01 * np.cos(40 * np.pi * TIME)
SLOW = np.cos(2 * np.pi * TIME / 10)


def test_what_accumulates_counts():
    """A wave, and what it walks along: squares of independent parts add up, to the rounding of 1000 values' sums."""
    of_both = math.hypot(np.std(WAVE), np.std(SLOW)) / np.std(POTENTIAL)
    assert energy_error(5.0 + SLOW + WAVE, POTENTIAL) == pytest.approx(of_both, rel=1e-6)


def test_walk_is_that_of_means_over_1_ps():
    """The wave has twenty periods in a block; a cosine of ten blocks keeps sin(pi/10)/(pi/10) = 0.984."""
    walk = energy_walk(TIME, SLOW + WAVE, POTENTIAL)
    assert walk == pytest.approx(0.984 * np.std(SLOW) / np.std(POTENTIAL), rel=1e-3)


def test_too_few_rows():
    assert math.isnan(energy_error(WAVE[:2], POTENTIAL[:2]))
    assert math.isnan(energy_error(WAVE, 0 * POTENTIAL))
    assert math.isnan(energy_walk(TIME[:200], WAVE[:200], POTENTIAL[:200]))
