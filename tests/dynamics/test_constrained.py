"""Schemes on constrained and flexible molecules: order, reversal, conservation, temperature, nested fast forces."""

from dataclasses import replace
from functools import cache
from unittest.mock import Mock

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov

from openmm_sier import SIER2, SIER4, BodyState, RigidBodies
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.constrained import (
    DisplacedForces,
    constrained_bath,
    constrained_operators,
    inner_drifts,
)
from openmm_sier.dynamics.operators import advance, body_operators, calls, stepper
from openmm_sier.dynamics.plan import Bath, Drift, Inner, Resolution, plan_step
from openmm_sier.dynamics.schemes import CATALOGUE, SIER4G, SIER4P
from openmm_sier.dynamics.tally import Tally
from openmm_sier.dynamics.thermostat import OrnsteinUhlenbeck
from tests.support.flexible import KAHAN_LI, Points, cage, chains, ring, rotor
from tests.support.flexible_systems import system_of

SYSTEMS = {"XH3": lambda: rotor(3), "XH2": lambda: rotor(2), "ring": ring, "cage": cage, "chains": chains}
TIME = 0.024


@cache
def solved(name, time=TIME):
    """A system, its start, and where the equations of motion take it."""
    system = SYSTEMS[name]()
    start = system.start(np.random.default_rng(20070518))
    return system, start, system.exact_flow(start, time)


def run(operators, scheme, state, h, steps, **options):
    step = stepper(scheme, operators, h, resolution=Resolution(KAHAN_LI), **options)
    for _ in range(steps):
        state = step(state)
    return state


def distance(one, other):
    """Largest difference of two states, positions and momenta each in their own scale."""
    return max(np.abs(one.q - other.q).max() / 0.1, np.abs(one.p - other.p).max() / 5)


def of_positions(compute):
    """Forces on points, from a function of their positions alone."""
    return lambda q, A: (compute(q), np.zeros_like(q))


def points_of(system, **options):
    forces = of_positions(system.forces)
    return constrained_operators(system.bodies, forces, system.constraints(), **options)


def slope(errors):
    return np.log2(errors[0] / errors[1])


# --- gradient kicks ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [lambda: rotor(2), lambda: rotor(4), ring, cage])
def test_forces_of_a_gradient_kick_exert_the_torque_of_the_displaced_ones(rng, make):
    """They are the displaced forces without their part along the bonds, and a rotation of the molecule."""
    system = make()
    constraints, state = system.constraints(), system.start(rng)
    q = constraints.displaced(state.q, state.p, 0.01)
    F = 1000 * rng.normal(size=q.shape)
    result = DisplacedForces(constraints, None)(state.q, q, F)
    expected = np.cross(q, F, axis=0).sum(axis=1)
    # Sums over some ten atoms; the rotation is that of the inverse moments of inertia, whose condition is below 10.
    error = 1e-13 * np.abs(F).max()
    assert np.abs(result.sum(axis=1) - F.sum(axis=1)).max() < error
    assert np.abs(np.cross(state.q, result, axis=0).sum(axis=1) - expected).max() < error
    added = result - constraints.project(q, F)
    assert np.abs(added).max() > 1e-3 * np.abs(F).max()
    rates = added / system.masses
    apart = state.q[:, :, None] - state.q[:, None, :]
    # A rigid rotation changes no distance.
    assert np.abs((apart * (rates[:, :, None] - rates[:, None, :])).sum(axis=0)).max() < 1e-13 * np.abs(rates).max()


# --- order ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("scheme", CATALOGUE.values(), ids=lambda scheme: scheme.name)
def test_every_scheme_keeps_its_order(name, scheme):
    """Against the equations of motion with multipliers: rotors in a strong field, a ring, a cage, two chains."""
    system, start, exact = solved(name)
    operators = points_of(system)
    errors = [distance(run(operators, scheme, start, TIME / n, n), exact) for n in (12, 24)]
    # The next term, smaller by h^2, changes the slope by a few hundredths.
    assert slope(errors) == pytest.approx(scheme.order, abs=0.15)


# --- reversal and conservation ----------------------------------------------------------------------------------------


def without_field(name):
    system = SYSTEMS[name]()
    system.field = 0.0
    return system, system.start(np.random.default_rng(4))


