"""Exact free rotation: A* = P(h) A and L* = L (van Zon and Schofield 2007, Eq. 5 (U1)).

Rows of A are the principal axes in the lab frame, L~ = A L. The paper writes (Eq. 9 (Pmatrix))

    P(h) = R1(L~*) R2(psi) R1(L~)^T,

where R1 takes a fixed pole, a principal axis, to the direction of L~, and psi is an integral along the path of L~,
ill-behaved where the path comes near the pole. The decomposition holds for any pole. Here the pole is the direction m
of L~ in the middle of the step, R1 is the smallest rotation between two directions, and with u, v those of L~ and L~*

    P(h) = R1(m -> v) R2(m, -theta) R1(u -> m),     theta = Int g dt,    g = omega . (m + v(t)) / (1 + m . v(t)).

So nothing is singular before L~ has turned by half a circle within one step, the axes never have to be exchanged, and
as a quaternion P is rational in u, m, v and the sine and cosine of theta/2: orthogonal to rounding.

tests/support/oracles.py has the paper's own form, which agrees.
"""

from typing import Any, NamedTuple

import numpy as np

from openmm_sier.dynamics.kernels.compilation import called, inlined
from openmm_sier.dynamics.kernels.elliptic import LONGEST, TIMES, WEIGHTS, sn_coefficients, sn_increment
from openmm_sier.dynamics.kernels.formulas import plus

#: Squares of angular momenta outside this range are left to `long_steps`, which rescales them.
LEAST_SQUARE, LARGEST_SQUARE = 1e-240, 1e240


class EulerRates(NamedTuple):
    """Rates of Euler's equations over a step, du/dt = (-alpha y z, beta x z, -gamma x y), and p and q of S."""

    alpha: Any
    beta: Any
    gamma: Any
    p: Any
    q: Any


class MiddleTerms(NamedTuple):
    """Terms of `rate_excess` that depend on the direction m of L~ in the middle of the step; e = 2E/L^2.

    Attributes:
        energy: e.
        squares: (X, Y, Z), those of the components of m.
        excess: ((a - e) X, (b - e) Y, (c - e) Z).
        odd: (alpha, gamma).
        odd_excess: ((a - e) alpha, (c - e) gamma).
        twist: alpha gamma Y, with which G = 1 - twist S^2.
        product: X Y Z.
    """

    energy: Any
    squares: tuple
    excess: tuple
    odd: tuple
    odd_excess: tuple
    twist: Any
    product: Any


@inlined
def free_rotation(body_L, rates, h, sine_cosine, largest_angle):
    """Return P(h) as a quaternion, the even and odd parts of v about the middle, and whether the series suffice.

    Args:
        body_L: L~, three components in the frame where the rates a >= b >= c, the inverse moments, descend.
        rates, h: these rates, and the time.
        sine_cosine, largest_angle: sine and cosine of an angle, and the largest one that it takes.
    """
    x, y, z = body_L
    square = x * x + y * y + z * z
    norm = np.sqrt(square)
    inverse = 1 / norm
    u = x * inverse, y * inverse, z * inverse
    k = norm * h
    motion = euler_rates(rates, u, k)
    p, q = motion.p, motion.q
    coefficients = sn_coefficients(p, q)

    end = sn_increment(coefficients, p, q, TIMES[0])
    even, odd = euler_solution(motion, u, end)
    m = plus(even, odd)
    even, odd = euler_solution(motion, m, end)

    # Eq. 10 (integral). The paper sums derivatives at the ends, to order 2n (Eq. 11 (psiapprox)); the Gauss-Lobatto sum
    # of values here has converged to rounding. Either is even in time.
    middle = middle_terms(rates, motion, m)
    rate = middle.energy + WEIGHTS[0] * rate_excess(middle, end)
    for node in range(1, len(TIMES)):
        rate += WEIGHTS[node] * rate_excess(middle, sn_increment(coefficients, p, q, TIMES[node]))
    half_theta = 0.5 * k * rate

    sine, cosine = sine_cosine(half_theta)
    suffices = (p <= LONGEST) & (q <= LONGEST) & (abs(half_theta) <= largest_angle)
    suffices = (square >= LEAST_SQUARE) & (square <= LARGEST_SQUARE) & suffices
    return propagator(m, even, odd, sine, cosine), (even, odd), suffices


