"""The gradient kick: which displacement has which order, and its symplecticity."""

import numpy as np
import pytest

from openmm_sier import Scheme
from openmm_sier.dynamics.operators import kick
from openmm_sier.dynamics.schemes import CATALOGUE, GRADIENT_KICK, KICK, SIER4G, Stage
from tests.support.convergence import run, slope
from tests.support.molecules import WATER, SoftCluster
from tests.support.phase_space import symplectic_defect


def with_shift(shift):
    """SIER4G with another displacement of its middle force."""
    middle = Stage(GRADIENT_KICK, 2 / 3, shift) if shift else Stage(KICK, 2 / 3)
    return Scheme("shifted", (*SIER4G.stages[:2], middle, *SIER4G.stages[3:]))


# --- order ------------------------------------------------------------------------------------------------------------


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


def test_symplecticity_defect_is_of_fifth_order(rng):
    """The finite displacement leaves a defect of h s^2 in the kick, O(h^5) a step; without it there is none."""
    pair = SoftCluster([WATER] * 2)
    state = pair.start(rng)
    gradient_kick = kick(pair.bodies, pair.forces)

    def slope_of(flow, steps):
        defects = [symplectic_defect(lambda s, h=h: flow(s, h), state) for h in steps]
        assert min(defects) > 10 * NOISE
        return np.polyfit(np.log(steps), np.log(defects), 1)[0]

    # The next term of the kick is smaller by h^2 / 24 times the square of a frequency, some thousandths; drifts and
    # kicks around it add terms that are smaller by h^2, a few per cent at steps this short.
    kick_slope = slope_of(lambda s, h: gradient_kick(s, 2 / 3 * h, h * h / 24), [0.004, 0.0057, 0.008])
    assert kick_slope == pytest.approx(5.0, abs=0.05)
    step_slope = slope_of(lambda s, h: run(pair, SIER4G, s, h, 1), [0.002, 0.0028, 0.004])
    assert step_slope == pytest.approx(5.0, abs=0.1)
    assert symplectic_defect(lambda s: run(pair, with_shift(0.0), s, 0.004, 1), state) < NOISE
