"""Bodies that move along and about some axes only, beside the integrated equations of motion of bearings."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from openmm_sier import Motion
from openmm_sier.dynamics.bodies import BodySet, BodyState
from openmm_sier.dynamics.operators import body_operators, stepper
from openmm_sier.dynamics.rotation import mrdl, rattle, sej4
from openmm_sier.dynamics.schemes import SIER2, SIER4, SIER4G
from openmm_sier.dynamics.species import Species
from openmm_sier.dynamics.vectors import body_frame
from tests.support.oracles import random_attitudes, skew

NONE, ALL = (False, False, False), (True, True, True)

#: A body with three different moments.
BLOB = [[0.3, 0, 0], [0, 0.5, 0], [0, 0.1, 0.4], [-0.2, -0.3, 0.1]], [3.0, 2.0, 1.0, 4.0]

#: A body whose two smaller moments are equal, and whose sites are off its axis.
TOP = [[0.4, 0, 0], [0, 0.4, 0], [-0.4, 0, 0], [0, -0.4, 0], [0, 0, 0.3]], [1.0, 1.0, 1.0, 1.0, 3.0]

ROD = [[-0.3, 0, 0], [0.1, 0, 0], [0.4, 0, 0]], [3.0, 2.0, 1.0]

CASES = {
    "rotating": (BLOB, Motion.ROTATING),
    "translating": (BLOB, Motion.TRANSLATING),
    "pinned": (BLOB, Motion.PINNED),
    "in plane": (BLOB, Motion.IN_PLANE),
    "rod in plane": (ROD, Motion.IN_PLANE),
    "about the middle axis": (BLOB, Motion(ALL, (False, True, False))),
    "about two equal axes": (TOP, Motion(ALL, (True, True, False))),
    "rotating on a line": (BLOB, Motion((True, False, False))),
    "rotating rod": (ROD, Motion.ROTATING),
}


def set_of(case):
    (coordinates, masses), motion = CASES[case]
    shape = Species.from_coordinates([range(len(masses))], masses, coordinates)
    return BodySet([Species(shape.atoms, shape.masses, shape.sites, shape.moments, motion=motion)], len(masses))


def atom_forces(x):
    """Forces on atoms, (k, 3), of an energy that is not harmonic and pulls along and about all axes."""
    weights = np.array([1.0, -0.5, 0.7, 0.3, -0.8])[: len(x), None]
    a, b, c = x.T
    gradient = np.stack([2 * a + b * c + 3 * a * c, a * c + 4 * b - b * b, a * b + c + 1.5 * a * a], axis=1)
    return -weights * gradient - 2 * x


def forces_on(bodies):
    def forces(q, A):
        return bodies.forces_and_torques(atom_forces(bodies.place(q, A, np.zeros((bodies.n_particles, 3)))), A)

    return forces


def start(bodies, rng):
    """A state whose last axis is along z where the body moves in the plane."""
    A = random_attitudes(rng, 1)
    if bodies.species[0].motion == Motion.IN_PLANE:
        A = np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1.0]])[:, :, None]
    velocities = rng.normal(size=(bodies.n_particles, 3))
    p, L = bodies.momenta(velocities, A)
    return BodyState(rng.normal(size=(3, 1)), p, A, L)


def by_dop853(bodies, state, t):
    """Centre and attitude after a time: p and L~ change by what the bearings leave of forces and of Euler's torque."""
    kind = bodies.species[0]
    moves, turns = np.array(kind.motion.translations), (kind.moments > 0) & kind.motion.rotations

    def derivative(_, y):
        q, p, body_L, A = y[:3], y[3:6], y[6:9], y[9:].reshape(3, 3)
        arms = kind.sites.T @ A
        f = atom_forces(q + arms)
        omega = np.divide(body_L, kind.moments, out=np.zeros(3), where=turns)
        torque = A @ np.cross(arms, f).sum(axis=0) + np.cross(body_L, omega)
        return np.concatenate([p / kind.mass, moves * f.sum(axis=0), turns * torque, (-skew(omega) @ A).ravel()])

    body_L = body_frame(state.A, state.L)
    first = np.concatenate([state.q, state.p, body_L], axis=None)
    solution = solve_ivp(derivative, (0, t), np.append(first, state.A), method="DOP853", rtol=1e-12, atol=1e-13)
    return solution.y[:3, -1], solution.y[9:, -1].reshape(3, 3)


def held(bodies, state):
    """Momenta and angular momenta along axes along which the bodies do not move."""
    return state.p[~bodies.translates], body_frame(state.A, state.L)[~bodies.turns]


