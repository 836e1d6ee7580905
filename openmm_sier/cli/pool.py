"""Many simulations as one: members of an ensemble on the processes of an Executor, on this machine or on many.

Each member is one command line of `openmm-sier`, executed by a process of its own in a directory of its own. If that
process or the worker that started it is killed, the member goes on from its last checkpoint, here or on another machine
that sees the same directory. Any `concurrent.futures.Executor` can be used.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, ThreadPoolExecutor, wait
from pathlib import Path
from time import monotonic
from typing import NamedTuple

from openmm_sier.dynamics.backend.threads import cores
from openmm_sier.measure.report import SILENT, Report

#: The module that executes a member in a process of its own; its docstring explains its arguments.
WORKER = "openmm_sier.cli.member"

#: Files in the directory of a member, which are the output of its command, the log of an `openmm-sier run`, the
#: arguments with which it has been completed, those that identify it, and the lock of the process that works on it.
OUTPUT, LOG, COMPLETE, NOTES, LOCK = "output.txt", "run.csv", "complete.json", "member.json", "lock"

#: A member is given up when its process has been killed this often without progress in between.
MOST_KILLS = 5

#: Seconds between two checks of the progress of members.
LOOK = 0.5


class Member(NamedTuple):
    """One simulation of an ensemble.

    Attributes:
        name: of its directory.
        arguments: command line of `openmm-sier run`, without the paths of files that it writes.
        length: simulated ps, if progress within the member is to be shown; 0 otherwise.
        module: executed with these arguments in the member's directory; it calls `openmm_sier.cli.member.serve`.
    """

    name: str
    arguments: tuple[str, ...]
    length: float = 0.0
    module: str = WORKER


class Outcome(NamedTuple):
    """The end of a member.

    Attributes:
        name: of the member.
        error: the last line of its output, if it failed; empty if it is complete.
        restarts: how often its process ended early and was started again.
        seconds: wall time on the worker that finished it.
    """

    name: str
    error: str
    restarts: int
    seconds: float


class EnsembleError(RuntimeError):
    """Members failed, or were stopped; all others are complete.

    Attributes:
        outcomes: of the members that ended.
    """

    def __init__(self, message: str, outcomes: Sequence[Outcome]):
        super().__init__(message)
        self.outcomes = tuple(outcomes)


def ensemble(
    members: Sequence[Member],
    directory: str | Path,
    executor: Executor | None = None,
    processes: int | None = None,
    threads: int | None = None,
    report: Report = SILENT,
) -> list[Outcome]:
    """Run all members that are not complete yet.

    Args:
        members: with different names.
        directory: holds a directory for each member; workers must see it under this path.
        executor: takes the members, and again those whose worker was lost; None runs `processes` processes on this
            machine.
        processes: number at a time, without an executor; None: one for each core that this process may use.
        threads: of OpenMM in each process; None: these cores divided by the processes, at least one. With an executor
            None leaves them to each worker, which takes its OPENMM_CPU_THREADS, or one: it does not know what else is
            at work on its machine, and with one thread the bytes are the same everywhere.
        report: receives the progress.

    Returns:
        An outcome for each member, in the given order, including members that were complete before.

    Raises:
        ValueError: names repeat, or a number is not positive.
        EnsembleError: members failed. The others are complete nevertheless.
    """
    names = [member.name for member in members]
    if len(set(names)) < len(names):
        raise ValueError(f"members need names of their own, got {max(names, key=names.count)} more than once")
    if wrong := [name for name in names if Path(name).name != name or name in ("", "..")]:
        raise ValueError(f"members need names of directories, got {wrong[0]!r}")
    for name, number in (("processes", processes), ("threads", threads)):
        if number is not None and number < 1:
            raise ValueError(f"{name} must be at least 1, got {number}")
    place = Path(directory).resolve()
    if executor is not None:
        return _run_all(executor, members, place, threads, report)
    processes = processes or max(1, min(cores(), len(members)))
    threads = threads or max(1, cores() // processes)
    with ThreadPoolExecutor(processes) as pool:
        try:
            return _run_all(pool, members, place, threads, report)
        except BaseException:
            # Children end before the pool is left; members can go on from their last checkpoints.
            _stop_children()
            pool.shutdown(cancel_futures=True)
            raise
        finally:
            _STOPPED.clear()


def _run_all(
    executor: Executor, members: Sequence[Member], place: Path, threads: int | None, report: Report
) -> list[Outcome]:
    """Submit all members. The executor itself replaces workers that are lost, as dask does."""
    found = {m.name: Outcome(m.name, "", 0, 0.0) for m in members if is_complete(m, place)}
    with report.progress(f"{len(members)} members", len(members)) as advance:
        running = {executor.submit(run_member, m, str(place), threads): m for m in members if m.name not in found}
        while running:
            for future in wait(running, timeout=LOOK, return_when=FIRST_COMPLETED).done:
                name, error = running.pop(future).name, future.exception()
                lost = f"its worker was lost: {' '.join(repr(error).split())}"
                found[name] = Outcome(name, lost, 0, 0.0) if error else future.result()
            parts = [fraction_done(member, place) for member in running.values()]
            working = sum(0 < part < 1 for part in parts)
            advance(len(found) + sum(parts), f"{len(found)} of {len(members)} members done, {working} running")
    outcomes = [found[member.name] for member in members]
    if failed := [outcome for outcome in outcomes if outcome.error]:
        more = f", and {len(failed) - 1} more" if len(failed) > 1 else ""
        raise EnsembleError(f"{failed[0].name} failed: {failed[0].error}{more}", outcomes)
    return outcomes


def is_complete(member: Member, place: Path) -> bool:
    """Whether a member has been completed with these arguments."""
    return read_arguments(place / member.name / COMPLETE) == list(member.arguments)


def read_arguments(path: Path) -> list[str] | None:
    """The arguments that a note in a member's directory holds.

    None where there is no note, or one that holds no list of words, as after a power failure: its member is done again.
    """
    try:
        found = json.loads(path.read_bytes())
    except (FileNotFoundError, ValueError, RecursionError):
        return None
    return found if isinstance(found, list) and all(isinstance(argument, str) for argument in found) else None


def fraction_done(member: Member, place: Path) -> float:
    """The fraction of a member's length that its log covers; 0 without a log."""
    if not member.length:
        return 0.0
    try:
        with open(place / member.name / LOG, "rb") as file:
            columns = file.readline().decode().rstrip().split(",")
            file.seek(max(file.tell(), os.fstat(file.fileno()).st_size - 4096))
            rows = [line.split(b",") for line in file.read().splitlines()]
        times = [float(row[columns.index("Time (ps)")]) for row in rows if len(row) == len(columns)]
    except (OSError, ValueError):
        return 0.0
    return min(1.0, times[-1] / member.length) if times else 0.0