@called
def euler_rates(rates, u, k):
    """Return the rates for a direction u of L~, with k = |L| h and time in steps; p and q sum terms of one sign."""
    a, b, c = rates
    x, y, z = u
    alpha, beta, gamma = k * (b - c), k * (a - c), k * (a - b)
    y2 = y * y
    p = (beta * (x * x) + alpha * y2) * gamma
    q = (gamma * y2 + beta * (z * z)) * alpha
    return EulerRates(alpha, beta, gamma, p, q)


@called
def euler_solution(motion, u, increments):
    """Return the even and odd parts in t of the direction of L~ a time t later, at right angles to each other.

    The free solution of Euler's equations by S, C and D of `sn_increment` for t, which needs no initial phase:
    with G = 1 - alpha gamma y^2 S^2

        x* = (x D - S C alpha y z)/G,   y* = (y C D + S beta x z)/G,   z* = (z C - S D gamma x y)/G.
    """
    alpha, beta, gamma = motion.alpha, motion.beta, motion.gamma
    x, y, z = u
    S, S2, C, D = increments
    f = 1 / (1 - (alpha * gamma) * (y * y * S2))
    fS = f * S
    Cf, Df = C * f, D * f
    even = (x * Df, y * (C * Df), z * Cf)
    odd = (-(alpha * C) * (fS * y * z), (beta * fS) * (x * z), -(gamma * D) * (fS * x * y))
    return even, odd


@called
def middle_terms(rates, motion, m):
    """Return the terms for the direction m of L~ in the middle of the step."""
    a, b, c = rates
    alpha, gamma = motion.alpha, motion.gamma
    X, Y, Z = m[0] * m[0], m[1] * m[1], m[2] * m[2]
    energy = a * X + b * Y + c * Z
    above, below = a - energy, c - energy
    excess = (above * X, (b - energy) * Y, below * Z)
    odd_excess = (above * alpha, below * gamma)
    return MiddleTerms(energy, (X, Y, Z), excess, (alpha, gamma), odd_excess, (alpha * gamma) * Y, X * (Y * Z))


@called
def rate_excess(middle, increments):
    """Return the mean over the times +-t of g/|L| - e, e = 2E/L^2.

    With w = omega/|L| = (a v_x, b v_y, c v_z) the energy is w . v = e, the same at all times, and

        g/|L| - e = w . (m + v) / (1 + m . v) - e = (w . m - e m . v) / (1 + m . v) = N/D,

    N = sum_i (a_i - e) m_i G v_i, D = G + sum_i m_i G v_i, with the common denominator G of `euler_solution`. In those
    sums G v_i has the even parts m_x D, m_y C D, m_z C and the odd ones of `euler_solution`. Since beta = alpha + gamma
    and (b - e) beta = (a - e) alpha + (c - e) gamma, the odd parts of N and D are S x y z times

        N1 = (a - e) alpha (1 - C) + (c - e) gamma (1 - D),   D1 = alpha (1 - C) + gamma (1 - D).

    The mean of (N0 + o N1)/(D0 + o D1) over o = +-S x y z is (N0 D0 - o^2 N1 D1)/(D0^2 - o^2 D1^2).
    """
    X, Y, Z = middle.squares
    aX, bY, cZ = middle.excess
    alpha, gamma = middle.odd
    a_alpha, c_gamma = middle.odd_excess
    _, S2, C, D = increments
    CD = C * D
    numerator = aX * D + bY * CD + cZ * C
    denominator = (1 - middle.twist * S2) + (X * D + Y * CD + Z * C)
    less_C, less_D = 1 - C, 1 - D
    odd = alpha * less_C + gamma * less_D  # of the denominator, over S x y z
    odd_product = S2 * middle.product * odd
    return (numerator * denominator - odd_product * (a_alpha * less_C + c_gamma * less_D)) / (
        denominator * denominator - odd_product * odd
    )


@called
def propagator(m, even, odd, sine, cosine):
    """Return the quaternion of R1(m -> v) R2(m, -theta) R1(u -> m), Eq. 9, with u = even - odd and v = even + odd.

    R1(m -> v) R1(u -> m) is R1(u -> v) after a turn about u by the area of the triangle u m v. Sine and cosine are
    those of theta/2.
    """
    ex, ey, ez = even
    nx, ny, nz = ey * odd[2] - ez * odd[1], ez * odd[0] - ex * odd[2], ex * odd[1] - ey * odd[0]
    ee = ex * ex + ey * ey + ez * ez
    volume = m[0] * nx + m[1] * ny + m[2] * nz
    cosines = m[0] * ex + m[1] * ey + m[2] * ez + ee
    c = cosines * cosine - volume * sine
    s = volume * cosine + cosines * sine
    return ee * c, c * nx - s * ex, c * ny - s * ey, c * nz - s * ez
