"""Energy conservation of a run: its fluctuation, defined once. The drift is `statistics.slope_and_error`.

Temperatures are in `openmm_sier.engines.temperature`, since integrators report them too.
"""

from __future__ import annotations

import math

import numpy as np

from openmm_sier.measure.statistics import rms

#: Length in ps of the windows for the energy's fluctuation, so that it does not depend on the length of the run.
WINDOW = 1.0

#: Fewest values in a window. A straight line through fewer values would take away the fluctuation itself.
LEAST = 8


def number_of_windows(time: np.ndarray) -> int:
    """Number of windows of about `WINDOW` for times (n,) in ps; each window has at least `LEAST` of them."""
    return max(1, min(round((time[-1] - time[0]) / WINDOW), len(time) // LEAST))


def energy_fluctuation(time: np.ndarray, total: np.ndarray) -> float:
    """rms(H) in kJ/mol.

    H is taken about a straight line in each window of `WINDOW`, since what accumulates is the drift. Windows are longer
    where they would have fewer than `LEAST` values. Van Zon and Schofield (2007, section IV) take H about its mean, in
    runs of 1 ps: that is `rms`.

    Args:
        time: ps, (n,).
        total: what is conserved, kJ/mol, (n,).

    Returns:
        NaN for fewer than three values.
    """
    if len(total) < 3:
        return math.nan
    time, total = np.asarray(time, dtype=float), np.asarray(total, dtype=float)
    number = number_of_windows(time)
    rest = []
    for x, y in zip(np.array_split(time, number), np.array_split(total, number), strict=True):
        x = x - x.mean()
        rest.append(y - np.polyval(np.polyfit(x, y, 1), x))
    return rms(np.concatenate(rest))


def energy_error(time: np.ndarray, total: np.ndarray, potential: np.ndarray) -> float:
    """rms(H)/rms(V), the measure of energy conservation; V is taken about its mean over the run.

    Args:
        time: ps, (n,).
        total: what is conserved, kJ/mol, (n,).
        potential: kJ/mol, (n,).

    Returns:
        NaN for fewer than three values, or where the potential energy is constant.
    """
    spread = rms(potential)
    return energy_fluctuation(time, total) / spread if spread > 0 else math.nan
