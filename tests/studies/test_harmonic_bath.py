"""The harmonic model of steps in a bath."""

import math

import numpy as np
import pytest

from studies.harmonic_bath.steps import Case, stationary, stretched
from studies.harmonic_bath.surfaces import Gaussian, Surface, Tangents

THERMAL = 2.47

#: ps, that of a carbonyl, and 1/ps.
PERIOD = 0.023
FREQUENCY = 2 * math.pi / PERIOD


def mode(gradient, stiffness):
    """Return the surface of one mode."""
    return Surface(np.array([gradient]), np.array([[stiffness]]))


@pytest.mark.parametrize(
    "case", [Case(inner=inner, friction=friction) for inner, friction in ((1, 5), (3, 1), (5, 20))]
)
def test_fast_forces_alone_have_no_error(case):
    """However long the inner steps are, the spread of positions is thermal."""
    fast = mode(0.0, (1.5 / (1e-3 * case.step / case.inner)) ** 2)
    reached = stationary(mode(0.0, 0.0), fast, case, THERMAL)
    # The matrix of many steps is rounded; with 1/ps a fluctuation lives for 200 steps of 4096.
    assert reached.covariance == pytest.approx(THERMAL / fast.curvature, rel=1e-8)
    assert reached.mean == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("share", [0.0, 0.1])
def test_slow_forces_stretch_a_mode_by_x_over_tan_x(share):
    """A force f - s q in kicks acts as x/tan(x) times as much, x = pi h/T; -f is of the fast forces."""
    case, f = Case(inner=301, friction=20.0), 400.0
    fast, slow = mode(f, FREQUENCY**2), mode(-f, share * FREQUENCY**2)
    x = math.pi * 1e-3 * case.step / PERIOD
    stretch = x / math.tan(x)
    stiffness = FREQUENCY**2 * (1 + share * stretch)
    for reached in (stationary(slow, fast, case, THERMAL), stretched(slow, fast, case, THERMAL)):
        # An inner step leaves an error of some (omega h / 301)^2 / 12, 6e-6.
        assert reached.mean == pytest.approx((stretch - 1) * f / stiffness, rel=5e-5)
        assert reached.covariance == pytest.approx(THERMAL / stiffness, rel=5e-5)


def test_a_stiff_mode_follows_a_soft_one_as_in_steps():
    """A slow spring couples a mode of 2 ps to a stiff one."""
    stiff, soft, spring = FREQUENCY**2, (2 * math.pi / 2.0) ** 2, 2e-4 * FREQUENCY**2
    fast = Surface(np.array([400.0, 0.0]), np.diag([stiff, 0.0]))
    slow = Surface(np.array([-400.0, 0.0]), np.array([[spring, -spring], [-spring, spring + soft]]))
    case = Case(inner=101, friction=20.0)
    reached, law = stationary(slow, fast, case, THERMAL), stretched(slow, fast, case, THERMAL)
    assert reached.mean == pytest.approx(law.mean, rel=5e-4)
    # The stiff mode follows with a delay. The share of this in the coupling is about (omega h)^2 / 3, with the spring
    # in omega: 7e-4.
    assert reached.covariance == pytest.approx(law.covariance, rel=2e-3)


def test_constraints_bend_an_energy():
    """A weight on a rod from an atom that hardly moves has the stiffness of a pendulum."""
    positions = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]])
    pull = Surface(np.array([0.0, 0.0, 0.0, -7.0, 0.0, 0.0]), np.zeros((6, 6)))
    tangents = Tangents(positions, np.array([[0, 1]]), np.array([1e9, 2.0]), np.arange(2))
    surface = tangents(pull)
    stiffness = np.linalg.eigvalsh(surface.curvature)
    # Force over length and mass; the heavy atom changes it by 2e-9, and its own three coordinates are free.
    assert stiffness == pytest.approx([0, 0, 0, *[7 / (0.3 * 2)] * 2], abs=1e-6)
    assert np.abs(surface.gradient).max() < 1e-3


def test_a_mean_energy_is_that_of_its_parts():
    gaussian = Gaussian(np.array([1.0, 2.0]), np.diag([3.0, 4.0]))
    surface = Surface(np.array([5.0, 6.0]), np.diag([7.0, 8.0]))
    assert gaussian.energy(surface) == 5 + 12 + (7 * (3 + 1) + 8 * (4 + 4)) / 2
