"""Energy errors of a run. For the drift see `statistics.slope_and_error`.

Temperatures are in `openmm_sier.system.temperature`, since integrators report them too.
"""

import math

import numpy as np

from openmm_sier.analysis.statistics import rms

#: Length in ps of the blocks whose means show the random walk of the energy, far above the periods of librations and
#: hydrogen bonds, with which the energy oscillates.
BLOCK = 1.0

#: Minimum number of values in a block.
FEWEST = 8


def energy_error(total: np.ndarray, potential: np.ndarray) -> float:
    """Return rms(H)/rms(V), the energy error, with H and V relative to their means over the run.

    Source: van Zon and Schofield (2007), section IV.

    Args:
        total: conserved energy, kJ/mol, (n,).
        potential: potential energy, kJ/mol, (n,).

    Returns:
        The error; NaN for fewer than three values, or if the potential energy is constant.
    """
    return _over_fluctuation(rms(total), potential)


def _over_fluctuation(deviation: float, potential: np.ndarray) -> float:
    spread = rms(potential) if len(potential) > 2 else 0.0
    return deviation / spread if spread > 0 else math.nan


def blocks(time: np.ndarray, values: np.ndarray) -> list[np.ndarray]:
    """Split values into blocks of about `BLOCK`, each of at least `FEWEST` values."""
    number = min(round((time[-1] - time[0]) / BLOCK), len(values) // FEWEST)
    return np.array_split(np.asarray(values, dtype=float), max(1, number))


def energy_walk(time: np.ndarray, total: np.ndarray, potential: np.ndarray) -> float:
    """Return the energy error without its oscillations: the scatter of means of H over 1 ps, divided by rms(V).

    Args:
        time: times, ps, (n,), evenly spaced.
        total: conserved energy, kJ/mol, (n,).
        potential: potential energy, kJ/mol, (n,).

    Returns:
        The error; NaN for fewer than three blocks, or if the potential energy is constant.
    """
    means = np.array([block.mean() for block in blocks(time, total)])
    return _over_fluctuation(rms(means), potential) if len(means) > 2 else math.nan
