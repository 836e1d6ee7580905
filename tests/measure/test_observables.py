"""Fluctuation of the energy."""

from __future__ import annotations

import math

import numpy as np
import pytest

from openmm_sier.measure.observables import energy_error, energy_fluctuation

TIME = np.arange(0.01, 10.0, 0.01)
POTENTIAL = np.sin(7.0 * TIME)
WAVE = 0.01 * np.cos(40 * np.pi * TIME)
EXACT = np.std(WAVE) / np.std(POTENTIAL)


@pytest.mark.parametrize("slope", [0.0, -3.0])
def test_energy_error_is_about_the_drift(slope):
    # A line through 100 points takes 1 % of the fluctuation of a wave of twenty periods.
    assert energy_error(TIME, 5.0 + slope * TIME + WAVE, POTENTIAL) == pytest.approx(EXACT, rel=0.01)


def test_energy_error_does_not_grow_with_the_run():
    """Slow against the windows of 1 ps: a line leaves an rms of (pi/10)^2/(12 sqrt(5))/sqrt(2) = 0.0026 of it, which
    beside the wave's 0.0071 makes 7 %."""
    slow = np.cos(2 * np.pi * TIME / 20)
    assert energy_error(TIME, slow + WAVE, POTENTIAL) == pytest.approx(EXACT, rel=0.1)


def test_windows_are_longer_where_samples_are_few():
    """One sample a ps: eight of them in a window, where a line leaves white noise sqrt(1 - 2/8) of its rms."""
    time = np.arange(8000.0)
    noise = np.random.default_rng(3).normal(size=8000)
    # 8000 values know their rms to 1 %.
    assert energy_fluctuation(time, noise - 0.1 * time) == pytest.approx(math.sqrt(0.75), rel=0.04)


def test_too_little_to_say():
    assert math.isnan(energy_error(TIME[:2], WAVE[:2], POTENTIAL[:2]))
    assert math.isnan(energy_error(TIME, WAVE, 0 * POTENTIAL))
