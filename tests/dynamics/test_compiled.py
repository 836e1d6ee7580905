"""The two executors of the kernels: Numba gives what NumPy gives, and NumPy alone is enough."""

from __future__ import annotations

import contextlib
import multiprocessing
import subprocess
import sys
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from openmm_sier import SIER2, SIER4
from openmm_sier.dynamics import operators
from openmm_sier.dynamics.backend import compiled
from openmm_sier.dynamics.bodies import BodyState
from openmm_sier.dynamics.rotation import rotor
from openmm_sier.dynamics.schemes import SIER4G
from tests.support import molecules
from tests.support.molecules import CARBON_DIOXIDE, ION, METHANE, WATER, ensemble

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
@pytest.mark.parametrize("kind", [WATER, CARBON_DIOXIDE, METHANE, ION])
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


@pytest.fixture
def mixture(rng):
    """Several bodies of every kind, their atoms out of order among free particles, and forces on all of these."""
    bodies = molecules.scattered(molecules.GEOMETRIES, each=40)
    state = molecules.thermal_state(rng, bodies, rng.normal(size=(3, bodies.n)))
    return bodies, state, 1000 * rng.normal(size=(bodies.n_particles, 3))


def test_sums_and_places_agree(mixture):
    bodies, state, forces = mixture
    for function in (
        lambda: np.stack(bodies.forces_and_torques(forces, state.A)),
        lambda: np.stack(bodies.momenta(forces, state.A)),
        lambda: bodies.place(state.q, state.A, forces.copy()),
        lambda: bodies.move(state, forces.copy()),
    ):
        plain, fast = both(function)
        assert np.abs(plain - fast).max() < ROUNDING * max(1.0, np.abs(plain).max())


def with_a_fast_body(bodies, state):
    """The state with a body at rest and one that spins too fast for the series: the loops leave both to NumPy."""
    L, slow = state.L.copy(), bodies.parts[1].start
    L[:, slow], L[:, slow + 1] = 0.0, 100 * L[:, slow + 1]
    return replace(state, L=L)


def constant_torques(bodies, forces):
    """Forces that hold the bodies near the origin, and torques of atom forces, none on the body at rest."""

    def forces_at(q, A):
        F, tau = bodies.forces_and_torques(forces, A)
        tau[:, bodies.parts[1].start] = 0.0
        return F - 100.0 * q, tau

    return operators.CachedForces(forces_at)


@pytest.mark.parametrize("scheme", [SIER2, SIER4, SIER4G], ids=lambda scheme: scheme.name)
def test_steps_agree(mixture, scheme):
    bodies, state, forces = mixture
    state = with_a_fast_body(bodies, state)

    def after_a_step():
        flows = operators.body_operators(bodies, constant_torques(bodies, forces))
        return operators.stepper(scheme, flows, 0.004)(state)

    plain, fast = both(after_a_step)
    assert not np.array_equal(plain.A, state.A)
    for name in "qpAL":
        one, other = getattr(plain, name), getattr(fast, name)
        # Some stages, of the fast body by angles up to 30, each rounded.
        assert np.abs(one - other).max() < 100 * ROUNDING * np.abs(one).max(), name


def test_steps_of_no_bodies_and_of_points(rng):
    for kinds in ([], [molecules.ION]):
        bodies = molecules.scattered(kinds, each=5)
        state = molecules.thermal_state(rng, bodies, rng.normal(size=(3, bodies.n)))
        flows = operators.body_operators(bodies, operators.CachedForces(lambda q, A: (-q, 0 * q)))
        plain, fast = both(lambda flows=flows, s=state: operators.stepper(SIER4G, flows, 0.01)(s))
        for name in "qpAL":
            assert getattr(plain, name).shape == getattr(state, name).shape
            # A gradient kick gives points the moment of parallel vectors, which is rounding of 1e-3 x 1.
            assert np.allclose(getattr(plain, name), getattr(fast, name), rtol=10 * ROUNDING, atol=1e-3 * ROUNDING)


