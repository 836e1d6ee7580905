"""Costs of hybrid Monte Carlo, and dihedrals."""

import math

import numpy as np
import pandas as pd
import pytest

from studies.hmc import trials
from studies.observers import dihedral


def test_a_dihedral():
    positions = np.array([[1.0, 0, 0], [0, 0, 0], [0, 0, 1.0], [np.cos(0.7), np.sin(0.7), 1.0]])
    assert dihedral(positions, [0, 1, 2, 3]) == pytest.approx(0.7)


def test_costs_compared_with_those_of_langevin_middle():
    """Two runs of trials, weighted by their times, beside one of the reference; a run that is too short tells none."""
    common = {"box": "b", "at": "constant volume", "hydrogens": "4 Da", "broken": "", "fs_per_second": 100.0}
    of_trials = common | {"method": "SIER2V2 HMC, 9 fs x 8, 1/ps", "accepted": 0.9, "trials": 10}
    short = {"dipole_cost": 50.0, "dipole_cost_error": math.nan}
    runs = [
        common | {"method": trials.REFERENCE, "time": 10.0, "cost": 200.0, "cost_error": 20.0} | short,
        of_trials | {"time": 10.0, "cost": 100.0, "cost_error": 30.0} | short,
        of_trials | {"time": 30.0, "cost": 140.0, "cost_error": 40.0} | short,
    ]
    row = trials.compared(pd.DataFrame(runs)).iloc[1]
    assert row["cost"] == pytest.approx(130)
    # Two forces in 9 fs, and 100 fs in a second.
    assert row["milliseconds"] == pytest.approx(1e3 * 9 / 200)
    assert row["relative"] == pytest.approx(0.65)
    error = math.hypot(math.hypot(0.25 * 30, 0.75 * 40) / 130, 0.1)
    assert row["relative_error"] == pytest.approx(0.65 * error)
    assert row["seconds"] == pytest.approx(130 * 0.045)
    assert math.isnan(row["dipole_cost"])
