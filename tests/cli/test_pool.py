"""Members of an ensemble on the processes of an Executor."""

import os
import signal
import threading
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

import pytest

from openmm_sier.cli import pool as module
from openmm_sier.cli.pool import COMPLETE, LOG, OUTPUT, EnsembleError, Member, ensemble, fraction_done
from tests.support import members
from tests.support.members import HEADING


def counter(name, last):
    """A member that counts, in the place of one that simulates."""
    return Member(name, (str(last),), float(last), members.__name__)


def counters(*lasts):
    return [counter(f"to{last}", last) for last in lasts]


def counted(last):
    return HEADING + "".join(f"{n},{n}\n" for n in range(1, last + 1))


@pytest.mark.parametrize("make", [lambda: None, lambda: ThreadPoolExecutor(2)])
def test_all_members_are_carried_out_once(tmp_path, make):
    outcomes = ensemble(counters(2, 3, 4), tmp_path, make(), processes=2)
    assert [(o.name, o.error, o.restarts) for o in outcomes] == [(f"to{n}", "", 0) for n in (2, 3, 4)]
    again = ensemble(counters(2, 3, 4, 5), tmp_path, make())
    for last in (2, 3, 4, 5):
        assert (tmp_path / f"to{last}" / LOG).read_text() == counted(last)
    # Those that were complete have not been started.
    assert [o.seconds > 0 for o in again] == [False, False, False, True]


def wait_until_counted(place, name, at):
    """Wait until a member has come so far."""
    end = time.monotonic() + 60
    log = place / name / LOG
    while time.monotonic() < end and not (log.exists() and log.read_text().count("\n") > at):
        time.sleep(0.005)


@pytest.mark.slow
def test_a_killed_member_goes_on(tmp_path):
    def kill():
        wait_until_counted(tmp_path, "to97", 20)
        for child in tuple(module._RUNNING):
            child.kill()

    thread = threading.Thread(target=kill)
    thread.start()
    (outcome,) = ensemble(counters(97), tmp_path)
    thread.join()
    assert outcome.restarts == 1
    assert (tmp_path / "to97" / LOG).read_text() == counted(97)


def test_a_member_that_gets_nowhere_is_given_up(tmp_path, monkeypatch):
    killed = tmp_path / "killed.sh"
    killed.write_text("#!/bin/sh\nkill -9 $$\n")
    killed.chmod(0o755)
    monkeypatch.setattr(module.sys, "executable", str(killed))
    with pytest.raises(EnsembleError, match="without getting further") as caught:
        ensemble(counters(3), tmp_path)
    assert caught.value.outcomes[0].restarts == module.MOST_KILLS + 1


def test_a_member_that_fails_does_not_hinder_the_others(tmp_path):
    with pytest.raises(EnsembleError, match="wrong failed: expected a number, got x") as caught:
        ensemble([Member("wrong", ("x",), module=members.__name__), *counters(3)], tmp_path, processes=1)
    assert [bool(o.error) for o in caught.value.outcomes] == [True, False]
    assert (tmp_path / "to3" / LOG).read_text() == counted(3)


@pytest.mark.slow
def test_a_lost_worker_is_replaced(tmp_path):
    """By dask, which gives its members to another one."""
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster,
        distributed.Client(cluster) as client,
    ):
        (worker,) = client.run(os.getpid).values()

        def kill():
            wait_until_counted(tmp_path, "to96", 20)
            os.kill(worker, signal.SIGKILL)

        thread = threading.Thread(target=kill)
        thread.start()
        (outcome,) = ensemble(counters(96), tmp_path, client.get_executor(pure=False))
        thread.join()
        assert worker not in client.run(os.getpid).values()
    assert not outcome.error
    assert (tmp_path / "to96" / LOG).read_text() == counted(96)


def test_a_member_whose_workers_are_lost_does_not_hinder_the_others(tmp_path):
    class Losing(ThreadPoolExecutor):
        """Gives one member up."""

        def submit(self, function, member, *arguments):
            if member.name == "to2":
                return super().submit(os.stat, "no such worker")
            return super().submit(function, member, *arguments)

    with pytest.raises(EnsembleError, match=r"to2 failed: its worker was lost: .*No such file") as caught:
        ensemble(counters(2, 3), tmp_path, Losing(1))
    assert [bool(o.error) for o in caught.value.outcomes] == [True, False]
    assert (tmp_path / "to3" / LOG).read_text() == counted(3)


@pytest.mark.slow
def test_an_interrupt_stops_the_children(tmp_path):
    class Interrupting:
        """A report whose progress is interrupted once the member runs."""

        def progress(self, *_):
            class Context:
                def __enter__(self):
                    return self.advance

                def __exit__(self, *_):
                    pass

                @staticmethod
                def advance(done, description=None):
                    if done > 0:
                        raise KeyboardInterrupt

            return Context()

    with pytest.raises(KeyboardInterrupt):
        ensemble(counters(1000), tmp_path, report=Interrupting())
    # It would take 20 s to count so far.
    assert 1 < (tmp_path / "to1000" / LOG).read_text().count("\n") < 1000


def threads_of(place, name):
    return int((place / name / OUTPUT).read_text())


def test_members_on_this_machine_share_the_cores_that_this_process_may_use(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "cores", lambda: 7)
    monkeypatch.setattr(module.os, "cpu_count", lambda: 64)
    ensemble(counters(2, 3), tmp_path)
    assert [threads_of(tmp_path, name) for name in ("to2", "to3")] == [3, 3]


@pytest.mark.parametrize(("asked", "set_there", "found"), [(None, None, 1), (None, "5", 5), (4, "5", 4)])
def test_workers_of_an_executor_know_their_threads(tmp_path, monkeypatch, asked, set_there, found):
    """Not the machine that submits, whatever its cores."""
    monkeypatch.setattr(module, "cores", lambda: 7)
    monkeypatch.delenv("OPENMM_CPU_THREADS")
    if set_there:
        monkeypatch.setenv("OPENMM_CPU_THREADS", set_there)
    with ThreadPoolExecutor(1) as worker:
        ensemble(counters(2), tmp_path, worker, threads=asked)
    assert threads_of(tmp_path, "to2") == found


def test_wrong_arguments(tmp_path):
    with pytest.raises(ValueError, match="to2 more than once"):
        ensemble(counters(2, 3, 2), tmp_path)
    with pytest.raises(ValueError, match="processes must be at least 1, got 0"):
        ensemble(counters(2), tmp_path, processes=0)
    assert not list(tmp_path.iterdir())


def test_progress_within_a_member(tmp_path):
    member = counter("one", 8)
    assert fraction_done(member, tmp_path) == 0
    (tmp_path / "one").mkdir()
    # The last line is being written.
    (tmp_path / "one" / LOG).write_text(HEADING + "1,1\n2,2\n3")
    assert fraction_done(member, tmp_path) == 0.25


def test_members_travel_to_other_processes(tmp_path):
    with ProcessPoolExecutor(1) as pool:
        ensemble(counters(3), tmp_path, pool)
    assert (tmp_path / "to3" / LOG).read_text() == counted(3)


def test_the_counting_member_writes_what_real_ones_do():
    assert (members.LOG, members.COMPLETE) == (LOG, COMPLETE)
