"""Threads that share loops."""

from __future__ import annotations

import contextlib
import multiprocessing
import threading
import time

import numpy as np
import pytest

from openmm_sier.dynamics import operators, rotation
from openmm_sier.dynamics.backend import threads
from openmm_sier.dynamics.schemes import SIER4G
from tests.support import molecules
from tests.support.steps import constant_torques, with_a_fast_body


@pytest.fixture
def three_threads():
    """Loops over nine bodies or more are shared by three threads."""
    with threads.use(3, share=3):
        yield


def whole_step(bodies, state, forces):
    """Everything that the loops compute."""
    state = with_a_fast_body(bodies, state)
    flows = operators.body_operators(bodies, constant_torques(bodies, forces))
    end = operators.stepper(SIER4G, flows, 0.001)(state)
    A, _ = rotation.exact(state.A, state.L, bodies.species[0].moments, 1e-3)
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
        threads.shared(loop)(slice(0, 11))
    found = list(finished)
    assert found
    time.sleep(0.1)
    assert finished == found


def test_threads_of_an_abandoned_loop_do_nothing():
    """An interrupt between the starts of two threads, or before one of them has come to its work."""
    done = []
    team = threads.Team(lambda start, stop: done.append(start), ())
    team._abandoned = True
    team._work((0, 5))
    assert done == []
    assert team._busy == []


def test_loops_in_a_forked_process(three_threads):
    bodies, state = molecules.ensemble(molecules.WATER, 50)
    expected, _ = rotation.exact(state.A, state.L, bodies.species[0].moments, 1e-3)
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)

    def child():
        sender.send(rotation.exact(state.A, state.L, bodies.species[0].moments, 1e-3)[0])

    process = context.Process(target=child, daemon=True)
    process.start()
    assert receiver.poll(60)
    assert np.array_equal(receiver.recv(), expected)
    process.join()


@pytest.mark.parametrize("first", [0, 1])
def test_errors_of_threads_come_out(three_threads, first):
    """From every share, and from the shares of the other threads alone."""

    def loop(start, stop):
        if start >= first:
            raise ValueError("what went wrong")

    with pytest.raises(ValueError, match="what went wrong"):
        threads.shared(loop)(slice(0, 11))


def test_the_number_of_threads_holds_until_the_end_or_an_error():
    before = threads.count()
    with contextlib.suppress(RuntimeError), threads.use(5):
        with threads.use(1):
            assert threads.count() == 1
        assert threads.count() == 5
        raise RuntimeError
    assert threads.count() == before


@pytest.mark.parametrize(("n", "parts"), [(5, [(0, 5)]), (6, [(0, 3), (3, 6)]), (100, [(0, 33), (33, 66), (66, 100)])])
def test_shares_are_large_enough_for_a_thread(three_threads, n, parts):
    """The results of all shares are summed."""
    found = []
    assert threads.shared(lambda start, stop: found.append((start, stop)) or stop - start)(slice(0, n)) == n
    assert sorted(found) == parts
