"""The schemes on interacting rigid bodies, without OpenMM: order, symplecticity, reversal and conservation."""

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest

from openmm_sier import SIER2, SIER2P3, SIER2V2, SIER4, SIER4G, BodyState
from openmm_sier.dynamics.operators import body_operators, drift, kick, stepper
from tests.support.convergence import run, slope
from tests.support.molecules import CARBON_DIOXIDE, ION, METHANE, WATER, SoftCluster
from tests.support.oracles import orthogonality_error
from tests.support.phase_space import distance, reversed_momenta, symplectic_defect


@pytest.fixture
def waters():
    return SoftCluster([WATER] * 3)


@pytest.fixture
def mixture():
    return SoftCluster([WATER, ION, CARBON_DIOXIDE, METHANE, WATER])


# --- order ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("scheme", "steps", "order", "tolerance"),
    [
        (SIER2, (64, 128, 256), 2.0, 0.05),
        (SIER2V2, (32, 64, 128), 2.0, 0.05),
        (SIER2P3, (32, 64, 128), 2.0, 0.05),
        (SIER4, (16, 32, 64), 4.0, 0.1),
        (SIER4G, (16, 32, 64), 4.0, 0.1),
    ],
)
@pytest.mark.parametrize("system", ["waters", "mixture"])
def test_global_error_falls_with_the_order(rng, request, system, scheme, steps, order, tolerance):
    """At the largest step the next term of the error, smaller by h^2, changes the slope by some hundredths at most."""
    cluster = request.getfixturevalue(system)
    assert slope(cluster, scheme, cluster.start(rng), steps) == pytest.approx(order, abs=tolerance)


# --- symplecticity ----------------------------------------------------------------------------------------------------

#: Differences of width w err by w^4 = 1.6e-11 times fifth derivatives and by rounding of 1e-15 / w = 5e-13.
SYMPLECTIC = 1e-9


@pytest.fixture
def pair():
    return SoftCluster([WATER] * 2)


@pytest.mark.parametrize(("scheme", "h"), [(SIER2, 0.004), (SIER4, 0.008), (SIER2P3, 0.012), (SIER2, -0.004)])
def test_a_step_of_two_waters_is_symplectic(rng, pair, scheme, h):
    state = pair.start(rng)
    assert symplectic_defect(lambda s: run(pair, scheme, s, h, 1), state) < SYMPLECTIC


# --- reversal and conservation ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("scheme", "h"), [(SIER2, 0.002), (SIER2V2, 0.006), (SIER2P3, 0.012), (SIER4, 0.006), (SIER4G, 0.006)]
)
def test_time_reversal(rng, mixture, scheme, h):
    """Back by reversed momenta and by a reversed step: rounding of 1e-15 grows with the flow's instability only."""
    start = mixture.start(rng)
    there = run(mixture, scheme, start, h, 50)
    assert distance(there, start) > 0.1
    back = reversed_momenta(run(mixture, scheme, reversed_momenta(there), h, 50))
    assert distance(back, start) < 1e-11
    assert distance(run(mixture, scheme, there, -h, 50), start) < 1e-11


@pytest.mark.parametrize("scheme", [SIER2, SIER4, SIER4G])
def test_momentum_and_angular_momentum_are_constant(rng, mixture, scheme):
    start = mixture.start(rng)
    P, J = mixture.bodies.total_momenta(start)
    end = run(mixture, scheme, start, 0.003, 500)
    P_end, J_end = mixture.bodies.total_momenta(end)
    # 500 steps, some 10^3 operations each: a random walk of roundings of the largest momentum and of its moment.
    size = np.abs(start.p).max()
    assert np.abs(P_end - P).max() < 1e-13 * size
    assert np.abs(J_end - J).max() < 1e-13 * size * np.abs(end.q).max()
    assert orthogonality_error(end.A) < 1e-13


# --- what a step costs and leaves alone -------------------------------------------------------------------------------


def test_an_operation_that_nothing_executes_is_refused(waters):
    with pytest.raises(ValueError, match="'bath 1'"):
        stepper(SIER2.with_bath(), body_operators(waters.bodies, waters.forces), 0.002)


