"""Free rotation over steps too long for the series, and of angular momenta whose squares no double can hold."""

import math

import numpy as np

from openmm_sier.dynamics.kernels.compilation import called, inlined
from openmm_sier.dynamics.kernels.elliptic import LONGEST, complete_integrals
from openmm_sier.dynamics.kernels.formulas import plus
from openmm_sier.dynamics.kernels.short_steps import euler_rates, free_rotation

#: Largest number of sub-steps. If passages of the separatrix's saddle are further apart, doubles cannot resolve the
#: motion.
MOST_SUBSTEPS = 8192

#: Largest phase or angle. Above it they have no meaning in double precision.
PHASE_CAP = 1e100


@called
def long_rotation(body_L, rates, h):
    """Return the quaternion of the body frame's free rotation over any time.

    Whole periods of L~ are turns about L. The rest is divided into sub-steps, which compose exactly.

    Args:
        body_L: L~, three components in the frame of descending rates.
        rates: inverse moments.
        h: time.
    """
    u, k = direction(body_L, h)
    cap = PHASE_CAP / max(rates[0], 1e-200)
    k = min(max(k, -cap), cap)
    motion = euler_rates(rates, u, k)
    phase = math.sqrt(max(motion.p, motion.q))
    rest, whole_turn = 1.0, 0.0
    # No period of L~ is shorter than 2 pi in phase.
    if phase > 3:
        rest, whole_turn = whole_periods(rates, u, k)
    rotation = about(u, whole_turn)

    needed = max(np.ceil(phase * abs(rest) / math.sqrt(LONGEST)), 1.0)
    short = min(needed, MOST_SUBSTEPS) / needed
    count = int(min(needed, MOST_SUBSTEPS))
    k_substep = k * (rest * short) / count
    for _ in range(count):
        substep, even_odd, _ = free_rotation(u, rates, k_substep, sine_cosine, PHASE_CAP)
        rotation = normalized(product(substep, rotation))
        u = unit(plus(even_odd[0], even_odd[1]))
    # Time is left over only for a state that is on the separatrix to its last bit. The state does not determine when it
    # leaves the saddle, the middle axis, so it stays there.
    return product(about(u, k * (rest * (1 - short)) * rates[1]), rotation)


@inlined
def sine_cosine(x):
    """Return sine and cosine of any angle."""
    return math.sin(x), math.cos(x)


@called
def direction(body_L, h):
    """Return the direction of L~ and |L| h, also where the square of L~ overflows; a body at rest has any direction."""
    scale = max(abs(body_L[0]), abs(body_L[1]), abs(body_L[2]))
    if scale == 0:
        return (1.0, 0.0, 0.0), 0.0
    scaled = body_L[0] / scale, body_L[1] / scale, body_L[2] / scale
    u = unit(scaled)
    norm = scaled[0] * u[0] + scaled[1] * u[1] + scaled[2] * u[2]
    return u, min(max(norm * (scale * h), -1e300), 1e300)


@inlined
def unit(v):
    """Return the direction of a vector."""
    norm = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    return v[0] / norm, v[1] / norm, v[2] / norm


@called
def whole_periods(rates, u, k):
    """Return the fraction of a step that is left after whole periods of L~, and the turn in those."""
    a, b, c = rates
    alpha, beta, gamma, p, q = euler_rates(rates, u, k)
    larger = max(p, q)
    # p - q without their common term.
    kc2 = abs(beta * (u[0] * u[0] * gamma - u[2] * u[2] * alpha)) / larger
    if kc2 == 0:
        return 1.0, 0.0
    divisor, pole = (gamma, c) if p >= q else (alpha, a)
    K, Q = complete_integrals(math.sqrt(min(kc2, 1.0)), beta / divisor)
    period = 4 * K / math.sqrt(larger)
    elapsed = np.rint(1 / period) * period
    return 1 - elapsed, k * elapsed * (pole + 0.5 * (b - pole) * Q)


@called
def about(u, angle):
    """Return the quaternion of the body frame's rotation when the body turns about L~ by an angle."""
    s = -math.sin(0.5 * angle)
    return math.cos(0.5 * angle), s * u[0], s * u[1], s * u[2]


@inlined
def product(p, q):
    """Return the product of two quaternions, the rotation q followed by p."""
    a, b, c, d = p
    e, f, g, h = q
    return (
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    )


@inlined
def normalized(q):
    """Return the quaternion with the norm 1."""
    inverse = 1 / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return q[0] * inverse, q[1] * inverse, q[2] * inverse, q[3] * inverse
