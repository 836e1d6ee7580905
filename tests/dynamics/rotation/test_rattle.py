"""RATTLE's free rotation against RATTLE of the atoms, and conserved quantities."""

import itertools

import numpy as np
import pytest
from scipy.optimize import root

from openmm_sier import BodyState, RigidBodies
from openmm_sier.dynamics.constraints import ConstraintError
from openmm_sier.dynamics.rotation import exact, rattle
from tests.support.molecules import CARBON_DIOXIDE, GEOMETRIES, METHANE, WATER, species
from tests.support.oracles import orthogonality_error, random_attitudes

H = 0.002


def one(kind, rng):
    """One molecule as a body, and as atoms: masses, positions and velocities of a free rotation."""
    n = len(GEOMETRIES[kind][0])
    bodies = RigidBodies([species(kind, np.arange(n)[None])], n)
    A, zero = random_attitudes(rng, 1), np.zeros((3, 1))
    L = np.einsum("abn,an->bn", A, rng.normal(size=(3, 1)) * np.sqrt(2.5 * bodies.moments))
    state = BodyState(zero, zero, A, L)
    velocities = bodies.move(state, np.zeros((n, 3)))
    return bodies, state, np.array(GEOMETRIES[kind][0]), bodies.place(zero, A, np.zeros((n, 3))), velocities


def positions_by_constraint_forces(masses, x, v, h):
    """Positions after a step in which forces along lines between atoms hold all distances."""
    pairs = np.array(list(itertools.combinations(range(len(masses)), 2)))
    lines = x[pairs[:, 0]] - x[pairs[:, 1]]
    lengths = (lines**2).sum(axis=1)

    def moved(multipliers):
        pulls = np.zeros_like(x)
        np.add.at(pulls, pairs[:, 0], multipliers[:, None] * lines)
        np.add.at(pulls, pairs[:, 1], -multipliers[:, None] * lines)
        return x + h * v + pulls / masses[:, None]

    def errors(multipliers):
        y = moved(multipliers)
        return ((y[pairs[:, 0]] - y[pairs[:, 1]]) ** 2).sum(axis=1) / lengths - 1

    solution = root(errors, np.zeros(len(pairs)), method="lm", options={"xtol": 1e-15, "ftol": 1e-15})
    assert np.abs(solution.fun).max() < 1e-13
    return moved(solution.x)


@pytest.mark.parametrize("kind", [WATER, METHANE, "handed"])
def test_it_is_rattle_of_the_atoms(rng, kind):
    """Constraint forces along lines between atoms lead to the same positions."""
    bodies, state, masses, x, v = one(kind, rng)
    A, _ = rattle(state.A, state.L, bodies.moments, H)
    expected = positions_by_constraint_forces(masses, x, v, H)
    positions = bodies.place(state.q, A, np.zeros_like(x))
    # Of 0.1 nm, to what the solver of the oracle leaves of distances. The exact rotation is 4e-9 nm or more away.
    assert np.abs(positions - expected).max() < 1e-13
    A_exact, _ = exact(state.A, state.L, bodies.moments, H)
    assert np.abs(bodies.place(state.q, A_exact, np.zeros_like(x)) - expected).max() > 1e-9


def test_a_linear_body_moves_along_the_tangent_and_back_to_its_length(rng):
    """With only ends the step is known: |sin| of the turn is h L/I."""
    bodies, state, *_ = one(CARBON_DIOXIDE, rng)
    A, _ = rattle(state.A, state.L, bodies.moments, H)
    sine = np.linalg.norm(np.cross(A[0, :, 0], state.A[0, :, 0]))
    assert sine == pytest.approx(H * np.linalg.norm(state.L) / bodies.moments.max(), rel=1e-12)


def test_points_and_bodies_at_rest_stay_as_they_are(rng):
    A = random_attitudes(rng, 2)
    moments = np.array([[0.0, 1.0], [0.0, 2.0], [0.0, 2.5]])
    assert np.array_equal(rattle(A, np.zeros((3, 2)), moments, H)[0], A)


def test_reversal(rng):
    moments = np.array([0.0061457, 0.0115511, 0.0176968])
    A = random_attitudes(rng, 200)
    L = np.einsum("abn,an->bn", A, rng.normal(size=(3, 200)) * np.sqrt(2.5 * moments)[:, None])
    there, same = rattle(A, L, moments, H)
    assert np.array_equal(same, L)
    # Rounding of matrices of order 1, and of the iteration.
    assert np.abs(rattle(there, -L, moments, H)[0] - A).max() < 5e-15
    assert orthogonality_error(there).max() < 2e-15


def test_a_step_without_a_solution(rng):
    A = random_attitudes(rng, 1)
    with pytest.raises(ConstraintError, match="body 0 in a step of 10"):
        rattle(A, np.ones((3, 1)), np.array([1.0, 2.0, 2.5]), 10.0)
