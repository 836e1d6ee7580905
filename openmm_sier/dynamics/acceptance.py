"""Hybrid Monte Carlo: trajectories of a scheme, each accepted or rejected on its true energy.

A trial refreshes the momenta and follows a trajectory of n steps. Its end is accepted with the probability
min(1, exp(-(H1 - H0)/kT)); otherwise the state returns to its start, with all momenta reversed. The ends of trials are
then samples of the canonical ensemble, whatever the step, provided that trajectories are reversible and preserve
phase-space volume. This holds for drifts and kicks, and for gradient kicks, which change momenta by a function of
positions alone.

Where a CMMotionRemover requires zero total momentum, momenta are drawn with that of the centre of mass, and the motion
of the centre of mass is removed after the decision. A removal within a trajectory would be irreversible wherever forces
do not sum to zero.

Where many molecules contribute, energy errors are normally distributed. <exp(-error/kT)> = 1, which holds for every
reversible map that preserves phase-space volume, then makes their mean half their variance in kT^2, and the acceptance
erfc(sd/sqrt(8)).

Sources: Duane, Kennedy, Pendleton and Roweth, Phys. Lett. B 195, 216 (1987); Horowitz, Phys. Lett. B 268, 247 (1991)
for partly refreshed momenta, which detailed balance requires to be reversed after a rejection; Gupta, Irbaeck, Karsch
and Petersson, Phys. Lett. B 242, 437 (1990) for the acceptance.
"""

import math
from statistics import NormalDist

from openmm_sier.dynamics.noise import generator


def is_accepted(error: float, seed: int, draw: int) -> bool:
    """Tell whether Metropolis' rule accepts the end of a trajectory; never if the error is NaN.

    Args:
        error: energy at its end minus that at its start, in kT.
        seed, draw: fix the random number.
    """
    return bool(error <= -math.log(1 - generator(seed, draw, stream=2).random()))


def spread_at(acceptance: float) -> float:
    """Return the standard deviation of energy errors in kT at which a fraction of trials is accepted.

    >>> round(spread_at(0.5), 3)
    1.349
    """
    return -2 * NormalDist().inv_cdf(acceptance / 2)