def totals(state):
    return state.p.sum(axis=1), np.cross(state.q, state.p, axis=0).sum(axis=1)


# --- beside rigid bodies ----------------------------------------------------------------------------------------------


def with_water():
    """Two chains without springs and a rigid water; and the same as points, the water held by constraints."""
    chain = chains()
    system, x = system_of(chain, waters=1)
    masses = [system.getParticleMass(i)._value for i in range(len(x))]
    constrained = [system.getConstraintParameters(i) for i in range(system.getNumConstraints())]
    lengths = [length._value for _, _, length in constrained]
    atoms = Points(x, masses, [(i, j) for i, j, _ in constrained], lengths, molecules=[*chain.molecules, 2, 2, 2])
    bodies = RigidBodies.from_system(system)
    return atoms, bodies, bodies.constraints


def body_state(bodies, atoms, start):
    """The bodies where the atoms are."""
    q, A = bodies.fit(start.q.T)
    p, L = bodies.momenta(np.ascontiguousarray((start.p / atoms.masses).T), A)
    return BodyState(q, p, A, L)


def body_forces(atoms, bodies):
    def compute(q, A):
        x = bodies.place(q, A, np.empty((bodies.n_particles, 3)))
        return bodies.forces_and_torques(np.ascontiguousarray(atoms.forces(x.T).T), A)

    return compute


@pytest.mark.parametrize("scheme", [SIER2, SIER4, SIER4G, SIER4P], ids=lambda scheme: scheme.name)
def test_rigid_and_constrained_molecules_together(rng, scheme):
    """The oracle knows atoms and constraints alone: the rigid water is three atoms with three constraints."""
    atoms, bodies, constraints = with_water()
    start = atoms.start(rng)
    state = body_state(bodies, atoms, start)
    exact = atoms.exact_flow(start, TIME).q.T
    operators = constrained_operators(bodies, body_forces(atoms, bodies), constraints)
    errors = []
    for n in (12, 24):
        end = run(operators, scheme, state, TIME / n, n)
        errors.append(np.abs(bodies.place(end.q, end.A, np.empty(exact.shape)) - exact).max())
    assert slope(errors) == pytest.approx(scheme.order, abs=0.2)


# --- temperature ------------------------------------------------------------------------------------------------------


def test_projected_noise_is_thermal():
    """Each tangent direction has k_B T, constrained ones none, and the heat is what the kinetic energy gained."""
    system = cage()
    constraints, bodies = system.constraints(), system.bodies
    start = system.start(np.random.default_rng(1))
    tally = Tally(3)
    bath = constrained_bath(OrnsteinUhlenbeck(300.0, 5.0, 5.0).operator(bodies, tally), constraints, tally)
    state, samples = start, []
    kinetic = [sum(bodies.kinetic_energies(start))]
    for _ in range(4000):
        state = bath(state, 0.3)
        samples.append((state.p / np.sqrt(system.masses)).ravel())
        kinetic.append(sum(bodies.kinetic_energies(state)))
    assert tally.heat == pytest.approx(kinetic[-1] - kinetic[0], abs=1e-9)
    values = np.linalg.eigvalsh(np.cov(np.array(samples).T) / (GAS_CONSTANT * 300.0))
    rank = constraints.rank(start.q)
    assert len(values) - rank == 18 - 10
    assert np.abs(values[:rank]).max() < 1e-12
    # 4000 draws that forget exp(-1.5) = 0.22 a draw: variances known to 2.3 %; the eigenvalues of 8 spread by
    # some sqrt(8 / 4000).
    assert np.abs(values[rank:] - 1).max() < 0.15
    freedoms = len(values) - rank
    assert 2 * np.mean(kinetic[1:]) / (freedoms * GAS_CONSTANT * 300.0) == pytest.approx(1.0, abs=0.03)


# --- nested fast forces -----------------------------------------------------------------------------------------------


def nested(system, fast=None, slow=None):
    """Table with the slow forces of a system in kicks, and its fast ones in drifts."""
    constraints = system.constraints()
    fast, slow = fast or of_positions(system.fast_forces), slow or of_positions(system.slow_forces)
    table = constrained_operators(system.bodies, slow, constraints, groups=system.molecules)
    within = constrained_operators(system.bodies, fast, constraints)
    return table | {Inner: inner_drifts(table[Drift], np.arange(system.bodies.n), within)}


