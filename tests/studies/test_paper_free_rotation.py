"""The experiment on free rotation in miniature, and its reference of high precision."""

import math
from dataclasses import replace

import mpmath
import numpy as np
import pytest

from studies.paper import free_rotation, reference, tip4p
from studies.paper.free_rotation import FreeRotationSettings
from tests.support.oracles import rotation_by_dop853

WATER = tip4p.molecules(1).species[0].moments


def matrix(m):
    return np.array(m.tolist(), dtype=float)


def states(rng, n):
    return rng.normal(size=(3, n)) * np.sqrt(2.5 * WATER)[:, None]


def test_reference_solves_the_equations_of_motion(rng):
    """Against DOP853 at its tolerance, for states on both sides of 2 E Iy = L^2 and every sign of L~_x."""
    L = states(rng, 8)
    sides = (L**2 / WATER[:, None]).sum(axis=0) * WATER[1] > (L**2).sum(axis=0)
    assert 0 < sides.sum() < 8
    for i in range(8):
        found = matrix(reference.attitude(L[:, i], WATER, 0.5))
        assert np.abs(found - rotation_by_dop853(np.eye(3), L[:, i], WATER, 0.5)).max() < 1e-11


def test_reference_has_the_digits_it_claims(rng):
    """Over 100 ps the phase is some 5e3, so that 34 digits leave 30; double precision would leave 12."""
    for L in states(rng, 3).T:
        with mpmath.workdps(reference.DIGITS):
            found = reference.attitude(L, WATER, 100)
        with mpmath.workdps(60):
            finer = reference.attitude(L, WATER, 100)
            assert mpmath.mnorm(found - finer) < mpmath.mpf(10) ** -28
            assert mpmath.mnorm(finer.T * finer - mpmath.eye(3)) < mpmath.mpf(10) ** -50


def test_squared_deviations(rng):
    """Tr[(A - A_ex)(A - A_ex)^T]/6 for a known deviation, and with digits that a double reference would not have."""
    L = states(rng, 2)
    A = np.stack([matrix(reference.attitude(L[:, i], WATER, 0.25)) for i in range(2)], axis=2)
    rounded = reference.squared_deviations(A, L, WATER, 0.25 / 8, 8)
    assert (rounded < 1e-32).all()
    assert (rounded > 0).all()
    A[0, 0] += 1e-9
    # The deviation of 1e-9 is rounded to 1e-16.
    assert reference.squared_deviations(A, L, WATER, 0.25 / 8, 8) == pytest.approx(1e-18 / 6, rel=1e-6)


def test_result_of_a_known_law():
    """delta = t/(10 tau) gives tau, the exponent 1 and the same by the power law; past 10 % nothing counts."""
    times = np.array([0.1, 1.0, 3.0, 10.0, 30.0])

    def summarize(squares):
        return free_rotation.summarize(times, np.sqrt(squares.mean(axis=1)), squares)

    squares = (times[:, None] / (10 * 20.0) * np.ones(50)) ** 2
    squares[-1] = 0.5
    found = summarize(squares)
    assert [found[name] for name in ("tau", "tau_power", "tau_median")] == pytest.approx([20] * 3)
    assert found["exponent"] == pytest.approx(1)
    assert found["tau_error"] == pytest.approx(0, abs=1e-9)
    found = summarize((1e-6 * times[:, None] ** 1.5 * np.ones(50)) ** 2)
    assert found["exponent"] == pytest.approx(1.5)
    assert found["tau_power"] == pytest.approx(1e5 ** (2 / 3))
    assert found["tau"] == pytest.approx(30 / (10 * 1e-6 * 30**1.5))


def test_initial_states_are_canonical():
    """<L~_k^2> = I_k k T within four standard errors of 4000 bodies, and the axes lie along the lab's."""
    bodies, start = free_rotation._start(4000, replace(FreeRotationSettings(), seed=3))
    scaled = (start.L**2).mean(axis=1) / (bodies.moments[:, 0] * 8.31446e-3 * 297)
    assert np.abs(scaled - 1).max() < 4 * math.sqrt(2 / 4000)
    assert np.array_equal(start.A, np.repeat(np.eye(3)[:, :, None], 4000, axis=2))
