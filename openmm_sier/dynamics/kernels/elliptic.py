"""Elliptic functions and integrals of the free top, and the quadrature that goes with their series."""

import math

import numpy as np

from openmm_sier.dynamics.kernels.compilation import called, inlined

#: Largest max(p, q) t^2 at which the series of `sn_increment` is exact to rounding. The first omitted term is largest
#: where p = q (a hyperbolic tangent), 0.0015 (p t^2)^7 of the result, here 1.5e-17.
SERIES_LIMIT = 0.01


@inlined
def sn_coefficients(p, q):
    """Return coefficients of t^3, t^5, ..., t^13 in the odd function S with S'^2 = (1 - p S^2)(1 - q S^2), S'(0) = 1.

    S(t) = sn(sqrt(p) t | q/p) / sqrt(p) is symmetric in p and q, so that its coefficients are polynomials in
    their sum and product; they follow from S'' = -(p + q) S + 2 p q S^3.
    """
    s = p + q
    r = p * q
    s2 = s * s
    return (
        s * (-1 / 6),
        (s2 + 12 * r) * (1 / 120),
        s * (s2 + 132 * r) * (-1 / 5040),
        (s2 * (s2 + 1224 * r) + 3024 * r * r) * (1 / 362880),
        s * (s2 + 12 * r) * (s2 + 11052 * r) * (-1 / 39916800),
        (s2 * (s2 * (s2 + 99636 * r) + 4095792 * r * r) + 4390848 * r * r * r) * (1 / 6227020800),
    )


@inlined
def sn_increment(coefficients, p, q, t):
    """Return S(t), S^2, C = sqrt(1 - p S^2) and D = sqrt(1 - q S^2).

    Args:
        coefficients: of `sn_coefficients`.
        p, q: nonnegative squared rates.
        t: time, with max(p, q) t^2 at most `SERIES_LIMIT`.
    """
    u = t * t
    total = coefficients[-1]
    for coefficient in coefficients[-2::-1]:
        total = coefficient + u * total
    S = t * (1 + u * total)
    S2 = S * S
    return S, S2, np.sqrt(1 - p * S2), np.sqrt(1 - q * S2)


#: Largest max(p, q) over a step for which the series reach from its middle to its ends, and a Gauss-Lobatto quadrature
#: with a truncation error below 1e-17 of a turn there, as times from the middle, in steps, the end first, and as
#: weights. The node in the middle is left out, since the deviation of the integrand from its leading term vanishes
#: there.
LONGEST = 4 * SERIES_LIMIT
TIMES = (
    0.5,
    0.5 * math.sqrt(5 / 11 - 2 / 11 * math.sqrt(5 / 3)),
    0.5 * math.sqrt(5 / 11 + 2 / 11 * math.sqrt(5 / 3)),
)
WEIGHTS = (1 / 21, (124 + 7 * math.sqrt(15)) / 350, (124 - 7 * math.sqrt(15)) / 350)


@called
def complete_integrals(kc, nu):
    """Return the complete elliptic integrals that fix the period of a free top and its turn in one period.

    Both come from one arithmetic-geometric mean (DLMF 19.8.5 and 19.8.7, valid for every nu > 0).

    Args:
        kc: complementary modulus in (0, 1].
        nu: one minus the characteristic of the third-kind integral, positive.

    Returns:
        (K, Q): K is the complete integral of the first kind, and the mean over a quarter period of
        1/(cn^2 + nu sn^2) is 1 - (nu - 1)/(2 nu) Q.
    """
    a, g, p = 1.0, kc, math.sqrt(nu)
    term = 1.0
    total = 1.0
    # Quadratic convergence: a modulus of 1e-154 (its square is the smallest double) takes 15 passes.
    for _ in range(24):
        ag = a * g
        ratio = (p * p - ag) / (p * p + ag)
        p = (p * p + ag) / (2 * p)
        term = 0.5 * term * ratio
        total = total + term
        a, g = 0.5 * (a + g), math.sqrt(ag)
    return (math.pi / 2) / a, total
