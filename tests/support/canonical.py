"""Logs of runs whose distributions are known exactly."""

import numpy as np

from openmm_sier.dynamics.constants import BAR, GAS_CONSTANT

#: K, bar, degrees of freedom of translation and of rotation, and independent samples.
T, P, DOF, ROWS = 300.0, 1000.0, 192, 400


def log(temperature=T, pressure=P, heated=(1.0, 1.0), counted=DOF, narrowed=1.0, seed=1, rows=ROWS):
    """A log of 64 oscillating molecules of an ideal gas.

    Args:
        heated: temperatures of translation and rotation over what they should be.
        counted: degrees of freedom of translation that the log's temperature is made with.
        narrowed: width of the kinetic energies over what it should be.
    """
    rng = np.random.default_rng([seed, int(temperature), int(pressure)])
    heat = GAS_CONSTANT * temperature
    energies = np.array([rng.gamma(DOF / 2, heat * factor, rows) for factor in heated])
    mean = energies.mean(axis=1, keepdims=True)
    translation, rotation = mean + narrowed * (energies - mean)
    return {
        "Time (ps)": np.arange(rows) * 1.0,
        "Kinetic Energy (kJ/mole)": translation + rotation,
        "Translational Temperature (K)": 2 * translation / (counted * GAS_CONSTANT),
        "Rotational Temperature (K)": 2 * rotation / (DOF * GAS_CONSTANT),
        "Flexible Temperature (K)": np.full(rows, np.nan),
        "Potential Energy (kJ/mole)": rng.gamma(DOF / 2, heat, rows),
        "Box Volume (nm^3)": rng.gamma(65, heat / (pressure * BAR), rows),
    }
