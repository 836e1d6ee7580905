"""The gradient kick and the schemes that have one: what it is the force of, order, symplecticity, conservation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from openmm_sier import SIER4, RigidBodies, Scheme, SIERIntegrator, SIERLangevinIntegrator
from openmm_sier.dynamics.backend.formulas import body_frame
from openmm_sier.dynamics.operators import stepper
from openmm_sier.dynamics.schemes import BATH, CATALOGUE, DRIFT, GRADIENT_KICK, KICK, SIER4G, Stage
from tests.support.convergence import operators_of, run, slope
from tests.support.molecules import CARBON_DIOXIDE, ION, METHANE, WATER, SoftCluster
from tests.support.oracles import orthogonality_error
from tests.support.phase_space import distance, reversed_momenta, symplectic_defect, turned
from tests.support.waters import cluster_system, context_at, energies, phase_point, relaxed


@pytest.fixture
def waters():
    return SoftCluster([WATER] * 3)


@pytest.fixture
def mixture():
    return SoftCluster([WATER, ION, CARBON_DIOXIDE, METHANE, WATER])


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


def test_it_is_the_force_of_the_modified_potential(rng, mixture):
    """Minus the gradient of V - s (F M^-1 F + tau I^-1 tau) / 2, translations and rotations, for every kind of body.

    The terms of the rotations that the derivation says cancel are in the finite differences.
    """
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


def test_the_displaced_force_is_not_kept(rng, waters):
    """A kick after it uses the force at the bodies' own positions."""
    state = waters.start(rng)
    forces, operators = operators_of(waters)
    after = operators[GRADIENT_KICK](state, 0.001, 1e-6)
    assert forces.evaluations == 2
    F, tau = forces(after)
    assert forces.evaluations == 2
    expected = waters.forces(state.q, state.A)
    assert np.array_equal(F, expected[0])
    assert np.array_equal(tau, expected[1])


# --- order ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("system", ["waters", "mixture"])
def test_global_error_is_of_fourth_order(rng, request, system):
    cluster = request.getfixturevalue(system)
    start = cluster.start(rng)
    # The next term of the error, smaller by h^2, changes the slope by a few hundredths.
    assert slope(cluster, SIER4G, start) == pytest.approx(4.0, abs=0.1)


@pytest.mark.parametrize("shift", [-1 / 24, 0.0, 1 / 12, 1.1 / 24])
def test_another_displacement_is_of_second_order(rng, waters, shift):
    """Wrong sign, none, twice the size, a tenth too much: derived and seen."""
    broken = with_shift(shift)
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


def test_size_of_the_symplecticity_defect(rng):
    """At 6 fs a step of two waters changes the form, whose elements are 1, by parts in 10^7."""
    pair = SoftCluster([WATER] * 2)
    defect = symplectic_defect(lambda s: run(pair, SIER4G, s, 0.006, 1), pair.start(rng))
    # 1.6e-7 here, 6e-8 to 7e-6 for other orientations. Twice the displacement makes it more than four times as large.
    assert NOISE < defect < 3e-7


# --- reversal and conservation ----------------------------------------------------------------------------------------


def test_time_reversal(rng, mixture):
    """Exact though the map is not quite symplectic: only rounding of 1e-15 grows, with the flow's instability."""
    start = mixture.start(rng)
    there = run(mixture, SIER4G, start, 0.006, 50)
    assert distance(there, start) > 0.1
    back = reversed_momenta(run(mixture, SIER4G, reversed_momenta(there), 0.006, 50))
    assert distance(back, start) < 1e-11
    assert distance(run(mixture, SIER4G, there, -0.006, 50), start) < 1e-11


def test_momentum_and_angular_momentum_are_constant(rng, mixture):
    start = mixture.start(rng)
    P, J = mixture.bodies.total_momenta(start)
    end = run(mixture, SIER4G, start, 0.003, 500)
    P_end, J_end = mixture.bodies.total_momenta(end)
    # 500 steps, some 10^3 operations each: a random walk of roundings of the largest momentum and of its moment.
    size = np.abs(start.p).max()
    assert np.abs(P_end - P).max() < 1e-13 * size
    assert np.abs(J_end - J).max() < 1e-13 * size * np.abs(end.q).max()
    assert orthogonality_error(end.A) < 1e-13


