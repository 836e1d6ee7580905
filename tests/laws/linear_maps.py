"""Schemes on a harmonic oscillator: the exact stationary distribution at any step."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.dynamics.stages import BATH, DRIFT, Stage


class Oscillator(NamedTuple):
    """Averages at the ends of steps, in units in which all are those of kT.

    Attributes:
        q2: of k q^2/kT.
        p2: of p^2/(m kT).
        qp: of q p w/kT.
    """

    q2: float = 1.0
    p2: float = 1.0
    qp: float = 0.0


def stage_map(stage: Stage, pace: float) -> np.ndarray:
    """Return the map of (q, p), in units in which frequency, mass and kT are 1."""
    time = stage.fraction * pace
    if stage.flow == DRIFT:
        return np.array([[1, time], [0, 1]])
    if stage.operator == BATH:
        return np.eye(2)
    # The force of a gradient kick is that at the place q - shift h^2 q.
    return np.array([[1, 0], [-time * (1 - stage.shift * pace**2), 1]])


def step_map(scheme: Scheme, pace: float) -> np.ndarray:
    """Return the map of a step without its bath."""
    total = np.eye(2)
    for stage in scheme.stages:
        total = stage_map(stage, pace) @ total
    return total


def in_bath(scheme: Scheme, pace: float) -> Oscillator:
    """Return the stationary averages of a scheme whose momenta a bath keeps canonical.

    A palindrome conserves a quadratic form without a product of q and p, so that a canonical p makes q normal, with
    the ratio of the form. With a bath within the drift of SIER2 positions and momenta are exact, and momenta at the
    end, half a drift after the bath, are correlated with positions: q is q' + p h/2m, with q' independent of p.
    """
    if scheme.bath_divides_drift:
        return Oscillator(qp=pace / 2)
    (_, upper), (lower, _) = step_map(scheme, pace)
    return Oscillator(q2=-upper / lower)


def pushed(scheme: Scheme, kept: float) -> float:
    """Return the mean momentum at the ends of steps under a constant force, over force times step.

    Args:
        scheme: with a bath.
        kept: factor of momenta in the bath of a step.
    """
    factor, gained = 1.0, 0.0
    for stage in scheme.stages:
        if stage.operator == BATH:
            factor, gained = factor * kept**stage.fraction, gained * kept**stage.fraction
        elif stage.flow != DRIFT:
            gained += stage.fraction
    return gained / (1 - factor)


def is_stable(scheme: Scheme, pace: float) -> bool:
    """Return whether an oscillator stays bounded, with room for rounding."""
    return abs(np.trace(step_map(scheme, pace))) < 2 and math.isfinite(pace)
