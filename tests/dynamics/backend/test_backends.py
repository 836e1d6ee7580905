"""The backends: Numba gives what NumPy gives, and NumPy alone is enough."""

import contextlib
import os
from dataclasses import replace

import numpy as np
import pytest

from openmm_sier.dynamics import backend, operators, rotation
from openmm_sier.dynamics.backend import numba_backend
from openmm_sier.dynamics.bodies import BodyState, NotFiniteError, RigidBodies
from openmm_sier.dynamics.constrained import DisplacedForces
from openmm_sier.dynamics.ledger import Ledger
from openmm_sier.dynamics.schemes import SIER4G
from openmm_sier.dynamics.thermostat import OrnsteinUhlenbeck
from tests.support import flexible
from tests.support.steps import constant_torques, with_a_fast_body
from tests.support.subprocesses import run_python

#: Sums and products that are contracted to fused operations, or not, differ by rounding of terms of order one; the
#: formulas have some 300 of them.
ROUNDING = 1e-14


def both(function):
    """What NumPy gives, and what Numba gives."""
    with backend.using(backend.NUMPY):
        plain = function()
    if backend.active() is backend.NUMPY:
        raise RuntimeError("this test needs Numba: pip install 'openmm-sier[fast]'")
    return plain, function()


def test_bodies_at_rest_and_out_of_range_agree():
    A = np.repeat(np.eye(3)[:, :, None], 4, axis=2)
    L = np.array([[0.0, 1e-200, 1e150, 1.0], [0.0, 0.0, 1e150, 2.0], [0.0, 0.0, 0.0, 3.0]])
    plain, fast = both(lambda: rotation.exact(A, L, (0.6, 1.1, 1.7), 1e-3)[0])
    # The third body turns by 1e147 rad, of which nothing is known but that it is a rotation.
    assert np.abs(plain - fast)[:, :, [0, 1, 3]].max() < ROUNDING
    assert np.abs(np.einsum("ijn,kjn->ikn", fast, fast) - np.eye(3)[:, :, None]).max() < ROUNDING


def test_steps_agree(mixture):
    bodies, state, forces = mixture
    state = with_a_fast_body(bodies, state)

    def after_a_step():
        flows = operators.body_operators(bodies, constant_torques(bodies, forces))
        return operators.stepper(SIER4G, flows, 0.004)(state)

    plain, fast = both(after_a_step)
    assert not np.array_equal(plain.A, state.A)
    for name in "qpAL":
        one, other = getattr(plain, name), getattr(fast, name)
        # Some stages, of the fast body by angles up to 30, each rounded.
        assert np.abs(one - other).max() < 100 * ROUNDING * np.abs(one).max(), name


def test_kicks_from_displaced_points_agree(mixture, rng):
    """A force that does not depend on positions has no lever there, since it displaces along itself."""
    _, state, _ = mixture
    F, tau, apart = rng.normal(size=(3, *state.q.shape))

    def kicked():
        return backend.active().kick(state.p, state.L, F, tau, 0.1, state.q, state.q + apart)

    for one, other in zip(*both(kicked), strict=True):
        assert np.abs(one - other).max() < ROUNDING * np.abs(one).max()


def test_baths_agree(mixture):
    bodies, state, _ = mixture

    def bathed():
        ledger = Ledger(5)
        after = OrnsteinUhlenbeck(300.0, 3.0, 7.0).operator(bodies, ledger)(state, 0.05)
        return after.p, after.L, np.array([ledger.heat])

    for one, other in zip(*both(bathed), strict=True):
        # Of a body there are some ten terms of each momentum, and the heat is a sum over all.
        assert np.abs(one - other).max() < 10 * ROUNDING * np.abs(one).max()


def test_atoms_and_sums_over_them_agree(mixture):
    bodies, state, forces = mixture

    def placed():
        return bodies.place(state.q, state.A, np.zeros((bodies.n_particles, 3)))

    def moved():
        return bodies.move(state, np.zeros((bodies.n_particles, 3)))

    for function, terms in (
        (placed, 1),
        (moved, 10),
        (lambda: np.stack(bodies.forces_and_torques(forces, state.A)), 10),
    ):
        plain, fast = both(function)
        assert np.count_nonzero(plain) > bodies.n
        # Sums over the few atoms of a body.
        assert np.abs(plain - fast).max() < terms * ROUNDING * np.abs(plain).max()


def test_calls_of_a_step_do_not_grow_with_the_kinds_of_bodies(mixture, monkeypatch):
    """Beside few bodies it is calls that take the time."""
    bodies, state, forces = mixture
    calls, shared = [], numba_backend._shared

    def counted(loop):
        calls.append(loop.__name__)
        return shared(loop)

    monkeypatch.setattr(numba_backend, "_shared", counted)
    flow = operators.drift(bodies)
    assert len(bodies.species) > 3
    bodies.place(state.q, state.A, np.zeros((bodies.n_particles, 3)))
    bodies.forces_and_torques(forces, state.A)
    bodies.move(flow(state, 0.001), np.zeros((bodies.n_particles, 3)))
    assert calls == ["place", "collect", "drift", "move"]


