"""The two executors of the kernels: Numba gives what NumPy gives, and NumPy alone is enough."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import time

import numpy as np
import pytest

from openmm_sier import compiled, rotor
from openmm_sier.bodies import BodyState, RigidBodies, Species
from tests.test_langevin import GEOMETRIES, ensemble

#: Sums and products that are contracted to fused operations, or not, differ by rounding of terms of order one; the
#: kernels have some 300 of them.
ROUNDING = 1e-14


def both(function):
    """What NumPy gives, and what Numba gives."""
    with compiled.disabled():
        plain = function()
    if compiled.executor() is None:
        raise RuntimeError("this test needs Numba: pip install 'openmm-sier[fast]'")
    return plain, function()


@pytest.mark.parametrize("order", [(0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)])
@pytest.mark.parametrize("kind", GEOMETRIES)
def test_rotations_agree(kind, order):
    """For every order of the axes and for steps within the first rule, the second one, and beyond both."""
    bodies, state = ensemble(kind, 500)
    moments = bodies.species[0].moments[list(order)]
    A = state.A[list(order)]
    L = np.random.default_rng(1).normal(size=state.L.shape) * 0.3
    for h in (-1e-3, 1e-4, 3e-3, 0.02, 1.0):
        plain, fast = both(lambda h=h: rotor.exact(A, L, moments, h)[0])
        # Long steps turn by thousands of radians, which rounding of |L| h multiplies.
        turn = 1.0 if not moments.any() else 1 + 3 * abs(h) / moments[moments > 0].min()
        assert np.abs(plain - fast).max() < ROUNDING * turn


def test_bodies_at_rest_and_out_of_range_agree():
    A = np.repeat(np.eye(3)[:, :, None], 4, axis=2)
    L = np.array([[0.0, 1e-200, 1e150, 1.0], [0.0, 0.0, 1e150, 2.0], [0.0, 0.0, 0.0, 3.0]])
    plain, fast = both(lambda: rotor.exact(A, L, (0.6, 1.1, 1.7), 1e-3)[0])
    # The third body turns by 1e147 rad, of which nothing is known but that it is a rotation.
    assert np.abs(plain - fast)[:, :, [0, 1, 3]].max() < ROUNDING
    assert np.abs(np.einsum("ijn,kjn->ikn", fast, fast) - np.eye(3)[:, :, None]).max() < ROUNDING


@pytest.mark.parametrize("kind", GEOMETRIES)
def test_sums_and_places_agree(kind):
    single, state = ensemble(kind, 50)
    species = single.species[0]
    # Two species with atoms out of order, and a particle that belongs to no body.
    k = species.atoms.shape[1]
    shuffled = np.random.default_rng(2).permutation(50 * k)[: 20 * k].reshape(20, k)
    bodies = RigidBodies([Species(shuffled, species.masses, species.sites, species.moments)], 50 * k + 1)
    rng = np.random.default_rng(3)
    state = BodyState(*(rng.normal(size=(3, 20)) for _ in range(2)), state.A[:, :, :20], state.L[:, :20])
    forces = rng.normal(size=(50 * k + 1, 3))
    for function in (
        lambda: np.stack(bodies.forces_and_torques(forces, state.A)),
        lambda: np.stack(bodies.momenta(forces, state.A)),
        lambda: bodies.place(state.q, state.A, forces.copy()),
        lambda: bodies.move(state, forces.copy()),
    ):
        plain, fast = both(function)
        assert np.abs(plain - fast).max() < ROUNDING * max(1.0, np.abs(plain).max())


@pytest.fixture
def three_threads(monkeypatch):
    """Loops over ten bodies or more are shared by three threads."""
    monkeypatch.setattr(compiled, "LARGE", 10)
    monkeypatch.setattr(compiled, "threads", lambda: 3)
    compiled._pool.cache_clear()
    yield
    compiled._pool().shutdown()
    compiled._pool.cache_clear()


def whole_step(bodies, state, forces):
    """Everything that the loops compute, with a body at rest, which the rotation leaves to NumPy."""
    L = state.L.copy()
    L[:, 5] = 0
    A, _ = rotor.exact(state.A, L, bodies.species[0].moments, 1e-3)
    positions = bodies.place(state.q, A, np.zeros_like(forces))
    return A, positions, bodies.move(state, np.zeros_like(forces)), *bodies.forces_and_torques(forces, A)


def test_threads_give_the_same_bits(request):
    bodies, state = ensemble("asymmetric", 200)
    forces = np.random.default_rng(3).normal(size=(bodies.n_particles, 3))
    alone = whole_step(bodies, state, forces)
    request.getfixturevalue("three_threads")
    for one, other in zip(alone, whole_step(bodies, state, forces), strict=True):
        assert np.array_equal(one, other)


def test_an_interrupt_waits_for_the_threads(three_threads, monkeypatch):
    """What is interrupted twice is finished all the same, and the interrupt comes out."""
    finished = []
    wait, interrupts = compiled.wait, [KeyboardInterrupt, KeyboardInterrupt]

    def interrupted(tasks):
        if interrupts:
            raise interrupts.pop()
        return wait(tasks)

    def loop(start, stop):
        time.sleep(0.02)
        finished.append((start, stop))

    monkeypatch.setattr(compiled, "wait", interrupted)
    with pytest.raises(KeyboardInterrupt):
        compiled._threaded(loop)(11)
    assert sorted(finished) == [(0, 4), (4, 8), (8, 11)]


def test_errors_of_threads_come_out(three_threads):
    def loop(start, stop):
        raise ValueError("what went wrong")

    with pytest.raises(ValueError, match="what went wrong"):
        compiled._threaded(loop)(11)


def test_disabled_is_undone_by_an_error():
    before = compiled.executor()
    with contextlib.suppress(RuntimeError), compiled.disabled():
        assert compiled.executor() is None
        raise RuntimeError
    assert compiled.executor() is before


@pytest.mark.parametrize(
    ("code", "absent"),
    [
        ("import openmm_sier", {"numba", "matplotlib", "h5py", "rich", "mdtraj", "scipy"}),
        ("import openmm_sier.cli; openmm_sier.cli.build_parser()", {"numba", "mdtraj", "rich"}),
    ],
)
def test_imports_are_lean(code, absent):
    check = f"{code}\nimport sys\nprint(*sorted({absent!r} & set(sys.modules)))"
    found = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=True).stdout.split()
    assert found == []
