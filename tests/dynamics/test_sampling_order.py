"""Schemes with a heat bath: the exact stationary distribution of a harmonic oscillator, and the order claimed."""

import math
from itertools import pairwise

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov

from openmm_sier.dynamics.schemes import CATALOGUE, SIER2, Scheme
from openmm_sier.dynamics.stages import BATH, KICK, Stage
from tests.laws.linear_maps import stage_map

#: The frequency of 585/cm, that of a hard libration of water, and a friction, both in 1/ps.
OMEGA = 2 * math.pi * 585 * 0.0299792458
FRICTION = 20.0


def errors(scheme: Scheme, h: float) -> tuple[float, float]:
    """Relative errors of <q^2> and <p^2> at whole steps, exactly, from the discrete Lyapunov equation."""
    total, noise = np.eye(2), np.zeros((2, 2))
    for stage in scheme.stages:
        one, added = stage_map(stage, OMEGA * h), np.zeros((2, 2))
        if stage.operator == BATH:
            damping = math.exp(-FRICTION * stage.fraction * h)
            one, added = np.diag([1, damping]), np.diag([0, 1 - damping**2])
        total, noise = one @ total, one @ noise @ one.T + added
    covariance = solve_discrete_lyapunov(total, noise)
    return covariance[0, 0] - 1, covariance[1, 1] - 1


def largest(scheme: Scheme, fs_per_force: float) -> float:
    plain = scheme.without_bath()
    return max(map(abs, errors(scheme, 1e-3 * fs_per_force * plain.force_evaluations)))


@pytest.mark.parametrize(
    "scheme", [scheme for scheme in CATALOGUE.values() if scheme is not SIER2], ids=lambda scheme: scheme.name
)
def test_averages_keep_the_order_of_the_scheme(scheme):
    """The slope at three steps is the order of the scheme; SIER2 has no error at all, see below."""
    bathed = scheme.with_bath()
    errors = [largest(bathed, dt) for dt in (0.5, 0.25, 0.125)]
    slopes = [math.log2(a / b) for a, b in pairwise(errors)]
    # The next term of the error is (w h)^2 times some units beside the first one: w h is 0.08 at the last step of six
    # forces, which moves the slope by some hundredths, and at the first one it is four times as large.
    assert slopes[1] == pytest.approx(scheme.order, abs=0.2)
    assert slopes[0] == pytest.approx(scheme.order, abs=0.6)


def test_sier2_with_a_bath_is_exact():
    """With the bath in the middle of the drift, at whose end the step ends, <q^2> and <p^2> have no error."""
    for fs in (1, 2, 10):
        # Rounding of a covariance that takes some hundred steps to be forgotten.
        assert np.abs(errors(CATALOGUE["sier2"].with_bath(), 1e-3 * fs)).max() < 1e-10
    # Had it a kick at either end, momenta would be too cold by (w h)^2/4.
    ends = Scheme("ends", (*SIER2.without_bath().stages[:1], *SIER2.with_bath().stages[1:], Stage(KICK, 0.5)))
    q, p = errors(ends, 2e-3)
    assert abs(q) < 1e-10
    assert p == pytest.approx(-((2e-3 * OMEGA) ** 2) / 4, rel=1e-6)


@pytest.mark.parametrize("scheme", CATALOGUE.values(), ids=CATALOGUE)
def test_a_bath_can_be_taken_out_again(scheme):
    assert scheme.with_bath().without_bath() == scheme


def test_momenta_lag_half_a_kick_behind_with_a_bath_in_the_drift():
    assert SIER2.with_bath().momentum_lag == 0.5
    assert all(scheme.with_bath().momentum_lag == 0 for scheme in CATALOGUE.values() if scheme is not SIER2)
    assert all(scheme.momentum_lag == 0 for scheme in CATALOGUE.values())


def test_a_scheme_with_a_bath_gets_no_other():
    bathed = CATALOGUE["sier4"].with_bath()
    assert bathed.with_bath() is bathed