@pytest.mark.parametrize("is_constrained", [True, False], ids=["constrained", "flexible"])
@pytest.mark.parametrize("outer", [SIER4, SIER4G, SIER4P], ids=lambda scheme: scheme.name)
def test_nested_schemes_are_of_fourth_order(outer, is_constrained):
    """Stiff bonds and angles inside the drift, forces between the molecules and a field outside."""
    system = chains(is_constrained)
    start = system.start(np.random.default_rng(7))
    time = 0.012
    exact = system.exact_flow(start, time)
    errors = []
    for n in (8, 16):
        end = run(nested(system), outer, start, time / n, n, longest_inner_step=outer.longest_drift / 2)
        errors.append(distance(end, exact))
    assert slope(errors) == pytest.approx(4.0, abs=0.3)


def test_nested_steps_reverse_and_conserve():
    system, start = without_field("chains")
    there = run(nested(system), SIER4G, start, 0.004, 30, longest_inner_step=0.2)
    back = run(nested(system), SIER4G, there, -0.004, 30, longest_inner_step=0.2)
    assert distance(back, start) < 1e-8
    for results, expected in zip(totals(there), totals(start), strict=True):
        assert np.abs(results - expected).max() < 3e-13 * np.abs(start.p).max()


def test_fast_forces_at_the_end_of_a_drift_serve_the_next():
    system, start, _ = solved("chains")
    fast, slow = Mock(wraps=of_positions(system.fast_forces)), Mock(wraps=of_positions(system.slow_forces))
    step = stepper(SIER4G, nested(system, fast, slow), 0.004, longest_inner_step=0.25)
    # The cache of the start may have the forces of another test.
    state = step(replace(start))
    # Two drifts of 2 fs in two inner steps of three forces each, and the force at the start.
    assert fast.call_count == 12 + 1
    for done in range(2, 6):
        state = step(state)
        assert fast.call_count == 12 * done + 1
        assert slow.call_count == 3 * done + 1
    # Other positions, equal or not, are computed anew.
    step(replace(state, q=state.q.copy()))
    assert fast.call_count == 12 * 6 + 2


@pytest.mark.parametrize("longest", [0.001, 0.003, 0.005])
def test_harmonic_averages_around_a_bath_are_exact(longest):
    """A C=O bond of 19 fs within drifts of 8 fs: <q^2> and <p^2> at the end of steps, from the linear map of a step."""
    k, h, friction = (2 * np.pi / 0.019) ** 2, 0.008, 5.0
    bodies = Points(np.zeros((1, 3)), [1.0]).bodies
    within = body_operators(bodies, of_positions(lambda q: -k * q))
    table = body_operators(bodies, of_positions(np.zeros_like))
    table |= {Inner: inner_drifts(table[Drift], [0], within)}
    operations = plan_step(SIER2.with_bath(), longest / h, updates=False, projects=False).operations
    bath = next(i for i, operation in enumerate(operations) if isinstance(operation, Bath))

    def linear(part):
        made, rows = calls(part, table, h), []
        for q, p in ((1.0, 0.0), (0.0, 1.0)):
            start = BodyState(np.full((3, 1), q), np.full((3, 1), p), np.eye(3)[:, :, None], np.zeros((3, 1)))
            moved = advance(made, start)
            rows.append([moved.q[0, 0], moved.p[0, 0]])
        return np.array(rows).T

    there, away = linear(operations[:bath]), linear(operations[bath + 1 :])
    damping = np.exp(-friction * h)
    noise = away @ np.diag([0, 1 - damping**2]) @ away.T
    covariance = solve_discrete_lyapunov(away @ np.diag([1, damping]) @ there, noise)
    # Rounding of a covariance that takes some hundred steps to be forgotten. Were the bath between whole steps, <q^2>
    # would be off by (omega e)^2/4: 3 % with the shortest inner steps, of 0.9 fs.
    assert k * covariance[0, 0] == pytest.approx(1, abs=1e-10)
    assert covariance[1, 1] == pytest.approx(1, abs=1e-10)