def test_energy_error_falls_with_the_fourth_order_and_does_not_drift(rng, waters):
    start = waters.start(rng)
    energy = waters.energy(start)

    def errors(h, steps):
        _, operators = operators_of(waters)
        step = stepper(SIER4G, operators, h)
        state, found = start, []
        for _ in range(steps):
            state = step(state)
            found.append(waters.energy(state) - energy)
        return np.abs(found)

    wide, narrow = errors(0.002, 200), errors(0.001, 400)
    assert np.log2(wide.max() / narrow.max()) == pytest.approx(4, abs=0.4)
    # A drift would show as an error that grows with time.
    assert wide[100:].max() < 3 * wide[:100].max()


def test_force_evaluations(rng, waters):
    forces, operators = operators_of(waters)
    step = stepper(SIER4G, operators, 0.002)
    state = waters.start(rng)
    assert SIER4G.force_evaluations == 3
    assert SIER4G.reuses_force
    for done in range(1, 6):
        state = step(state)
        # The first step has no force from the one before.
        assert forces.evaluations == 3 * done + 1


# --- in OpenMM --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cluster():
    topology, positions, system = cluster_system(8)
    return system, relaxed(topology, positions, system)


def thermostat(friction, h=0.004):
    integrator = SIERLangevinIntegrator(297.0, friction, h, scheme=SIER4G)
    integrator.setRandomNumberSeed(5)
    return integrator


def test_on_the_reference_platform_momenta_are_constant_and_energy_better_than_with_sier4(cluster):
    system, point = cluster
    swings = {}
    # Both have a force for every 2 fs.
    for scheme, h in ((SIER4G, 0.006), (SIER4, 0.008)):
        integrator = SIERIntegrator(h, scheme)
        context = context_at(system, integrator, point)
        bodies, start = integrator.bodies, integrator.getBodyState()
        totals = []
        for _ in range(40):
            integrator.step(1)
            totals.append(sum(energies(context)))
        end = integrator.getBodyState()
        size = np.abs(start.p).max()
        for before, after in zip(bodies.total_momenta(start), bodies.total_momenta(end), strict=True):
            # Forces of the Reference platform sum to zero to 1e-16 of the largest, over 120 kicks.
            assert np.abs(after - before).max() < 1e-12 * size * max(1, np.abs(start.q).max())
        swings[scheme.name] = np.std(totals)
    assert swings["SIER4G"] < 0.5 * swings["SIER4"]


def test_thermostatted_form():
    bathed = SIER4G.with_bath()
    assert [stage.operator for stage in bathed.stages] == [BATH, *(stage.operator for stage in SIER4G.stages), BATH]
    assert bathed.is_palindrome
    assert bathed.force_evaluations == 3
    assert bathed.without(BATH).stages == SIER4G.stages


def test_without_friction_the_thermostat_is_the_nve_trajectory_bit_for_bit(cluster):
    system, point = cluster
    ends = []
    for integrator in (thermostat(0.0), SIERIntegrator(0.004, SIER4G)):
        context = context_at(system, integrator, point)
        integrator.step(50)
        ends.append(phase_point(context))
    assert np.array_equal(ends[0][0], ends[1][0])
    assert np.array_equal(ends[0][1], ends[1][1])


def test_with_the_bath_total_energy_less_heat_is_as_constant_as_in_nve(cluster):
    system, point = cluster
    swings = {}
    for friction in (0.0, 5.0):
        integrator = thermostat(friction)
        context = context_at(system, integrator, point)
        conserved = []
        for _ in range(100):
            integrator.step(1)
            conserved.append(sum(energies(context)) - integrator.getHeat()._value)
        swings[friction] = np.ptp(conserved)
    assert integrator.getHeat()._value != 0
    # The bath exchanges energy of the order of kT = 2.5 kJ/mol a degree of freedom; the trajectories differ.
    assert swings[5.0] < 4 * swings[0.0]
    assert swings[0.0] < 0.1


def test_bodies_of_the_integrator_are_those_of_the_system(cluster):
    """Two Contexts from one point agree: the scheme keeps nothing between them."""
    system, point = cluster
    bodies = RigidBodies.from_system(system)
    ends = []
    for given in (None, bodies):
        integrator = SIERIntegrator(0.006, SIER4G, given)
        context = context_at(system, integrator, point)
        integrator.step(5)
        ends.append(phase_point(context)[0])
    assert np.array_equal(*ends)


def test_only_gradient_kicks_have_a_shift():
    with pytest.raises(ValueError, match="only a 'gradient kick' has a shift"):
        Scheme("wrong", ((KICK, 0.5, 0.1), (DRIFT, 1.0), (KICK, 0.5, 0.1)))
