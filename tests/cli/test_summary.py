"""The table at the end of a run."""

import numpy as np

from openmm_sier.cli import summary
from openmm_sier.observe.conservation import COLUMNS


def names(**more):
    """First column of the table for a log of zeros, with more columns."""
    log = dict.fromkeys(COLUMNS, np.zeros(30)) | more
    log["Time (ps)"] = 0.1 * np.arange(30)
    return [name for name, _ in summary.rows(log, moves_volume=False)]


def test_momenta_that_are_drawn_anew_are_not_shown_as_conserved():
    assert "total momentum, first and last" in names()
    trials = {"Acceptance": np.ones(30), "Energy Error (kT)": np.zeros(30)}
    assert "total momentum, first and last" not in names(**trials)
    assert names(**trials)[-2:] == ["trials accepted", "their energy errors"]
