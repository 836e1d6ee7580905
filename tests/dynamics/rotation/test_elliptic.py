"""The elliptic functions and integrals of the free top against mpmath and SciPy."""

import math

import mpmath
import numpy as np
import pytest
from scipy.special import ellipj

from openmm_sier.dynamics.kernels import elliptic


def test_coefficients_are_the_taylor_series():
    """The Maclaurin series of S from its differential equation S'' = -(p + q) S + 2 p q S^3, in rational numbers."""
    for p, q in ((1, 0), (1, 1), (3, 2), (5, 1)):
        with mpmath.workdps(30):
            series = [mpmath.mpf(0), mpmath.mpf(1)]
            for n in range(12):
                cube = sum(series[i] * series[j] * series[n - i - j] for i in range(n + 1) for j in range(n - i + 1))
                series.append((-(p + q) * series[n] + 2 * p * q * cube) / ((n + 1) * (n + 2)))
        coefficients = elliptic.sn_coefficients(float(p), float(q))
        assert len(coefficients) == 6
        for coefficient, expected in zip(coefficients, series[3::2], strict=True):
            assert coefficient == pytest.approx(float(expected), rel=1e-14)


def test_increments_match_scipy(rng):
    """All of S, C and D below the limit, with their signs, for either order of p and q, and backwards in time."""
    n = 2_000
    p = 10 ** rng.uniform(-12, 0, n)
    q = p * rng.uniform(0, 1, n)
    t = np.sqrt(elliptic.SERIES_LIMIT / p) * rng.uniform(-1, 1, n)
    sn, cn, dn, _ = ellipj(np.sqrt(p) * t, q / p)
    for larger, smaller, expected in ((p, q, (cn, dn)), (q, p, (dn, cn))):
        rows = zip(larger, smaller, t, strict=True)
        increments = [elliptic.sn_increment(elliptic.sn_coefficients(a, b), a, b, time) for a, b, time in rows]
        S, S2, C, D = np.transpose(increments)
        # One rounding of each of the factors and of SciPy's result.
        assert np.abs(S * np.sqrt(p) - sn).max() < 4e-16
        assert np.array_equal(S2, S * S)
        assert np.abs(C - expected[0]).max() < 4e-16
        assert np.abs(D - expected[1]).max() < 4e-16


@pytest.mark.parametrize("nu", [1e-4, 0.2, 0.999, 1.0, 1.001, 3.0, 1e4])
@pytest.mark.parametrize("kc", [1e-150, 1e-30, 1e-6, 0.05, 0.7, 1 - 1e-9, 1.0])
def test_mean_turn_in_a_period(kc, nu):
    """1 - (nu - 1)/(2 nu) Q is the complete integral of the third kind over that of the first, by mpmath."""
    K, Q = elliptic.complete_integrals(kc, nu)
    # mpmath's own algorithm loses as many digits as 1 - m = kc^2 and 1 - nu have zeros.
    with mpmath.workdps(40 - 2 * math.floor(math.log10(kc))):
        m = 1 - mpmath.mpf(kc) ** 2
        expected = mpmath.ellippi(1 - mpmath.mpf(nu), m) / mpmath.ellipk(m)
        assert abs(mpmath.mpf(K) / mpmath.ellipk(m) - 1) < 1e-15
    result = 1 - (nu - 1) / (2 * nu) * Q
    # 1/nu bounds the integrand, so that its rounding is the scale of the cancellation.
    assert abs(result - float(expected)) < 1e-15 * max(1, 1 / nu)
