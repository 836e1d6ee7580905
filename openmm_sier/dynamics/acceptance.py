"""Hybrid Monte Carlo: trajectories of a scheme, each accepted or rejected on its true energy.

A trial refreshes the momenta and follows a trajectory of n steps. Its end is accepted with the probability
min(1, exp(-(H1 - H0)/kT)); otherwise the state returns to its start, with all momenta reversed. The ends of trials are
then samples of the canonical ensemble, whatever the step, provided that trajectories are reversible and preserve
phase-space volume. This holds for drifts and kicks, and for gradient kicks, which change momenta by a function of
positions alone.

If a CMMotionRemover requires zero total momentum, momenta are drawn with that of the centre of mass, and the motion of
the centre of mass is removed after the decision. The over-relaxed kinetic energy includes that of the centre of mass. A
removal within a trajectory would be irreversible if forces do not sum to zero.

Where many molecules contribute, energy errors are normally distributed. <exp(-error/kT)> = 1, which holds for every
reversible map that preserves phase-space volume, then makes their mean half their variance in kT^2, and the acceptance
erfc(sd/sqrt(8)).

The potential energy decorrelates only as fast as it exchanges heat with the momenta. So their kinetic energy is not
drawn at random, but over-relaxed: if the old one was above its mean, the new one is likely to be below, and energy
flows back. It is still canonical, since it is the value with the mirrored rank among the old one and several random
ones. Directions of momenta are random.

A rejection reverses all momenta, so that molecules move back. It is rarer if a trajectory that would be rejected
continues, and the energy error at its next end is compared with the same random number. The next end is accepted as
often in the reverse direction: let p be the probabilities of the ends. From the end i the end k is
reached with max(0, min(p_i, p_k) - max_j min(p_i, p_j))/p_i, where j are the ends between them. If this is positive,
each p_j is below p_i and p_k, so that p_i times it is the same from either side.

Let a be the kinetic fraction of the heat capacity, and let each trial equilibrate kinetic and potential energy. Then
the potential energy decorrelates in 2/a - 1 trials if kinetic energies are independent, and in 1/a if each is the
opposite of the last one: in rigid water, where a is about 0.35, in 5 trials and in 3. Slower motions remain as slow.

Sources: Duane, Kennedy, Pendleton and Roweth, Phys. Lett. B 195, 216 (1987); Horowitz, Phys. Lett. B 268, 247 (1991)
for partly refreshed momenta, which must be reversed after a rejection for detailed balance; Gupta, Irbaeck, Karsch
and Petersson, Phys. Lett. B 242, 437 (1990) for the acceptance; R. M. Neal, in Learning in Graphical Models (1998), 205
for over-relaxation by ranks; C. M. Campos and J. M. Sanz-Serna, J. Comput. Phys. 281, 365 (2015) for trajectories that
continue.
"""

# Without this, annotations would import numpy.random, which is slow.
from __future__ import annotations

import math
from statistics import NormalDist

import numpy as np

from openmm_sier.dynamics.noise import generator

#: The usual length of a trial, ps. Short trials exchange energy often (docs/measurements/sampling.md).
TRIAL_LENGTH = 0.072

#: The usual friction of partial draws of momenta, 1/ps. Momenta that last for many trials move molecules far.
TRIAL_FRICTION = 1.0

#: Largest length of a trial that continues since its end would be rejected, ps. Chaos makes trajectories of some 0.6 ps
#: irreversible.
LONGEST_TRIAL = 3 * TRIAL_LENGTH

#: Number of random kinetic energies for an over-relaxed one. It is odd, so that no rank is its own mirror image; with a
#: larger number the new one would be closer to the opposite of the old one.
RANKED = 15

#: See `best_acceptance`.
NEARLY = 0.95


def usual_steps(step: float) -> int:
    """Return the usual number of steps in a trial for a step in ps; 1 where nothing moves.

    >>> usual_steps(0.009)
    8
    """
    return max(1, round(TRIAL_LENGTH / step)) if step else 1


def usual_chances(length: float) -> int:
    """Return the default number of times, at most 2, that a trial of a length in ps continues.

    >>> usual_chances(0.072), usual_chances(0.15)
    (2, 0)
    """
    return min(2, max(0, int(LONGEST_TRIAL / length * (1 + 1e-9)) - 1)) if length else 0


def over_relaxed(old: float, freedoms: float, noise: np.random.Generator) -> float:
    """Return a new kinetic energy, which tends to be above its mean where the old one is below.

    If the old one is canonical, so is the new one.

    Args:
        old: kinetic energy in units of kT/2.
        freedoms: number of degrees of freedom that have it, above 0.
        noise: random numbers.

    Returns:
        The new one in units of kT/2, above 0.
    """
    ranked = sorted([old, *noise.chisquare(freedoms, RANKED)])
    return float(ranked[-1 - ranked.index(old)])


def largest_error(seed: int, draw: int) -> float:
    """Return the largest energy error in kT at which Metropolis' rule accepts an end of a trajectory.

    Args:
        seed, draw: fix the random number.
    """
    return -math.log(1 - generator(seed, draw, stream=2).random())


def acceptance_at(spread: float) -> float:
    """Return the fraction of trials that is accepted where energy errors have this standard deviation in kT.

    >>> round(acceptance_at(0.5), 3)
    0.803
    """
    return math.erfc(spread / math.sqrt(8))


def best_acceptance(order: int) -> float:
    """Return the acceptance at which a scheme of this order has nearly the largest step times acceptance.

    The standard deviation of energy errors grows as the step to the power of the order. The largest product, at an
    acceptance of 0.65 for second order and of 0.80 for fourth, is flat, and rejected trials also reverse momenta: this
    is the shortest step with `NEARLY` of it.

    >>> round(best_acceptance(2), 3), round(best_acceptance(4), 3)
    (0.771, 0.895)
    """
    spreads = [0.001 * i for i in range(1, 5000)]
    products = [spread ** (1 / order) * acceptance_at(spread) for spread in spreads]
    first = next(i for i, product in enumerate(products) if product >= NEARLY * max(products))
    return acceptance_at(spreads[first])


def spread_at(acceptance: float) -> float:
    """Return the standard deviation of energy errors in kT at which a fraction of trials is accepted.

    >>> round(spread_at(0.5), 3)
    1.349
    """
    return -2 * NormalDist().inv_cdf(acceptance / 2)
