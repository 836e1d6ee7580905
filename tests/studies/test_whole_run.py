"""The study of whole runs knows by how much the slope of a walk scatters."""

import numpy as np
import pytest

from studies import whole_run


def test_the_slope_of_a_walk_is_known():
    """Slopes of 400 random walks scatter as one of them says; errors of both are some 5 to 20 %."""
    rng = np.random.default_rng(5)
    walks = rng.normal(scale=0.1, size=(400, 100)).cumsum(axis=1)
    slopes = np.polyfit(np.arange(100), walks.T, 1)[0]
    told = np.sqrt(np.mean([whole_run.walk_slope(walk) ** 2 for walk in walks]))
    assert told == pytest.approx(np.std(slopes), rel=0.2)
    # What oscillates about a mean has no such slope: a fourth of the walk's at the most, by chance.
    assert whole_run.walk_slope(rng.normal(scale=0.1, size=1000)) < 0.25 * told
