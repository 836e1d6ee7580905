"""The gradient kick: what it is the force of, which displacement has which order, and its symplecticity."""

from dataclasses import replace

import numpy as np
import pytest

from openmm_sier import Scheme
from openmm_sier.dynamics.backend.formulas import body_frame
from openmm_sier.dynamics.schemes import CATALOGUE, GRADIENT_KICK, KICK, SIER4G, Stage
from tests.support.convergence import operators_of, run, slope
from tests.support.molecules import CARBON_DIOXIDE, ION, METHANE, WATER, SoftCluster
from tests.support.phase_space import symplectic_defect, turned


def with_shift(shift):
    """SIER4G with another displacement of its middle force."""
    middle = Stage(GRADIENT_KICK, 2 / 3, shift) if shift else Stage(KICK, 2 / 3)
    return Scheme("shifted", (*SIER4G.stages[:2], middle, *SIER4G.stages[3:]))


# --- the operator -----------------------------------------------------------------------------------------------------


def squared_acceleration(cluster, state):
    """(F M^-1 F + tau I^-1 tau) / 2, of which a gradient kick takes s off the potential."""
    F, tau = cluster.forces(state.q, state.A)
    turning = body_frame(state.A, tau)
    return 0.5 * ((F**2 / cluster.bodies.masses).sum() + (turning**2 * cluster.bodies.inverse_moments).sum())


def generalized_force(function, state, body, width=1e-5):
    """Minus the derivatives of a function by translations and by rotations of a body about lab axes."""
    found = []
    for axis in np.eye(3):
        shift = np.zeros_like(state.q)
        shift[:, body] = width * axis
        pair = [function(replace(state, q=state.q + sign * shift)) for sign in (1, -1)]
        found.append((pair[1] - pair[0]) / (2 * width))
    for axis in np.eye(3):
        pair = [function(turned(state, body, sign * width * axis)) for sign in (1, -1)]
        found.append((pair[1] - pair[0]) / (2 * width))
    return np.array(found)


def test_it_is_the_force_of_the_modified_potential(rng):
    """Minus the gradient of V - s (F M^-1 F + tau I^-1 tau) / 2, translations and rotations, for every kind of body.

    The terms of the rotations that the derivation says cancel are in the finite differences.
    """
    mixture = SoftCluster([WATER, ION, CARBON_DIOXIDE, METHANE, WATER])
    state = mixture.start(rng)
    _, operators = operators_of(mixture)
    exact = np.array(
        [generalized_force(lambda s: -squared_acceleration(mixture, s), state, i) for i in range(mixture.bodies.n)]
    )

    def correction(s):
        """What the displacement adds to a kick of unit length, over s."""
        moved = [operators[GRADIENT_KICK](state, 1.0, sign * s) for sign in (1, -1)]
        return np.concatenate([getattr(moved[0], v) - getattr(moved[1], v) for v in ("p", "L")]).T / (2 * s)

    scale = np.abs(exact).max(axis=0)
    errors = [np.abs((correction(s) - exact) / scale).max() for s in (4e-6, 2e-6)]
    # Of the difference between s and -s, the first term left out is of the third order in s, a relative s^2; at
    # s = h^2/24 with h = 7 fs it is a few per cent.
    assert errors[1] < 1e-2
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)


# --- order ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("shift", [-1 / 24, 0.0, 1 / 12, 1.1 / 24])
def test_another_displacement_is_of_second_order(rng, shift):
    """Wrong sign, none, twice the size, a tenth too much: derived and seen."""
    waters, broken = SoftCluster([WATER] * 3), with_shift(shift)
    assert broken.order == 2
    # A tenth too much leaves a small h^2, so that h^4 shows besides unless the steps are short.
    assert slope(waters, broken, waters.start(rng), steps=(64, 128, 256)) == pytest.approx(2.0, abs=0.1)


def test_derived_order():
    assert SIER4G.order == 4
    assert with_shift(1 / 24).order == 4
    assert with_shift((1 + 1e-9) / 24).order == 2
    assert SIER4G.is_palindrome
    lopsided = Scheme("lopsided", (Stage(KICK, 1 / 3), *SIER4G.stages[1:4]))
    assert lopsided.order == 1


def test_a_gradient_scheme_is_of_fourth_order_at_most():
    """The displaced force has terms of h^5 that are no exponential of the operators: no order above 4 is claimed."""
    # Alone it is its own exponential to any order, but for those terms.
    assert Scheme("kicks", ((KICK, 0.5), (KICK, 0.5))).order == 6
    for scheme in CATALOGUE.values():
        if GRADIENT_KICK in scheme.operators:
            assert scheme.order == 4


# --- symplecticity ----------------------------------------------------------------------------------------------------

#: What finite differences leave of the defect of kicks and drifts, here below 1e-11.
NOISE = 3e-11


@pytest.mark.slow
def test_symplecticity_defect_is_of_fifth_order(rng):
    """The finite displacement leaves a defect of h s^2 in the kick, O(h^5) a step; without it there is none."""
    pair = SoftCluster([WATER] * 2)
    state = pair.start(rng)
    _, operators = operators_of(pair)

    def slope_of(flow, steps):
        defects = [symplectic_defect(lambda s, h=h: flow(s, h), state) for h in steps]
        assert min(defects) > 10 * NOISE
        return np.polyfit(np.log(steps), np.log(defects), 1)[0]

    # The next term of the kick is smaller by h^2 / 24 times the square of a frequency, some thousandths; drifts and
    # kicks around it add terms that are smaller by h^2, a few per cent at steps this short.
    kick_slope = slope_of(lambda s, h: operators[GRADIENT_KICK](s, 2 / 3 * h, h * h / 24), [0.004, 0.0057, 0.008])
    assert kick_slope == pytest.approx(5.0, abs=0.05)
    step_slope = slope_of(lambda s, h: run(pair, SIER4G, s, h, 1), [0.002, 0.0028, 0.004])
    assert step_slope == pytest.approx(5.0, abs=0.1)
    assert symplectic_defect(lambda s: run(pair, with_shift(0.0), s, 0.004, 1), state) < NOISE
