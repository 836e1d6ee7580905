"""The law of acceptance against draws of normal energy errors, and what is made of it."""

from __future__ import annotations

import numpy as np
import pytest

from openmm_sier.dynamics.metropolis import expected_acceptance, spread_at
from openmm_sier.measure.acceptance import Spread, largest_box, pooled


@pytest.mark.parametrize("spread", [0.05, 0.7, 3.0])
def test_acceptance_is_that_of_normal_errors(rng, spread):
    """Their mean is half their variance, as <exp(-error)> = 1 asks."""
    errors = rng.normal(0.5 * spread**2, spread, size=200_000)
    # Four standard errors of a mean of numbers between 0 and 1, of standard deviation below 0.5.
    assert expected_acceptance(spread) == pytest.approx(
        np.minimum(1, np.exp(-errors)).mean(), abs=4 * 0.5 / 200_000**0.5
    )


@pytest.mark.parametrize("accepted", [0.1, 0.5, 0.9, 0.999])
def test_spread_is_its_inverse(accepted):
    assert expected_acceptance(spread_at(accepted)) == pytest.approx(accepted, rel=1e-12)


def test_spreads_of_boxes_of_several_sizes_are_pooled(rng):
    sizes, trials, of_one = (100, 400, 1600), (4000, 1000, 250), 0.03
    found = pooled(
        sizes, trials, [rng.normal(0, of_one * n**0.5, k).std(ddof=1) for n, k in zip(sizes, trials, strict=True)]
    )
    assert found.error == pytest.approx(of_one / (2 * 5250) ** 0.5, rel=0.05)
    assert abs(found.value - of_one) < 4 * found.error


def test_half_of_the_trials_are_accepted_in_the_largest_box():
    molecules, error = largest_box(Spread(0.02, 0.001))
    assert expected_acceptance(0.02 * molecules**0.5) == pytest.approx(0.5)
    # A spread that is larger by its error makes the box smaller by about as much as is said.
    assert molecules - largest_box(Spread(0.021, 0.0))[0] == pytest.approx(error, rel=0.1)
