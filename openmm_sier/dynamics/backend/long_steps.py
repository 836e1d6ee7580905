"""Free rotation over steps too long for the series, and of angular momenta whose squares no double can hold."""

import numpy as np

from openmm_sier.dynamics.backend.elliptic import LONGEST, complete_integrals, shortest_series
from openmm_sier.dynamics.backend.formulas import plus
from openmm_sier.dynamics.backend.short_steps import euler_rates, free_rotation

#: If passages of the separatrix's saddle are more than this many sub-steps apart, doubles cannot resolve the motion.
MOST_SUBSTEPS = 8192

#: Phases and angles above this have no meaning in double precision.
PHASE_CAP = 1e100


def turn(body_L, rates, h):
    """Rotate any bodies freely over any time.

    Whole periods of L~ are turns about L. The rest is cut into sub-steps, which compose exactly.

    Args:
        body_L: L~, (3, n), in the frame of descending rates.
        rates: inverse moments, (3, n).
        h: time.

    Returns:
        The quaternion of the body frame's rotation, (4, n).
    """
    u, k = _direction(body_L, h)
    cap = PHASE_CAP / np.maximum(rates[0], 1e-200)
    k = np.clip(k, -cap, cap)
    motion = euler_rates(rates, u, k)
    phase = np.sqrt(np.maximum(motion.p, motion.q))
    rest, whole = np.ones_like(k), np.zeros_like(k)
    # No period of L~ is shorter than 2 pi in phase.
    if (long := phase > 3).any():
        rest[long], whole[long] = _whole_periods(rates[:, long], u[:, long], k[long])
    turns = np.stack(_about(u, whole))

    pieces = np.maximum(np.ceil(phase * np.abs(rest) / np.sqrt(LONGEST)), 1)
    short = np.minimum(pieces, MOST_SUBSTEPS) / pieces
    pieces = np.minimum(pieces, MOST_SUBSTEPS).astype(int)
    k_piece = k * (rest * short) / pieces

    active = np.arange(k.size)
    for done in range(pieces.max()):
        active = active[pieces[active] > done]
        part = u[:, active], rates[:, active], k_piece[active]
        piece, (even, odd), _ = free_rotation(*part, shortest_series, sine_cosine, PHASE_CAP)
        turns[:, active] = _normalized(_product(piece, turns[:, active]))
        u[:, active] = _normalized(plus(even, odd))
    # Something is left over only for a state that is on the separatrix to its last bit. Nothing in the state tells when
    # it leaves the saddle, the middle axis, so it stays there.
    return _product(_about(u, k * (rest * (1 - short)) * rates[1]), turns)


def sine_cosine(x):
    """Return sine and cosine of any angles, arrays."""
    return np.sin(x), np.cos(x)


def _direction(body_L, h):
    """Return the direction of L~ and |L| h, also where the square of L~ overflows; a body at rest has any direction."""
    scale = np.abs(body_L).max(axis=0)
    scaled = body_L / np.where(scale > 0, scale, 1.0)
    norm = np.sqrt((scaled * scaled).sum(axis=0))
    scaled[0], unit = np.where(norm > 0, (scaled[0], norm), 1.0)
    with np.errstate(over="ignore", under="ignore"):
        return scaled / unit, np.clip(norm * (scale * h), -1e300, 1e300)


def _whole_periods(rates, u, k):
    """Return the fraction of a step that is left after whole periods of L~, and the turn in those."""
    a, b, c = rates
    alpha, beta, gamma, p, q = euler_rates(rates, u, k)
    larger = np.maximum(p, q)
    moving = larger > 0
    # p - q without the term that they share.
    kc2 = np.abs(beta * (u[0] * u[0] * gamma - u[2] * u[2] * alpha)) / np.where(moving, larger, 1.0)
    periodic = moving & (kc2 > 0)
    around_x = p >= q
    divisor = np.where(around_x, gamma, alpha)
    nu = np.where(periodic, beta / np.where(periodic, divisor, 1.0), 1.0)
    K, Q = complete_integrals(np.sqrt(np.where(periodic, np.minimum(kc2, 1.0), 1.0)), nu)
    period = np.where(periodic, 4 * K / np.sqrt(np.where(moving, larger, 1.0)), np.inf)
    count = np.rint(1 / period)
    spent = np.where(count > 0, count * np.where(periodic, period, 0.0), 0.0)
    pole = np.where(around_x, c, a)
    return 1 - spent, k * spent * (pole + 0.5 * (b - pole) * Q)


def _about(u, angle):
    """Return the quaternion of the body frame's rotation when the body turns about L~ by an angle."""
    s = -np.sin(0.5 * angle)
    return np.cos(0.5 * angle), s * u[0], s * u[1], s * u[2]


def _product(p, q):
    """Return the product of two quaternions, the rotation q followed by p."""
    (a, b, c, d), (e, f, g, h) = p, q
    return np.stack(
        [
            a * e - b * f - c * g - d * h,
            a * f + b * e + c * h - d * g,
            a * g - b * h + c * e + d * f,
            a * h + b * g - c * f + d * e,
        ]
    )


def _normalized(v):
    v = np.stack(v)
    return v / np.sqrt((v * v).sum(axis=0))
