"""Threads that share loops."""

import contextlib
import multiprocessing
import os
import threading
import time

import numpy as np
import pytest

from openmm_sier.dynamics import operators, rotation
from openmm_sier.dynamics.backend import threads
from tests.support import molecules
from tests.support.steps import with_a_fast_body


@pytest.fixture
def three_threads():
    """Loops over nine bodies or more are shared by three threads."""
    with threads.use(3, share=3):
        yield


def test_threads_give_the_same_bits(request, mixture):
    bodies, state, _ = mixture
    state, flow = with_a_fast_body(bodies, state), operators.drift(bodies)
    alone = flow(state, 0.001)
    request.getfixturevalue("three_threads")
    assert np.array_equal(flow(state, 0.001).A, alone.A)


def test_no_thread_is_at_work_after_an_interrupt(three_threads):
    """What breaks off one share comes out, when the others have finished theirs."""
    busy, finished = threading.Event(), []

    def loop(start, stop):
        if start == 0:
            busy.wait(10)
            raise KeyboardInterrupt
        busy.set()
        time.sleep(0.05)
        finished.append((start, stop))

    with pytest.raises(KeyboardInterrupt):
        threads.shared(loop)(slice(0, 11))
    found = list(finished)
    assert found
    time.sleep(0.1)
    assert finished == found


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


@pytest.fixture
def eight_bound(tmp_path, monkeypatch):
    """A process that is bound to eight cores; control groups are read in this directory."""
    monkeypatch.setattr(threads.os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    monkeypatch.setattr(threads, "OWN_GROUPS", tmp_path / "own")
    monkeypatch.setattr(threads, "ALL_GROUPS", tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("own", "files", "number"),
    [
        ("", {}, 8),
        ("0::/job/step\n", {"job/cpu.max": "300000 100000\n", "job/step/cpu.max": "max 100000\n"}, 3),
        ("0::/job/step\n", {"job/cpu.max": "max 100000\n", "job/step/cpu.max": "250000 100000\n"}, 2),
        ("0::/job\n", {"job/cpu.max": "50000 100000\n"}, 1),
        ("0::/\n", {"cpu.max": "1600000 100000\n"}, 8),
        (
            "5:cpuset:/a\n4:cpu,cpuacct:/job\n0::/\n",
            {"cpu/job/cpu.cfs_quota_us": "400000\n", "cpu/job/cpu.cfs_period_us": "100000\n"},
            4,
        ),
        # In a container, whose group is the whole tree that it sees.
        (
            "4:cpuacct,cpu:/docker/c0ffee\n",
            {"cpu/cpu.cfs_quota_us": "200000\n", "cpu/cpu.cfs_period_us": "100000\n"},
            2,
        ),
        ("4:cpu:/\n", {"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, 8),
    ],
)
def test_cores_are_those_that_the_process_may_use(eight_bound, own, files, number):
    (eight_bound / "own").write_text(own)
    for name, text in files.items():
        (eight_bound / name).parent.mkdir(parents=True, exist_ok=True)
        (eight_bound / name).write_text(text)
    assert threads.cores() == number


def test_cores_without_control_groups(eight_bound, monkeypatch):
    assert threads.cores() == 8
    monkeypatch.delattr(threads.os, "sched_getaffinity")
    assert threads.cores() == os.cpu_count()
