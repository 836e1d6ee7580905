"""Kinetic energies of trials: canonical, and opposite to the one before."""

import numpy as np
import pytest
from scipy import stats

from openmm_sier.dynamics.acceptance import over_relaxed
from openmm_sier.dynamics.noise import generator

DRAWS = 4000


@pytest.mark.parametrize("freedoms", [0.5, 1, 3, 384])
def test_over_relaxed_energies_are_canonical_and_opposite(freedoms):
    """From canonical energies, new ones are canonical; a right function fails with a probability of 1e-9.

    16 uniform numbers have E(U_i U_j) = i (j + 1)/(17 18), i < j, and so those of mirrored ranks a correlation of
    -14/17.
    """
    olds = np.random.default_rng(1).chisquare(freedoms, DRAWS)
    results = np.array([over_relaxed(old, freedoms, generator(2, draw)) for draw, old in enumerate(olds)])
    assert stats.kstest(results, stats.chi2(freedoms).cdf).pvalue > 1e-9
    correlation = stats.spearmanr(olds, results).statistic
    # Four standard errors, (1 - r^2)/sqrt(n) each.
    assert correlation == pytest.approx(-14 / 17, abs=4 * (1 - (14 / 17) ** 2) / DRAWS**0.5)


@pytest.mark.parametrize(("old", "is_above"), [(0.0, True), (1e9, False)])
def test_after_no_or_enormous_motion_comes_a_usual_one(old, is_above):
    """The largest or least of 15 draws of 384 degrees of freedom, whose deviation is 28."""
    new = over_relaxed(old, 384, generator(3, 0))
    assert 384 - 5 * 28 < new < 384 + 5 * 28
    assert (new > 384) is is_above
