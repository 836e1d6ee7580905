"""The study of whole runs: its runs are kept, its law is found again, and pages say what its record says."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from openmm_sier import SIER4G
from studies import records, whole_run

ROOT = Path(__file__).parents[2]
DATA = ROOT / "studies" / "data"


# --- what pages say -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def record():
    return records.read(DATA / "whole-run.json")


@pytest.mark.parametrize("page", ["README.md", "docs/measurements/trust.md", "paper/paper.md"])
def test_pages_claim_the_gains_of_the_record(record, page):
    """The gains that a page claims are the least and the largest of the large boxes, over 100 ps, rounded down."""
    gains = record.tables["gains"]
    usual = 1e3 * SIER4G.constant_energy_step
    large = gains[(gains["time"] == 100) & (gains["step"] == usual) & (gains["molecules"] != 64)]["gain"]
    claimed = re.findall(r"(\d+) to (\d+) times smaller", (ROOT / page).read_text())
    assert claimed
    for least, most in claimed:
        assert (int(least), int(most)) == (int(large.min()), int(large.max()))


def test_the_slope_of_a_walk_is_known():
    """Slopes of 400 random walks scatter as one of them says; errors of both are some 5 to 20 %."""
    rng = np.random.default_rng(5)
    walks = rng.normal(scale=0.1, size=(400, 100)).cumsum(axis=1)
    slopes = np.polyfit(np.arange(100), walks.T, 1)[0]
    told = np.sqrt(np.mean([whole_run.walk_slope(walk) ** 2 for walk in walks]))
    assert told == pytest.approx(np.std(slopes), rel=0.2)
    # What oscillates about a mean has no such slope: a fourth of the walk's at the most, by chance.
    assert whole_run.walk_slope(rng.normal(scale=0.1, size=1000)) < 0.25 * told