def test_no_bodies_leave_all_particles_alone():
    """As where all particles are fixed."""
    bodies, vectors, none = RigidBodies([], 2), np.ones((2, 3)), np.empty((3, 0))

    def after_a_step():
        state = operators.drift(bodies)(BodyState(none, none, np.empty((3, 3, 0)), none), 0.001)
        p, L = bodies.momenta(vectors, state.A)
        placed = bodies.place(state.q, state.A, vectors.copy())
        return placed, bodies.move(replace(state, p=p, L=L), vectors.copy())

    for found in both(after_a_step):
        assert all(np.array_equal(each, vectors) for each in found)


def test_what_is_not_finite_is_found_by_both(mixture):
    bodies, state, forces = mixture
    forces[bodies.atoms_of(7)[0], 1] = np.nan
    far = state.q.copy()
    far[2, 9] = np.inf
    # An attitude can overflow where the centres do not.
    turned = state.A.copy()
    turned[1, 2, 11] = np.nan

    def found():
        with pytest.raises(NotFiniteError) as force:
            bodies.forces_and_torques(forces, state.A)
        with pytest.raises(NotFiniteError) as place:
            bodies.place(far, state.A, np.zeros((bodies.n_particles, 3)))
        with pytest.raises(NotFiniteError) as turn:
            bodies.place(state.q, turned, np.zeros((bodies.n_particles, 3)))
        return force.value.body, place.value.body, turn.value.body

    assert both(found) == ((7, 9, 11), (7, 9, 11))


def test_kicks_of_constrained_groups_agree(rng):
    """Kicks at displaced positions turn groups of every shape, among them a pair, which is a line."""
    system = flexible.mixture()
    constraints, state = system.constraints(), system.start(rng)
    q = constraints.displaced(state.q, state.p, 0.01)
    F = 1000 * rng.normal(size=q.shape)
    plain, fast = both(lambda: DisplacedForces(constraints, None)(state.q, q, F))
    turned = constraints.project(state.q, plain - constraints.project(q, F))
    assert np.abs(turned).max() > 1e-3 * np.abs(plain).max()
    # Rounding times the condition of the cage.
    assert np.abs(plain - fast).max() < 100 * ROUNDING * np.abs(plain).max()


STEP_OF_EVERYTHING = """
import sys
import numpy as np
from openmm_sier.dynamics import backend
from openmm_sier.dynamics.constrained import constrained_operators
from openmm_sier.dynamics.operators import CachedForces, stepper
from openmm_sier.dynamics.schemes import SIER4G
from tests.support.flexible import mixture

system = mixture()
forces = CachedForces(lambda q, A: (system.forces(q), 0 * q))
with backend.using(backend.NUMPY):
    operators = constrained_operators(system.bodies, forces, system.constraints())
    start = system.start(np.random.default_rng(1))
    stepper(SIER4G, operators, 0.001)(start)
    print("numba" in sys.modules)
stepper(SIER4G, operators, 0.001)(start)
print("numba" in sys.modules)
"""


@pytest.mark.thorough
def test_no_compiled_code_is_called_where_numpy_is_in_use():
    """A step of a mixture with constraints does not so much as import Numba; without `using` it does."""
    assert run_python(STEP_OF_EVERYTHING).split() == ["False", "True"]


def test_wrong_shapes_are_refused(mixture):
    """Before anything is computed with them."""
    bodies, state, _ = mixture
    fewer = BodyState(state.q[:, :4], state.p[:, :4], state.A[:, :, :4], state.L[:, :4])
    with pytest.raises(ValueError, match=r"q of shape \(3, 280\), got \(3, 4\)"):
        operators.drift(bodies)(fewer, 0.001)
    short = operators.CachedForces(lambda q, A: (q[:, :1], q))
    with pytest.raises(ValueError, match=r"\(3, 280\) of the positions, got \(3, 1\) and \(3, 280\)"):
        operators.kick(short)(state, 0.001)


def test_a_backend_is_in_use_until_the_end_or_an_error():
    before = backend.active()
    with contextlib.suppress(RuntimeError), backend.using(backend.NUMPY):
        assert backend.active() is backend.NUMPY
        raise RuntimeError
    assert backend.active() is before


@pytest.mark.thorough
@pytest.mark.parametrize(("value", "name"), [("0", "NumPy"), ("1", "Numba")])
def test_the_environment_keeps_numba_out(value, name):
    code = "from openmm_sier.dynamics import backend; print(backend.active().name)"
    environment = os.environ | {"OPENMM_SIER_NUMBA": value}
    assert run_python(code, environment=environment).strip() == name
