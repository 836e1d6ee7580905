"""Limits of steps in a harmonic mode, compared with the motion of one by the operators."""

import math

import numpy as np
import pytest

from openmm_sier import SIER2, SIER2P3, SIER4G, Scheme
from openmm_sier.dynamics import operators
from openmm_sier.dynamics.bodies import BodySet, BodyState
from openmm_sier.dynamics.schemes import CATALOGUE, alternating
from openmm_sier.dynamics.species import Species
from openmm_sier.dynamics.step_limits import INEQUALITY

every_scheme = pytest.mark.parametrize("scheme", CATALOGUE.values(), ids=CATALOGUE.keys())
POSITION_VERLET = Scheme("position Verlet", (("drift", 0.5), ("kick", 1.0), ("drift", 0.5)))

#: Limits are found to twice the resolution of the largest that is possible, which is up to twice SIER2's limit.
FOUND = 4e-5


def motion(scheme, z, steps):
    """q and p/(m omega) of a harmonic mode after each step of a point body, with omega h = z.

    A step is linear in both, so that the scheme's operators make it of two bodies at rest in q and in p, and its matrix
    makes all others. A third body shows that it is linear.
    """
    mass, strength = 3.0, 7.0
    omega = math.sqrt(strength / mass)
    bodies = BodySet([Species.from_coordinates([[0], [1], [2]], [mass], [[0, 0, 0]])], 3)
    table = operators.body_operators(bodies, lambda q, A: (-strength * q, np.zeros_like(q)))
    step = operators.stepper(scheme, table, z / omega)
    q, p = np.zeros((3, 3)), np.zeros((3, 3))
    q[0], p[0] = (1.0, 0.0, 1.0), (0.0, mass * omega, mass * omega)
    state = step(BodyState(q, p, np.repeat(np.eye(3)[:, :, None], 3, axis=2), np.zeros((3, 3))))
    (a, b, both_q), (c, d, both_p) = state.q[0].tolist(), (state.p[0] / (mass * omega)).tolist()
    assert (a + b, c + d) == pytest.approx((both_q, both_p), rel=1e-13, abs=1e-13)
    x, y, path = 1.0, 0.0, []
    for _ in range(steps):
        x, y = a * x + b * y, c * x + d * y
        path.append((x, y))
    return np.array(path)


def test_limits_that_are_known():
    """Velocity Verlet has the trace 2 - z^2, SIER4G 2 - z^2 + z^4/12 - z^6/432 = -2 - (z^2 - 12)^3/432."""
    assert pytest.approx(2.0, rel=FOUND) == SIER2.stability_limit
    assert pytest.approx(2.0, rel=FOUND) == POSITION_VERLET.stability_limit
    # A triple root: an excess of 1e-12 in the trace moves z^2 by the cube root of 432e-12.
    assert pytest.approx(math.sqrt(12), rel=1e-4) == SIER4G.stability_limit
    # The mean kinetic energy of velocity Verlet is 1 - z^2/4 of the potential one.
    assert pytest.approx(math.sqrt(4 / 11), rel=1e-4) == SIER2.accuracy_limit
    # That of position Verlet is 1 / (1 - z^2/4) of it.
    assert pytest.approx(math.sqrt(4 * INEQUALITY), rel=1e-4) == POSITION_VERLET.accuracy_limit


def test_where_the_trace_touches_two_is_no_limit():
    """SIER2P3 is -1 near half a period of the mode, and goes on to the 4.67 that its authors give.

    Two steps of Verlet as one touch at 2 sqrt(2), and three of them at 2 sqrt(3) and 2 sqrt(9): each is Verlet's limit
    of 2 for its part of the step, whatever the step is called. A coefficient off by a thousandth parts the roots.
    """
    assert pytest.approx(4.662, abs=5e-4) == SIER2P3.stability_limit
    assert pytest.approx(3.571, abs=5e-4) == SIER2P3.accuracy_limit
    for stages in (2, 3, 4):
        fractions = [1 / (2 * stages), *[1 / stages] * (stages - 1)]
        steps = alternating("steps of Verlet", tuple(fractions))
        assert steps.stability_limit == pytest.approx(2.0 * stages, rel=FOUND)
        assert steps.accuracy_limit == pytest.approx(SIER2.accuracy_limit * stages, rel=1e-4)
    first, second, third, _ = (stage.fraction for stage in SIER2P3.stages[:4])
    assert alternating("off", (first, second - 1e-3, third), first="drift").stability_limit < 3
    # A million steps where it touches: no growth.
    touching = motion(SIER2P3, 2.976, 1_000_000)
    assert np.abs(touching).max() < 1.2


@every_scheme
def test_amplitudes_are_bounded_below_the_limit_only(scheme):
    """Near the limit the ellipse of the motion is long; beyond it growth is exponential.

    SIER4V becomes stable again 1 % beyond its limit, and SIER4G hardly grows there, as the cube of the distance.
    """
    below = motion(scheme, 0.999 * scheme.stability_limit, 20_000)
    assert np.abs(below).max() < 1e3
    assert np.abs(below[10_000:]).max() < 1.01 * np.abs(below[:10_000]).max()
    with np.errstate(over="ignore", invalid="ignore"):
        beyond = motion(scheme, 1.005 * scheme.stability_limit, 20_000)
    assert not np.abs(beyond).max() < 1e6


@every_scheme
def test_energies_differ_by_a_tenth_at_the_accuracy_limit(scheme):
    potential, kinetic = (motion(scheme, scheme.accuracy_limit, 40_000) ** 2).mean(axis=0)
    # The mean over a time that is no whole number of periods is off by less than one part in the number of steps.
    assert abs(potential / kinetic - 1) == pytest.approx(INEQUALITY, abs=1e-3)
    potential, kinetic = (motion(scheme, 0.9 * scheme.accuracy_limit, 40_000) ** 2).mean(axis=0)
    assert abs(potential / kinetic - 1) < INEQUALITY


@every_scheme
def test_a_heat_bath_does_not_matter(scheme):
    # Stages that the bath divides have the same product, to rounding that may move the limit by one place.
    assert scheme.with_bath().stability_limit == pytest.approx(scheme.stability_limit, rel=FOUND)


def test_without_kicks_or_drifts_there_is_no_limit():
    for operator in ("kick", "drift"):
        scheme = Scheme(operator, ((operator, 1.0),))
        assert scheme.stability_limit == scheme.accuracy_limit == math.inf