# --- on a worker ---


#: The processes of members that this process has started, and whether they are to end.
_RUNNING: set[subprocess.Popen[bytes]] = set()
_STOPPED = threading.Event()


def _stop_children() -> None:
    """End all processes of members, and those that are being started: they end when their standard input does."""
    _STOPPED.set()
    for child in tuple(_RUNNING):
        _end(child)


def _end(child: subprocess.Popen[bytes]) -> None:
    assert child.stdin is not None
    child.stdin.close()


def run_member(member: Member, place: str, threads: int | None) -> Outcome:
    """Execute a member in a process of its own, and restart it from its checkpoint whenever that process is killed.

    Args:
        member: of the ensemble.
        place: directory of the ensemble.
        threads: of OpenMM; None: the worker's OPENMM_CPU_THREADS, or one.

    Returns:
        The outcome of the member, which reports its errors; they are not raised.
    """
    directory = Path(place) / member.name
    directory.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", member.module, *member.arguments]
    environment = {"OPENMM_CPU_THREADS": "1"} | os.environ
    # A member finds the modules that this process finds, though it has another current directory.
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))
    if threads is not None:
        environment["OPENMM_CPU_THREADS"] = str(threads)
    begun, restarts, kills, reached = monotonic(), 0, 0, -1.0
    error: str | None = "stopped" if _STOPPED.is_set() else None
    while error is None:
        code = _wait_for(command, directory, environment)
        if code == 0:
            error = ""
        elif _STOPPED.is_set():
            error = "stopped"
        elif 0 < code <= 128:
            error = _last_line(directory / OUTPUT)
        else:
            # A signal ended it, at once or after it had written its files.
            restarts += 1
            now = fraction_done(member, Path(place))
            kills = 0 if now > reached else kills + 1
            reached = now
            if kills == MOST_KILLS:
                error = f"ended {MOST_KILLS} times without getting further, the last time with exit code {code}"
    return Outcome(member.name, error, restarts, monotonic() - begun)


def _wait_for(command: Sequence[str], directory: Path, environment: dict[str, str]) -> int:
    """Exit code of a process in a directory."""
    with open(directory / OUTPUT, "ab") as output:
        child = subprocess.Popen(
            command, cwd=directory, env=environment, stdin=subprocess.PIPE, stdout=output, stderr=subprocess.STDOUT
        )
        _RUNNING.add(child)
        try:
            if _STOPPED.is_set():
                _end(child)
            return child.wait()
        finally:
            _RUNNING.discard(child)
            child.kill()
            child.wait()


def _last_line(path: Path) -> str:
    lines = path.read_text(errors="replace").split("\n")
    return next((line.strip() for line in reversed(lines) if line.strip()), "it said nothing")
