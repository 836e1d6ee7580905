"""Threads that share loops."""

import multiprocessing
import threading
import time

import numpy as np
import pytest

from openmm_sier.dynamics import operators, rotation, threads
from openmm_sier.dynamics.tally import Tally
from openmm_sier.dynamics.thermostat import OrnsteinUhlenbeck
from tests.support import molecules
from tests.support.steps import every_kind, with_a_fast_body


@pytest.fixture
def short_shares(monkeypatch):
    """Loops over six bodies or more are shared."""
    monkeypatch.setattr(threads, "SHARE", 3)
    monkeypatch.setattr(threads, "count", lambda: 1)


@pytest.fixture
def three_threads(short_shares, monkeypatch):
    monkeypatch.setattr(threads, "count", lambda: 3)


def test_threads_give_the_same_bits(short_shares, request, rng):
    bodies, state, forces = every_kind(rng)
    state, flow = with_a_fast_body(bodies, state), operators.drift(bodies)

    def bathed():
        tally = Tally(1)
        after = OrnsteinUhlenbeck(300.0, 3.0, 7.0).operator(bodies, tally)(state, 0.05)
        return after.p, after.L, tally.heat

    def atoms():
        empty = np.zeros_like(forces)
        placed, moved = bodies.place(state.q, state.A, empty.copy()), bodies.move(state, empty.copy())
        return placed, moved, *bodies.forces_and_torques(forces, state.A), *bodies.momenta(moved, state.A)

    alone, bathed_alone, atoms_alone = flow(state, 0.001), bathed(), atoms()
    request.getfixturevalue("three_threads")
    assert np.array_equal(flow(state, 0.001).A, alone.A)
    assert all(map(np.array_equal, bathed(), bathed_alone))
    assert all(map(np.array_equal, atoms(), atoms_alone))


def test_no_thread_is_at_work_after_an_interrupt(three_threads):
    """An error in one share is raised after the other shares are finished."""
    busy, finished = threading.Event(), []

    def loop(start, stop):
        if start == 0:
            busy.wait(10)
            raise KeyboardInterrupt
        busy.set()
        time.sleep(0.05)
        finished.append((start, stop))

    with pytest.raises(KeyboardInterrupt):
        threads.shared(loop)(11)
    results = list(finished)
    assert results
    time.sleep(0.1)
    assert finished == results


def test_loops_in_a_forked_process(three_threads):
    bodies, state = molecules.ensemble(molecules.WATER, 50)
    expected, _ = rotation.exact(state.A, state.L, bodies.species[0].moments, 1e-3)
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)

    def child():
        sender.send(rotation.exact(state.A, state.L, bodies.species[0].moments, 1e-3)[0])

    process = context.Process(target=child, daemon=True)
    process.start()
    assert receiver.poll(300)
    assert np.array_equal(receiver.recv(), expected)
    process.join()


@pytest.mark.parametrize(
    ("n", "parts"), [(5, [(0, 5)]), (6, [(0, 3), (3, 6)]), (14, [(0, 3), (3, 7), (7, 10), (10, 14)])]
)
def test_shares_are_large_enough_for_a_thread(three_threads, n, parts):
    """The results of all shares are summed."""
    results = []
    assert threads.shared(lambda start, stop: results.append((start, stop)) or stop - start)(n) == n
    assert sorted(results) == parts


def test_cores_are_those_that_the_process_is_bound_to(monkeypatch):
    monkeypatch.setattr(threads.os, "sched_getaffinity", lambda _: {0, 2, 5}, raising=False)
    assert threads.cores() == 3
