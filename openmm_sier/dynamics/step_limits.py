"""The longest step of a splitting scheme for a harmonic mode, from the matrix by which it propagates the mode.

With (q, h p/m) as coordinates and x = (omega h)^2 a kick of fraction t is [[1, 0], [-t x, 1]], a gradient kick of shift
s is [[1, 0], [-t x (1 - s x), 1]], and a drift [[1, t], [0, 1]].
"""

from collections.abc import Sequence

import numpy as np

from openmm_sier.dynamics.stages import DRIFT, KICK, Stage

#: At the accuracy limit the mean kinetic energy of a mode differs from its potential energy by this fraction, or its
#: frequency is off by it. For velocity Verlet the first is at ten steps a period, a common rule of thumb. With a bath
#: in the middle of the drift the energies are equal up to the stability limit, and the frequency decides.
INEQUALITY = 0.1

#: Angular velocities in units of sqrt(kT/I) that a step must follow: one body in twenty spins faster. Free spin is
#: exact at any step, but forces on atoms off the axis change with the angle, and kicks sample them once a step. A
#: scheme follows spins as it follows vibrations, up to its `accuracy_limit`. For 64 trimers like CO2 of 172 to 178
#: degrees, at 250 K, rms(H)/rms(V) within 1.5 ps was, by the angle sqrt(kT/I) h:
#:     SIER2          0.3 0.0015, 0.4 0.0025, 0.7 0.007, 1.0 0.014, 1.4 0.04, 1.9 0.07    a line 0.001 to 0.008
#:     SIER4G, SIER4  0.4 0.00004, 0.7 0.0001, 1.0 0.0005, 1.3 0.003, 1.9 0.02            a line 0.00005
FAST_SPIN = 2.0

#: Limits are looked for at multiples of this fraction of the largest omega h that is possible.
RESOLUTION = 1e-5

#: Where a curve touches a limit and turns back, rounding exceeds it by less than this.
ROUNDING = 1e-12


def limits(stages: Sequence[Stage]) -> tuple[float, float]:
    """Return the largest omega h for which a harmonic mode stays bounded, and for which its energies are right.

    The matrix [[a, b], [c, d]] has the determinant 1, so that its eigenvalues are on the unit circle where its trace is
    within 2 and -2. It conserves b (h p/m)^2 + (a - d) q (h p/m) - c q^2. So the mean of the potential energy over that
    of the kinetic one is -x b / c; the two are to agree within `INEQUALITY`. So are omega h and the angle by which a
    step turns the phase of the mode, the arc cosine of half the trace. Where the trace touches 2 or -2 and turns
    back, the matrix is 1 or -1: the mode is bounded there too, and b and c are both zero.

    Infinite without kicks or drifts. Stages that are neither, such as a heat bath, are left out.
    """
    if not {KICK, DRIFT} <= {stage.flow for stage in stages}:
        return np.inf, np.inf
    # A trace that is a polynomial of degree n in x, with the slope of the exact one at 0, leaves -2 to 2 by omega h =
    # 2 n: Chebyshev's polynomial stays there longest.
    degree = sum(2 if stage.shift else 1 for stage in stages if stage.flow == KICK)
    z = 2 * (degree + 1) * np.arange(RESOLUTION, 1, RESOLUTION)
    x = z**2
    a, b, c, d = np.ones_like(z), np.zeros_like(z), np.zeros_like(z), np.ones_like(z)
    for stage in stages:
        if stage.flow == DRIFT:
            a, b = a + stage.fraction * c, b + stage.fraction * d
        elif stage.flow == KICK:
            pull = stage.fraction * x * (1 - stage.shift * x)
            c, d = c - pull * a, d - pull * b
    unstable = np.abs(a + d) > 2 + ROUNDING
    unequal = np.abs(x * b + c) > INEQUALITY * np.abs(c) + ROUNDING
    # Beyond half a turn the trace does not determine the angle.
    unequal |= (z < np.pi) & (np.abs(np.arccos(np.clip((a + d) / 2, -1, 1)) - z) > INEQUALITY * z)
    stable, accurate = (float(z[beyond.argmax() - 1]) if beyond.any() else np.inf for beyond in (unstable, unequal))
    return stable, min(stable, accurate)