@pytest.mark.parametrize("without_numba", [False, True])
def test_wrong_shapes_are_refused(mixture, without_numba):
    """Compiled loops look at no bounds."""
    bodies, state, _ = mixture
    fewer = BodyState(state.q[:, :4], state.p[:, :4], state.A[:, :, :4], state.L[:, :4])
    with compiled.disabled() if without_numba else contextlib.nullcontext():
        with pytest.raises(ValueError, match=r"q of shape \(3, 280\), got \(3, 4\)"):
            operators.drift(bodies)(fewer, 0.001)
        short = operators.CachedForces(lambda q, A: (q[:, :1], q))
        with pytest.raises(ValueError, match=r"\(3, 280\) of q, got \(3, 1\) and \(3, 280\)"):
            operators.kick(short)(state, 0.001)


@pytest.fixture
def three_threads(monkeypatch):
    """Loops over nine bodies or more are shared by three threads."""
    monkeypatch.setattr(compiled, "SHARE", 3)
    monkeypatch.setattr(compiled, "_available_threads", lambda: 3)


def whole_step(bodies, state, forces):
    """Everything that the loops compute."""
    state = with_a_fast_body(bodies, state)
    flows = operators.body_operators(bodies, constant_torques(bodies, forces))
    end = operators.stepper(SIER4G, flows, 0.001)(state)
    A, _ = rotor.exact(state.A, state.L, bodies.species[0].moments, 1e-3)
    positions = bodies.place(end.q, end.A, np.zeros_like(forces))
    return A, end.q, end.p, end.A, end.L, positions, bodies.move(end, np.zeros_like(forces))


def test_threads_give_the_same_bits(request, mixture):
    alone = whole_step(*mixture)
    request.getfixturevalue("three_threads")
    for one, other in zip(alone, whole_step(*mixture), strict=True):
        assert np.array_equal(one, other)


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit, TimeoutError])
def test_no_thread_is_at_work_after_an_interrupt(three_threads, error):
    """What breaks off the caller's own share comes out, when the others have finished theirs."""
    busy, finished = threading.Event(), []

    def loop(start, stop):
        if start == 0:
            busy.wait(10)
            raise error
        busy.set()
        time.sleep(0.05)
        finished.append((start, stop))

    with pytest.raises(error):
        compiled._threaded(loop)(slice(0, 11))
    found = list(finished)
    assert found
    time.sleep(0.1)
    assert finished == found


def test_threads_of_an_abandoned_loop_do_nothing():
    """An interrupt between the starts of two threads, or before one of them has come to its work."""
    done = []
    team = compiled._Team(lambda start, stop: done.append(start), ())
    team._abandoned = True
    team._work((0, 5))
    assert done == []
    assert team._busy == []


def test_loops_in_a_forked_process(three_threads):
    bodies, state = ensemble(WATER, 50)
    expected, _ = rotor.exact(state.A, state.L, bodies.species[0].moments, 1e-3)
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)

    def child():
        sender.send(rotor.exact(state.A, state.L, bodies.species[0].moments, 1e-3)[0])

    process = context.Process(target=child, daemon=True)
    process.start()
    assert receiver.poll(60)
    assert np.array_equal(receiver.recv(), expected)
    process.join()


def test_no_directory_for_the_cache(monkeypatch):
    """Where nothing can be written the loops are compiled in every process."""
    import numba

    made = []

    def njit(function, cache=False, **options):
        if cache:
            raise RuntimeError("cannot cache function 'rotate': no locator available")
        made.append(function)
        return function

    monkeypatch.setattr(numba, "njit", njit)
    assert compiled._cached(child_of := (lambda: None)) is child_of
    assert made == [child_of]


@pytest.mark.parametrize("first", [0, 1])
def test_errors_of_threads_come_out(three_threads, first):
    """From every share, and from the shares of the other threads alone."""

    def loop(start, stop):
        if start >= first:
            raise ValueError("what went wrong")

    with pytest.raises(ValueError, match="what went wrong"):
        compiled._threaded(loop)(slice(0, 11))


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
        ("import openmm_sier.cli.main; openmm_sier.cli.main.build_parser()", {"numba", "mdtraj", "rich"}),
    ],
)
def test_imports_are_lean(code, absent):
    check = f"{code}\nimport sys\nprint(*sorted({absent!r} & set(sys.modules)))"
    found = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=True).stdout.split()
    assert found == []