@pytest.mark.parametrize(("scheme", "evaluations"), [(SIER2, 1), (SIER2V2, 2), (SIER4, 4), (SIER4G, 3)])
def test_force_evaluations(rng, waters, scheme, evaluations):
    forces = Mock(wraps=waters.forces)
    step = stepper(scheme, body_operators(waters.bodies, forces), 0.002)
    state = step(waters.start(rng))
    # The first step has no force from the one before.
    assert forces.call_count == evaluations + 1
    for done in range(2, 8):
        state = step(state)
        assert forces.call_count == done * evaluations + 1
    # A state with a new cache.
    step(replace(state))
    assert forces.call_count == 7 * evaluations + 1 + evaluations + 1


def test_forces_are_cached_for_a_place(rng, waters):
    """States that differ in momenta share them, those at other arrays of positions or attitudes do not."""
    forces = Mock(wraps=waters.forces)
    apply = kick(waters.bodies, forces)
    state = waters.start(rng)
    kicked = apply(state, 0.001)
    assert forces.call_count == 1
    for same in (state, kicked):
        again = apply(same, 0.001)
        assert again.q is state.q
        assert again.A is state.A
    assert forces.call_count == 1
    for count, changed in ((2, replace(state, q=state.q.copy())), (3, replace(state, A=state.A.copy()))):
        again = apply(changed, 0.001)
        assert np.array_equal(again.p, kicked.p)
        assert np.array_equal(again.L, kicked.L)
        assert forces.call_count == count


def test_a_failed_evaluation_gives_no_force(rng, waters):
    """The force of another state must not serve after an error."""
    state = waters.start(rng)
    broken = []

    def compute(q, A):
        if broken:
            raise ArithmeticError("no force")
        return waters.forces(q, A)

    apply = kick(waters.bodies, compute)
    apply(state, 0.001)
    broken.append(True)
    elsewhere = replace(state, q=state.q + 1)
    for _ in range(2):
        with pytest.raises(ArithmeticError):
            apply(elsewhere, 0.001)


def test_steps_leave_the_state_they_start_from(rng, mixture):
    state = mixture.start(rng)
    before = [array.copy() for array in (state.q, state.p, state.A, state.L)]
    after = run(mixture, SIER4, state, 0.002, 2)
    for array, copy in zip((state.q, state.p, state.A, state.L), before, strict=True):
        assert np.array_equal(array, copy)
    assert after.q is not state.q
    assert not np.shares_memory(after.A, state.A)


def test_wrong_shapes_are_refused(rng, mixture):
    """Before anything is computed with them."""
    state, n = mixture.start(rng), mixture.bodies.n
    fewer = BodyState(state.q[:, :1], state.p[:, :1], state.A[:, :, :1], state.L[:, :1])
    with pytest.raises(ValueError, match=rf"q of shape \(3, {n}\), got \(3, 1\)"):
        drift(mixture.bodies)(fewer, 0.001)


@pytest.mark.parametrize(("vector", "message"), [("L", "angular momentum of body 1 "), ("A", "attitude of body 1 ")])
def test_bodies_that_are_not_finite_do_not_drift(rng, waters, vector, message):
    state = waters.start(rng)
    getattr(state, vector)[..., 0, 1] = np.nan
    with pytest.raises(ValueError, match=message):
        drift(waters.bodies)(state, 0.001)


def test_drift_takes_any_rotation(rng, mixture):
    """The map gets each species with its moments; points have nothing to turn."""
    calls = []

    def rotation(A, L, moments, h):
        calls.append((A.shape, L.shape, tuple(moments), h))
        return -A, 2 * L

    state = mixture.start(rng)
    after = drift(mixture.bodies, rotation)(state, 0.5)
    turning = [i for i in range(mixture.bodies.n) if mixture.bodies.moments[:, i].any()]
    assert [moments for _, _, moments, _ in calls] == [tuple(mixture.bodies.moments[:, i]) for i in turning]
    assert {(A, L, h) for A, L, _, h in calls} == {((3, 3, 1), (3, 1), 0.5)}
    assert np.array_equal(after.A[:, :, turning], -state.A[:, :, turning])
    assert np.array_equal(after.L[:, turning], 2 * state.L[:, turning])
    assert np.array_equal(after.A[:, :, 1], state.A[:, :, 1])
    assert np.allclose(after.q, state.q + 0.5 * state.p / mixture.bodies.masses, rtol=1e-15)
    assert after.p is state.p