@pytest.mark.parametrize("scheme", [SIER2, SIER4, SIER4G], ids=lambda scheme: scheme.name)
@pytest.mark.parametrize("case", CASES)
def test_trajectories_have_the_order_of_the_scheme(rng, case, scheme):
    bodies = set_of(case)
    first, time = start(bodies, rng), 0.5
    q, A = by_dop853(bodies, first, time)
    errors = []
    for number in (10, 20):
        step = stepper(scheme, body_operators(bodies, forces_on(bodies)), time / number)
        state = first
        for _ in range(number):
            state = step(state)
        # A rotation about the axis of a rod does not show.
        rows = slice(0, 1) if case == "rotating rod" else slice(0, 3)
        errors.append(max(np.abs(state.q[:, 0] - q).max(), np.abs(state.A[:, :, 0] - A)[rows].max()))
        p, L = held(bodies, state)
        assert not p.any()
        # Rounding of L, whose size is of order 1.
        assert np.abs(L).max(initial=0.0) < 1e-14 * number
    if case == "pinned":
        assert errors == [0, 0]
    else:
        # Terms of the next order make a hundredth at these steps, and the oracle is good to a hundredth of the errors.
        assert np.log2(errors[0] / errors[1]) == pytest.approx(scheme.order, abs=0.1)


@pytest.mark.parametrize("rotation", [mrdl, sej4, rattle], ids=lambda rotation: rotation.__name__)
def test_other_rotations_turn_hinged_bodies_too(rng, rotation):
    bodies = set_of("in plane")
    first, time = start(bodies, rng), 0.5
    ends = []
    for chosen in (rotation, None):
        options = {} if chosen is None else {"rotation": chosen}
        step = stepper(SIER2, body_operators(bodies, forces_on(bodies), **options), time / 100)
        state = first
        for _ in range(100):
            state = step(state)
        ends.append(state.A)
    # RATTLE turns by the angle whose sine is h L/I. Of angles of up to 0.03 it is too far by a sixth of the cube.
    assert np.abs(ends[0] - ends[1]).max() < (100 * 0.03**3 / 6 if rotation is rattle else 1e-13)


@pytest.mark.parametrize("time", [1e-3, 0.1, 30.0, 1e4])
@pytest.mark.parametrize("case", CASES)
def test_free_motion_is_uniform_over_any_time(rng, case, time):
    bodies = set_of(case)
    first = start(bodies, rng)
    drifted = stepper(SIER2, body_operators(bodies, lambda q, A: (np.zeros_like(q), np.zeros_like(q))), time)(first)
    assert np.isfinite(drifted.A).all()
    np.testing.assert_array_equal(drifted.L, first.L)
    turns = bodies.turns[:, 0]
    if turns.sum() == 1:
        axis = turns.argmax()
        # An axis in bearings stays to rounding, also of the middle moment, about which free rotation is unstable.
        assert np.abs(drifted.A[axis] - first.A[axis]).max() < 1e-14
        angle = body_frame(first.A, first.L)[axis, 0] / bodies.moments[axis, 0] * time
        other = (axis + 1) % 3
        cosine = float(drifted.A[other, :, 0] @ first.A[other, :, 0])
        # Rounding of the angle, and of its cosine.
        assert abs(cosine - np.cos(angle)) < 1e-15 * (10 + abs(angle))


def test_bearings_take_up_forces_and_momenta(rng):
    bodies = set_of("in plane")
    A = start(bodies, rng).A
    free = BodySet([Species.from_coordinates(bodies.species[0].atoms, BLOB[1], BLOB[0])], bodies.n_particles)
    vectors = rng.normal(size=(bodies.n_particles, 3))
    for method in ("forces_and_torques", "momenta"):
        whole, left = getattr(free, method)(vectors, A), getattr(bodies, method)(vectors, A)
        np.testing.assert_array_equal(left[0], whole[0] * [[1], [1], [0]])
        np.testing.assert_allclose(left[1], whole[1] * [[0], [0], [1]], atol=1e-15)


def test_the_last_axis_of_a_line_is_as_near_to_z_as_it_can_be():
    bodies = set_of("rod in plane")
    sites = bodies.species[0].sites.T
    for line in ([1, 0, 0], [0.6, -0.8, 0], [-1, 2, 1e-4], [1, 2, -3], [-3, 1, 5]):
        line = np.array(line) / np.linalg.norm(line)
        A = bodies.fit(sites[:, :1] * line)[1][:, :, 0]
        last = np.array([0, 0, 1]) - line[2] * line
        # Rounding of the direction from three atoms.
        np.testing.assert_allclose(A[0], line, atol=1e-14)
        np.testing.assert_allclose(A[2], last / np.linalg.norm(last), atol=1e-14)
        np.testing.assert_allclose(A @ A.T, np.eye(3), atol=1e-14)
    upright = bodies.fit(sites[:, :1] * [0, 0, 1.0])[1][:, :, 0]
    np.testing.assert_allclose(upright @ upright.T, np.eye(3), atol=1e-14)


@pytest.mark.parametrize(("case", "dof"), [("rotating", 3), ("pinned", 0), ("in plane", 3), ("rotating on a line", 4)])
def test_degrees_of_freedom_are_those_of_the_motion(case, dof):
    assert set_of(case).dof == dof


def test_a_body_turns_about_all_axes_or_one_or_two_with_equal_moments():
    CASES["wrong"] = BLOB, Motion(ALL, (True, True, False))
    try:
        with pytest.raises(ValueError, match="equal moments"):
            set_of("wrong")
    finally:
        del CASES["wrong"]


@pytest.mark.parametrize("values", [(1, 1, 0), (True, True), "yes", None, (True, None, False)])
def test_a_motion_has_three_values_for_each(values):
    with pytest.raises(TypeError, match="rotations must be"):
        Motion(rotations=values)
